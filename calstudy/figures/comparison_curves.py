"""Transfer function and bias from one calibrator to the next, a curve for each world."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from calstudy.figures import CasesFigure
from calstudy.figures.comparison_spectra import look
from calstudy.figures.signal_loss import SIGMAS_95
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.run.task import Job

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINEAR = 0.01
"""Upper end of the linear part of the axis of the bias."""
LABEL_WIDTH = 9


@style.journal_style()
def draw_curves(
    cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str], stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw T above and the bias below for each band of k, calibrators from left to right, with 95 % bars.

    The calibrators are values of one setting, in order. `cases` are by world and calibrator.
    """
    from matplotlib.lines import Line2D

    worlds = list(cases)
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    figure = style.new_figure(style.TWO_COLUMNS, 4.2)
    grid = figure.subplots(2, edges.size - 1, squeeze=False, sharex=True, sharey="row")
    for band, (upper, lower) in enumerate(grid.T):
        for place, found in enumerate(cases.values()):
            at = np.array([calibrators.index(name) for name in found])
            at = at + 0.3 * (place - (len(worlds) - 1) / 2) / len(worlds)
            for axes, name in ((upper, "transfer"), (lower, "bias")):
                values, errors = (_in_band(found, column, band) for column in (name, f"{name}_error"))
                bars = SIGMAS_95 * np.nan_to_num(errors)
                axes.errorbar(at, values, yerr=bars, elinewidth=0.6, linewidth=0.7, **look(place))
        upper.set_title(rf"$k = {edges[band]:g}$–${edges[band + 1]:g}$ $h\,\mathrm{{Mpc}}^{{-1}}$")
        upper.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
        lower.axhline(0, color=style.GREY, linewidth=0.7, zorder=0)
        lower.set_yscale("symlog", linthresh=LINEAR)
        names = [textwrap.fill(name, LABEL_WIDTH) for name in calibrators]
        lower.set_xticks(range(len(calibrators)), names, fontsize=style.SMALL_SIZE, rotation=90)
    grid[0, 0].set_ylabel(r"$T$, free of the flux scale")
    grid[1, 0].set_ylabel(r"bias $s^2 P^{R_0} / P^S$")
    handles = [Line2D([], [], linewidth=0.7, **look(place)) for place in range(len(worlds))]
    figure.legend(handles, worlds, loc="outside upper center", ncols=min(len(worlds), 5))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _in_band(found: Mapping[str, Case], name: str, band: int) -> np.ndarray:
    return np.array([getattr(case.bands, name)[band] for case in found.values()])


class ComparisonCurves(CasesFigure):
    """T and bias of calibrators that are values of one setting, in bands of k; a curve for each world."""

    caption = "Transfer function and bias outside the wedge from one calibrator to the next, with 95 % bars."

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw all cases."""
        return draw_curves(cases, job.settings["calibrators"], job.settings["notes"])
