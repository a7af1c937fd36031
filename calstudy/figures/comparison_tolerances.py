"""Bias and transfer function of calibrators against the severity of faults, a row for each fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.errors import InputError
from calstudy.figures import CasesFigure
from calstudy.figures.comparison_spectra import look
from calstudy.figures.signal_loss import SIGMAS_95
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.products.tolerances import BAND, LIMIT, Fault, faults
from calstudy.run.task import Job

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calstudy.products.graph import Graph

ROW_HEIGHT = 1.7
LINEAR = 0.01
"""The axis of the bias is linear up to this, and logarithmic beyond."""
ZERO = 0.3
"""Where severity zero is drawn, relative to the lowest other one."""


@style.journal_style()
def draw_tolerances(
    found: Sequence[Fault],
    cases: Mapping[str, Mapping[str, Case]],
    calibrators: Sequence[str],
    stand_ins: Sequence[str] = (),
    eor_level: float | None = None,
) -> Figure:
    """Draw the bias on the left and T on the right against the severity of each fault, with 95 % bars.

    Both are in the band of k in which tolerances are judged. The dashed line is the bias that is tolerated.

    Parameters
    ----------
    found
        The faults.
    cases
        By world and calibrator.
    calibrators
        Their labels, in order.
    stand_ins
        See `calstudy.plotting.style.note_stand_ins`.
    eor_level
        Amplitude of the EoR over that of the foregrounds in dB, to which the bias is relative; None if cases differ in
        it, or it is not known.
    """
    from matplotlib.lines import Line2D

    figure = style.new_figure(style.TWO_COLUMNS, 0.6 + ROW_HEIGHT * len(found))
    grid = figure.subplots(len(found), 2, squeeze=False)
    for (left, right), fault in zip(grid, found, strict=True):
        for place, calibrator in enumerate(calibrators):
            _draw_points(left, fault, cases, calibrator, "bias", place)
            _draw_points(right, fault, cases, calibrator, "transfer", place)
        left.set_yscale("symlog", linthresh=LINEAR)
        left.axhline(LIMIT, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
        right.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
        left.set_ylabel(r"bias $s^2 P^{R_0} / P^S$")
        right.set_ylabel(r"$T$")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.set_xlabel(f"{fault.name} ({fault.unit})" if fault.unit else fault.name)
            positions = _positions(fault)
            axes.set_xticks(positions, [f"{severity:g}" for severity in fault.severities])
            axes.set_xticks([], minor=True)
    band = rf"$k = {BAND[0]:g}$–${BAND[1]:g}$ $h\,\mathrm{{Mpc}}^{{-1}}$"
    level = "" if eor_level is None else rf", EoR at ${eor_level:g}$ dB of the foregrounds"
    grid[0, 0].set_title(band + level, loc="left")
    scored = {name for found in cases.values() for name in found}
    looks = {name: look(place) for place, name in enumerate(calibrators) if name in scored}
    handles = [Line2D([], [], linewidth=0.7, **its) for its in looks.values()]
    figure.legend(handles, list(looks), loc="outside upper center", ncols=min(len(looks), 5))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _positions(fault: Fault) -> np.ndarray:
    severities = np.array(fault.severities)
    return np.where(severities > 0, severities, ZERO * severities[severities > 0].min())


def _draw_points(
    axes: Axes, fault: Fault, cases: Mapping[str, Mapping[str, Case]], calibrator: str, name: str, place: int
) -> None:
    there = [calibrator in cases[world] for world in fault.worlds]
    bands = [cases[world][calibrator].bands for world in fault.worlds if calibrator in cases[world]]
    if not bands:
        return
    band = int(np.argmin(np.abs(bands[0].bin_edges[:-1] - BAND[0])))
    values, errors = (np.array([getattr(item, column)[band] for item in bands]) for column in (name, f"{name}_error"))
    axes.errorbar(
        _positions(fault)[there],
        values,
        yerr=SIGMAS_95 * np.nan_to_num(errors),
        elinewidth=0.6,
        linewidth=0.7,
        **look(place),
    )


class ComparisonTolerances(CasesFigure):
    """Bias and T against the severity of each fault: of worlds with labels such as ``positions: 2 cm``."""

    version: ClassVar[int] = 2
    caption = (
        "Bias (left) and transfer function (right) against the severity of faults, with 95 % bars. The bias is in "
        "units of the EoR, whose level is written above."
    )

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the level of the EoR, to which all biases are relative."""
        return {"eor_level": graph.experiment.corruption.eor_level}

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw a row for each fault; raises InputError if the worlds name none."""
        found = faults(job.settings["worlds"])
        if not found:
            raise InputError(
                f"figure {self.label!r}: no world has a label with a fault and a number, such as 'positions: 2 cm'"
            )
        labels, notes = job.settings["calibrators"], job.settings["notes"]
        return draw_tolerances(found, cases, labels, notes, job.settings.get("eor_level"))
