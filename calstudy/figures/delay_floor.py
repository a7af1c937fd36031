"""The delay floor of simulated foregrounds for each interpolation of the beam in frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calstudy.checks.floor import InterpolationFloor
from calstudy.figures import style
from calstudy.figures.beam_fit import INTERPOLATION_COLOURS

PAPER_FLOOR = -45.0
"""Artefacts of beam interpolation in the paper, dB of brightness."""
LINES = {"dolph-chebyshev": "-", "blackman-harris": ":"}


@style.journal_style()
def draw_delay_floors(
    floors: Mapping[str, InterpolationFloor], eor_level: float | None, stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw delay spectra of short baselines (left) and the floor beyond the horizon against baseline length (right).

    Parameters
    ----------
    floors
        By interpolation.
    eor_level
        Level of the EoR that is marked, amplitude dB, or None.
    stand_ins
        Printed below.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, sharey=True)
    for name, floor in floors.items():
        colour = INTERPOLATION_COLOURS[name]
        left.plot(floor.delay * 1e9, 10 * np.log10(floor.spectrum), color=colour, linewidth=0.8, label=name)
        for taper, line in LINES.items():
            _draw_steps(right, floor, taper, {"color": colour, "linestyle": line})
    horizon = next(iter(floors.values())).horizon
    left.axvline(horizon * 1e9, color=style.BLACK, linestyle="--", linewidth=0.7)
    for axes in (left, right):
        axes.axhline(PAPER_FLOOR, color=style.GREY, linewidth=0.6, linestyle="-.")
        if eor_level is not None:
            axes.axhline(eor_level, color=style.BLACK, linewidth=0.6)
    left.set(xlabel=style.DELAY, ylabel="brightness relative to peak (dB)", ylim=(-105, 3))
    left.margins(x=0)
    right.set(xlabel=style.BASELINE_LENGTH)
    for line, label in (("-", "Dolph–Chebyshev"), (":", "Blackman–Harris"), ("-.", "paper's artefacts")):
        right.plot([], [], color=style.GREY, linestyle=line, label=label)
    if eor_level is not None:
        right.plot([], [], color=style.BLACK, linewidth=0.6, label="EoR asked for")
    right.legend(loc="upper right")
    left.legend(loc="upper right")
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_steps(axes: Axes, floor: InterpolationFloor, taper: str, look: dict[str, str]) -> None:
    measured = floor.floors[taper]
    axes.stairs(measured.rms_db, measured.edges, baseline=None, linewidth=1.0, **look)
