"""Do errors of gains cover? Expected against observed fractions of the deviations from the true gains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.table import Table
from calstudy.calibrate.agreement import ALLOWED, PARTS, Covered, pooled
from calstudy.figures import Drawing, StudyFigure, members_of
from calstudy.plotting import style
from calstudy.products.corruption import PARITIES
from calstudy.products.gain_errors import gain_coverage, read_coverage
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, Fixed, Rules

if TYPE_CHECKING:
    from calstudy.experiment.model import Experiment

CSV = "gain-coverage.csv"
COLOURS = (style.BLUE, style.ORANGE)
"""Of amplitudes and phases."""
ACROSS = 3
"""Number of panels in a row."""


def draw_gain_coverage(members: Mapping[str, Covered]) -> style.Figure:
    """Draw observed against expected fractions, and below it their difference with 1.96 standard errors.

    A pair of panels for each member, by name; the name of a single run is empty.
    """
    rows, columns = -(-len(members) // ACROSS), min(ACROSS, len(members))
    figure = style.new_figure(style.TWO_COLUMNS * (columns / ACROSS) ** 0.5, 0.5 + 2.9 * rows)
    grid = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, height_ratios=(2, 1) * rows)
    for axes in grid.flat:
        axes.set_visible(False)
    for place, (name, member) in enumerate(members.items()):
        row, column = divmod(place, ACROSS)
        upper, lower = grid[2 * row : 2 * row + 2, column]
        _draw_fractions(upper, member)
        _draw_difference(lower, member)
        upper.set_title(name, loc="left")
        lower.set_xlabel("expected fraction")
        lower.tick_params(labelbottom=True)
        if column == 0:
            upper.set_ylabel("observed fraction")
            lower.set_ylabel("difference (%)")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    more = grid[1, 0].get_legend_handles_labels()
    figure.legend(handles + more[0], labels + more[1], loc="outside upper center", ncols=4)
    return figure


def _draw_fractions(axes: style.Axes, member: Covered) -> None:
    axes.set_visible(True)
    axes.plot([0, 1], [0, 1], color=style.GREY, linewidth=0.6, zorder=0)
    for name, colour, observed in zip(PARTS, COLOURS, member.observed, strict=True):
        axes.plot(member.expected, observed, color=colour, label=name)
    found = "\n".join(
        f"{name}: {100 * one:.1f}, {100 * two:.1f} %" for name, (one, two) in zip(PARTS, member.within, strict=True)
    )
    # On the side of the diagonal where there are no curves.
    above = bool(np.mean(member.observed - member.expected) < 0)
    place: dict[str, Any] = {"x": 0.04, "y": 0.94, "va": "top"} if above else {"x": 0.96, "y": 0.06, "ha": "right"}
    axes.text(s=f"within 1 and 1.96 σ\n{found}", fontsize=style.SMALL_SIZE, **place)
    axes.set(xlim=(0, 1), ylim=(0, 1))


def _draw_difference(axes: style.Axes, member: Covered) -> None:
    axes.set_visible(True)
    axes.axhline(0, color=style.GREY, linewidth=0.6, zorder=0)
    for place, (colour, observed) in enumerate(zip(COLOURS, member.observed, strict=True)):
        axes.plot(member.expected, 100 * (observed - member.expected), color=colour)
        chance = 100 * SIGMAS_95 * member.error[place]
        label = "chance, 1.96 σ" if place == 0 else None
        axes.fill_between(member.expected, -chance, chance, color=style.BAND, linewidth=0, zorder=0, label=label)
    for place, (fraction, allowed) in enumerate(ALLOWED):
        label = "within 3 % at 68 %, 2 % at 95 %" if place == 0 else None
        axes.errorbar(fraction, 0, 100 * allowed, color=style.BLACK, elinewidth=0.7, capsize=2, label=label)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -4), max(high, 4))


def _error(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    parent, _, own = name.rpartition(".")
    return arrays[f"{parent}.{'error' if own in ('observed', 'error') else 'within_error'}".lstrip(".")]


class GainCoverageFigure(StudyFigure):
    """Whether errors of gains cover the deviations from the true ones, of a run or of every member of a collection."""

    kind: str = "gain-coverage"
    of = ("experiment", "collection")
    caption = (
        "Fractions of amplitudes and phases of the gains that are within limits of the true ones, against those of a "
        "normal distribution with their errors; the difference; and 1.96 standard errors by the scatter over "
        "realizations of the noise."
    )
    needs_calibration = True
    needs_least_squares = True
    tolerances: ClassVar[Rules] = (
        (r"(.*\.)?(observed|within)", Drawn(_error, "the scatter over realizations of the noise")),
        (r"(.*\.)?(expected|realizations)", Fixed("follows from the settings")),
        (r"(.*\.)?worst", Drawn(_error, "that of all antennas together, of which it is one", 20, 20, 20)),
        (r"(.*\.)?(error|within_error)", Drawn(_error, "an error of few realizations", 3)),
    )

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn of an experiment, to follow its name, or None."""
        residual = experiment.variants.get("residual")
        if residual is not None and residual.calibrate and "noise" not in residual.components:
            return "needs noise in variants.residual"
        fit = experiment.calibration
        for field in ("smooth_gains", "gain_delay"):
            if getattr(fit, field, None) is not None:
                return f"needs gains with errors, which there are none of with calibration.{field}"
        return super().refusal(experiment)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the fractions of both noise realizations."""
        variant = graph.experiment.variants["residual"]
        return {parity: gain_coverage(graph, variant, parity) for parity in PARITIES}

    def draw(self, job: Job) -> Drawing:
        """Pool the realizations of every member, draw them, and write the table."""
        members = {
            name: pooled([read_coverage(folders[parity]) for parity in PARITIES])
            for name, folders in members_of(job).items()
        }
        _table(members).write_csv(job.output / CSV)
        shown: Any = members if len(members) > 1 else next(iter(members.values()))
        return Drawing(draw_gain_coverage(members), shown)


def _table(members: Mapping[str, Covered]) -> Table:
    """Return the percentages of each member and of its worst antenna within 1 and 1.96 errors."""
    records = []
    for name, member in members.items():
        shown = {"": member.within, "error of that ": member.within_error, "worst antenna ": member.worst}
        for place, part in enumerate(PARTS):
            record: dict[str, Any] = {"member": name, "of": part, "realizations": member.realizations}
            for limit, sigmas in enumerate(("1", "1.96")):
                for what, values in shown.items():
                    record[f"{what}within {sigmas} sigma [%]"] = round(100 * float(values[place, limit]), 2)
            records.append(record)
    return Table.of_records(records)
