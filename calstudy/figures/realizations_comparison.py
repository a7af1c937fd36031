"""The signal loss of two arrays over the same draws: T of each, and the difference with all scatter in its error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.units import Wavenumber
from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure, members_of
from calstudy.figures.signal_loss import SIGMAS_95, TRANSFER
from calstudy.plotting import style
from calstudy.products import realizations
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.power.realizations import Pooled, PooledRegion

REGION = "outside-wedge"
SERIES = (("o", style.BLUE), ("s", style.ORANGE))
CSV = "realizations-comparison.csv"


@style.journal_style()
def draw_comparison(
    arrays: Mapping[str, PooledRegion], difference: Pooled, max_k: float = 1.0, stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw T of two arrays with the scatter of one realization, and the mean difference with its 95 % error.

    `arrays` are two, by title, in the same bins; `difference` is T of the first less that of the second. The axis of k
    ends at `max_k`, h/Mpc.
    """
    figure = style.new_figure(style.ONE_COLUMN, 4.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for shift, (marker, colour), (title, pooled) in zip((-0.15, 0.15), SERIES, arrays.items(), strict=True):
        total = pooled.total["transfer"]
        k = pooled.k + shift * np.diff(pooled.bin_edges)
        upper.errorbar(k, total.mean, total.scatter, fmt=marker, color=colour, elinewidth=0.7, label=title)
    upper.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    upper.set_ylabel(TRANSFER)
    upper.legend(loc="lower right", title="bars: scatter of one realization", title_fontsize=style.SMALL_SIZE)
    lower.errorbar(pooled.k, difference.mean, SIGMAS_95 * difference.error, fmt="o", color=style.BLACK, elinewidth=0.7)
    lower.axhline(0, color=style.GREY, linewidth=0.7, zorder=0)
    lower.set(xlabel=style.WAVENUMBER, ylabel=r"difference of $T$, 95 %")
    lower.set_xlim(0, min(max_k, float(pooled.bin_edges[-1])))
    style.note_stand_ins(figure, stand_ins)
    return figure


class RealizationsComparison(StudyFigure):
    """T of two arrays over the same draws, and their difference, with realizations-comparison.csv."""

    of = ("collection",)
    titles = TWO_ARRAYS
    caption = (
        "Transfer function outside the wedge of two arrays, over the same draws of EoR, gains and noise: mean and "
        "scatter of one realization, and the mean difference with 95 % bars that include all that was drawn."
    )
    tolerances = ((".*", Measured("follows from the figures of the members")),)

    max_k: Wavenumber = Field(1.0, gt=0, description="Upper end of the axis of k; the arrays have all bins.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the measurements on every realization of one member."""
        return realizations.inputs(graph)

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the draws of each realization."""
        return realizations.settings(graph)

    def draw(self, job: Job) -> Drawing:
        """Write the table, and draw both arrays and their difference."""
        from calstudy.power.realizations import Design, pool_region

        regions, inputs = {}, members_of(job)
        members = job.settings["members"]
        if len({str(settings) for settings in members.values()}) > 1:
            raise InputError(f"{self.label}: the members draw different realizations; give them the same blocks")
        for role, title in self.titles.items():
            settings = members[role]
            design = Design(settings["draws"], [(block["draw"], block["members"]) for block in settings["blocks"]])
            samples = realizations.read_samples(inputs[role], len(design.draws), REGION)
            regions[title] = pool_region(samples, design)
        first, second = regions.values()
        if not np.array_equal(first.bin_edges, second.bin_edges):
            raise InputError(f"{self.label}: the members have different bins of k, expected the same power.bins")
        differences = _differences(first, second)
        _write(job.output / CSV, regions, differences)
        arrays = {"k": first.k, "bin_edges": first.bin_edges, "difference": differences}
        shown = {role: dict(region.total) for role, region in zip(self.titles, regions.values(), strict=True)}
        figure = draw_comparison(regions, differences["transfer"], self.max_k, job.settings["notes"])
        return Drawing(figure, {**arrays, **shown})


def _differences(first: PooledRegion, second: PooledRegion) -> dict[str, Pooled]:
    """Return the difference of every quantity, realization by realization, pooled over all blocks."""
    from calstudy.power.realizations import together

    found = {}
    for name in first.values:
        values = first.values[name] - second.values[name]
        quoted = np.hypot(first.quoted[name], second.quoted[name])
        found[name] = together(values, quoted, [places for _, places in first.design.blocks])
    return found


def _write(path: Path, regions: Mapping[str, PooledRegion], differences: Mapping[str, Pooled]) -> None:
    from calstudy.power.tables import write_columns

    first = next(iter(regions.values()))
    columns = {"k [h/Mpc]": first.k, "k from [h/Mpc]": first.bin_edges[:-1], "k to [h/Mpc]": first.bin_edges[1:]}
    for name, difference in differences.items():
        for title, region in regions.items():
            columns[f"{name}, {title.lower()}"] = region.total[name].mean
        columns |= {f"{name}, difference": difference.mean, f"{name}, error of difference": difference.error}
    write_columns(path, columns)
