"""Delay transforms of the reflection gains (the paper's Fig. DELAYTRANSFORMGAINS)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calstudy.figures import style
from calstudy.figures.domains import TwoDomains
from calstudy.figures.panels import delay_panel


@style.journal_style()
def draw_reflections(gains: TwoDomains, max_delay: float = 4e-6, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw the amplitude of every antenna's gain transform, and their median, in one column.

    Parameters
    ----------
    gains
        Gains of shape (Nants, Nfreqs), see `calstudy.figures.domains.in_two_domains`.
    max_delay
        Delays from -max_delay / 4 to max_delay are shown, seconds: Eq. REFGAIN has its peaks at positive delays.
    stand_ins
        See `calstudy.figures.style.note_stand_ins`.
    """
    amplitude = np.abs(gains.transform)
    figure = style.new_figure(style.ONE_COLUMN, 2.7)
    axes = figure.subplots()
    nanoseconds = gains.delay * 1e9
    lines = axes.plot(nanoseconds, amplitude.T, color=style.CYAN, linewidth=0.4, alpha=0.7)
    lines[0].set_label("each antenna")
    axes.plot(nanoseconds, np.median(amplitude, axis=0), color=style.BLACK, label="median")
    delay_panel(axes, gains.delay, r"$|\widetilde{g}(\tau)|$")
    shown = (gains.delay >= -max_delay / 4) & (gains.delay <= max_delay)
    # The nulls between the taper's sidelobes would take half of the axis.
    axes.set_ylim(0.3 * np.quantile(amplitude[:, shown], 0.02), 3 * amplitude.max())
    axes.set_xlim(*nanoseconds[shown][[0, -1]])
    axes.legend(loc="upper right")
    style.note_stand_ins(figure, stand_ins)
    return figure
