"""Foregrounds of one engine against those of another: delay spectra of the difference, and its size by length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.constants import speed_of_light

from calstudy.checks.engine import EngineAgreement, GroupAgreement
from calstudy.figures import style

SHORT_AND_LONG = (style.BLUE, style.RED)


@style.journal_style()
def draw_engine_agreement(
    agreement: EngineAgreement,
    names: tuple[str, str],
    allowed: float,
    eor_level: float | None,
    stand_ins: Sequence[str] = (),
) -> Figure:
    """Draw delay spectra of short and long baselines (left) and relative differences against baseline length (right).

    Parameters
    ----------
    agreement
        Of the two simulations.
    names
        Of the engine and of the reference.
    allowed
        Sum of the node tolerances of both, relative to the rms.
    eor_level
        Level of the EoR that is marked, amplitude dB, or None.
    stand_ins
        Printed below.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.1)
    left, right = figure.subplots(1, 2)
    ends = (agreement.groups[0], agreement.groups[-1])
    for group, colour in zip(ends, SHORT_AND_LONG, strict=True):
        _draw_spectra(left, group, colour)
    if eor_level is not None:
        left.axhline(eor_level, color=style.BLACK, linewidth=0.6, label="EoR asked for")
    left.set(xlabel=style.DELAY, ylabel="brightness relative to peak (dB)")
    left.margins(x=0)
    left.legend(loc="upper right", frameon=True, framealpha=0.95, edgecolor="none")
    for name, label, line in (("largest", "largest", "-"), ("rms", "rms", "--")):
        values = [getattr(group, name) for group in agreement.groups]
        shortest, longest = zip(*((group.shortest, group.longest) for group in agreement.groups), strict=True)
        right.hlines(values, shortest, longest, color=style.BLUE, linestyle=line, linewidth=1.2, label=label)
    right.axhline(allowed, color=style.GREY, linestyle="-.", linewidth=0.8, label="sum of node tolerances")
    right.set(yscale="log", xlabel=style.BASELINE_LENGTH, ylabel=f"|{names[0]} − {names[1]}| / rms")
    right.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, columnspacing=1.0)
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_spectra(axes: Axes, group: GroupAgreement, colour: str) -> None:
    span = f"{group.shortest:.0f} to {group.longest:.0f} m"
    for values, line, label in ((group.spectrum, "-", f"F, {span}"), (group.difference, ":", f"difference, {span}")):
        level = 10 * np.log10(np.maximum(values, np.finfo(float).tiny))
        axes.plot(group.delay * 1e9, level, line, color=colour, linewidth=0.9, label=label)
    axes.axvline(group.longest / speed_of_light * 1e9, color=colour, linestyle="--", linewidth=0.6)
