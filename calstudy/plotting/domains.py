"""Quantities in frequency and in delay, and the axes of the calibration figures: one on the left, the other right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from calstudy.plotting import style
from calstudy.power.delay import channel_width, delay_transform, delays, make_taper

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TAPER = "blackman-harris"
FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)


@dataclass(frozen=True)
class TwoDomains:
    """One or more complex spectra, (..., Nfreqs), in both domains.

    `frequency` are the channel centres, (Nfreqs,), Hz, and `delay` is ascending, (Nfreqs,), s. `transform` are
    Blackman-Harris delay transforms in the unit of `values`: a constant spectrum has its own value at zero delay.
    """

    frequency: np.ndarray
    delay: np.ndarray
    values: np.ndarray
    transform: np.ndarray

    @property
    def real(self) -> np.ndarray:
        """Real parts of the spectra for a plot against frequency, NaN where they are zero, that is flagged."""
        return np.where(self.values == 0, np.nan, self.values.real)


def in_two_domains(frequency: np.ndarray, values: np.ndarray) -> TwoDomains:
    """Transform spectra (..., Nfreqs) on channels `frequency` (Nfreqs,) Hz to delay.

    Raises ValueError if the channels are not equally spaced and ascending or do not match the spectra.
    """
    values = np.asarray(values)
    width = channel_width(frequency)
    integral = width * make_taper(TAPER, frequency.size).sum()
    transform = delay_transform(values, frequency, TAPER) / integral
    return TwoDomains(frequency, delays(frequency.size, width), values, transform)


def frequency_and_delay(rows: int = 2) -> tuple[Figure, list[Axes], Axes]:
    """Return a figure with `rows` axes against frequency stacked on the left, and one against delay on the right."""
    figure = style.new_figure(style.TWO_COLUMNS, 1.7 + 0.8 * rows)
    axes = figure.subplot_mosaic([[str(row), "delay"] for row in range(rows)])
    stacked = [axes[str(row)] for row in range(rows)]
    for upper in stacked[:-1]:
        upper.sharex(stacked[-1])
        upper.tick_params(labelbottom=False)
    stacked[-1].set_xlabel(style.FREQUENCY)
    stacked[-1].margins(x=0)
    return figure, stacked, axes["delay"]


def delay_panel(axes: Axes, delay: np.ndarray, label: str) -> None:
    """Set scales and labels of axes of amplitudes against ascending `delay` (Ndelays,) s."""
    axes.set(yscale="log", xlabel=style.DELAY, ylabel=label, xlim=(delay[0] * 1e9, delay[-1] * 1e9))


def mark_horizon(axes: Axes, horizon: float) -> None:
    """Draw the edges of the wedge, ± `horizon` in s, as vertical dashed lines."""
    for sign in (-1, 1):
        axes.axvline(sign * horizon * 1e9, color=style.BLACK, linestyle="--", linewidth=0.7, zorder=1)


def name_baseline(axes: Axes, antennas: tuple[int, int], baseline_length: float) -> None:
    """Write the antenna numbers and the length in m of a baseline into the upper right corner."""
    a, b = antennas
    label = rf"({a}, {b}), $|\mathbf{{b}}| = {baseline_length:.1f}$ m"
    axes.text(0.97, 0.95, label, transform=axes.transAxes, ha="right", va="top", fontsize=style.SMALL_SIZE + 0.5)
