"""The difference of two sets of gains, by antenna, channel and delay."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calstudy.calibrate.gain_comparison import GainDifference
from calstudy.plotting import style

MOST_NAMES = 40
"""Largest number of antennas that are named on the axis."""


@style.journal_style()
def draw_gain_difference(found: GainDifference) -> Figure:
    """Draw the relative difference by antenna, by channel and by delay, on logarithmic axes."""
    figure = style.new_figure(style.TWO_COLUMNS, 2.4)
    by_antenna, by_channel, by_delay = figure.subplots(1, 3)
    place = np.arange(found.of_antenna.size)
    by_antenna.plot(place, found.of_antenna, "o", color=style.BLUE)
    if place.size <= MOST_NAMES:
        by_antenna.set_xticks(place, found.pair.antennas, rotation=90, fontsize=style.NOTE_SIZE)
    by_antenna.set_xlabel("antenna")
    by_antenna.set_ylabel("rms difference / rms")
    by_channel.plot(found.pair.frequency / 1e6, found.of_channel, color=style.BLUE)
    by_channel.set_xlabel(style.FREQUENCY)
    by_delay.plot(1e9 * found.delay, found.of_delay, color=style.BLUE)
    by_delay.set_xlabel(style.DELAY)
    for axes in (by_antenna, by_channel, by_delay):
        if np.nanmax(axes.lines[0].get_ydata()) > 0:
            axes.set_yscale("log")
    by_channel.set_title(f"feed {found.pair.polarization}; together {together(found):.3g}")
    return figure


def together(found: GainDifference) -> float:
    """Return the rms of the difference of all antennas over that of the second gains."""
    first, second = found.pair.first, found.pair.second
    return float(np.sqrt(np.sum(np.abs(first - second) ** 2) / np.sum(np.abs(second) ** 2)))
