"""Recovered power and bias of calibrators against k, a row for each world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import CasesFigure
from calstudy.figures.signal_loss import SIGMAS_95
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.run.task import Job

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.MAGENTA, style.RED, style.CYAN, style.BLACK)
MARKERS = ("o", "s", "D", "^", "v", "P", "X")
LINEAR = {"recovered": 1.0, "bias": 0.1}
"""Upper end of the linear part of an axis; larger values make it logarithmic beyond."""
REFERENCE = {"recovered": 1.0, "bias": 0.0}
"""Position of the line: all of the EoR, no bias."""
DECADES = {"recovered": 1.5, "bias": 0.7}
"""Length of the linear part of a logarithmic axis, in decades."""
ROW_HEIGHT, LARGEST_K = 1.7, 1.0


def look(place: int) -> dict[str, Any]:
    """Return colour, marker and line of one of several calibrators or worlds."""
    lines = ("-", "--", ":")
    again, place = divmod(place, len(COLOURS))
    return {
        "color": COLOURS[place],
        # A repeated colour has another marker.
        "marker": MARKERS[(place + 3 * again) % len(MARKERS)],
        "linestyle": lines[again % len(lines)],
    }


@style.journal_style()
def draw_spectra(
    cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str], stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw P^R / P^S on the left and s^2 P^R0 / P^S on the right against k, outside the wedge, with 95 % bars.

    `cases` are by world and calibrator.
    """
    from matplotlib.lines import Line2D

    figure = style.new_figure(style.TWO_COLUMNS, 0.6 + ROW_HEIGHT * len(cases))
    grid = figure.subplots(len(cases), 2, squeeze=False, sharex=True)
    for (left, right), (world, found) in zip(grid, cases.items(), strict=True):
        for name, case in found.items():
            place = calibrators.index(name)
            shift = 0.15 * (place - (len(calibrators) - 1) / 2) / len(calibrators)
            _draw_points(left, case, "recovered", place, shift)
            _draw_points(right, case, "bias", place, shift)
        _scale(left, "recovered", found.values())
        _scale(right, "bias", found.values())
        left.axhline(REFERENCE["recovered"], color=style.GREY, linewidth=0.7, zorder=0)
        right.axhline(REFERENCE["bias"], color=style.GREY, linewidth=0.7, zorder=0)
        left.set_title(world, loc="left")
        left.set_ylabel(r"$P^R / P^S$")
        right.set_ylabel(r"$s^2 P^{R_0} / P^S$")
    for axes in grid[-1]:
        axes.set_xlabel(style.WAVENUMBER)
    handles = [Line2D([], [], linewidth=0.6, markersize=2.5, **look(place)) for place in range(len(calibrators))]
    figure.legend(handles, list(calibrators), loc="outside upper center", ncols=min(len(calibrators), 5))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_points(axes: Axes, case: Case, name: str, place: int, shift: float) -> None:
    bins = case.bins
    values, errors = getattr(bins, name), getattr(bins, f"{name}_error")
    used = _used(case, name)
    k = bins.k + shift * np.diff(bins.bin_edges)
    bars = SIGMAS_95 * np.nan_to_num(errors[used])
    axes.errorbar(k[used], values[used], yerr=bars, elinewidth=0.5, linewidth=0.6, markersize=2.5, **look(place))


def _used(case: Case, name: str) -> np.ndarray:
    return np.isfinite(getattr(case.bins, name)) & (case.bins.k <= LARGEST_K)


def _scale(axes: Axes, name: str, cases: Iterable[Case]) -> None:
    """Make an axis logarithmic where its values are large, with limits just beyond them, zero and the reference.

    Bars may reach beyond the limits: the largest ones would make the other points too small to read.
    """
    values = np.concatenate([getattr(case.bins, name)[_used(case, name)] for case in cases])
    if not values.size:
        return
    low, high = min(values.min(), 0.0), max(values.max(), REFERENCE[name])
    if max(-low, high) <= 2 * LINEAR[name]:
        return
    axes.set_yscale("symlog", linthresh=LINEAR[name], linscale=DECADES[name])
    transform = axes.yaxis.get_transform()
    bottom, top = transform.transform(np.array([low, high]))
    margin = 0.05 * (top - bottom)
    axes.set_ylim(*transform.inverted().transform(np.array([bottom - margin, top + margin])))


class ComparisonSpectra(CasesFigure):
    """P^R / P^S and s^2 P^R0 / P^S of every calibrator against k, a row for each world."""

    caption = "Recovered power (left) and bias (right) outside the wedge in units of the EoR, with 95 % bars."
    scores = "bins"

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw all cases."""
        return draw_spectra(cases, job.settings["calibrators"], job.settings["notes"])
