"""Axes that figures share: frequency beside delay, and baseline length against delay with the horizon."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from calstudy.plotting import style
from calstudy.power.delay import channel_width, delay_transform, delays, horizon_delay, make_taper

if TYPE_CHECKING:
    from matplotlib.collections import QuadMesh

    from calstudy.power.spectra import CylindricalSpectrum
    from calstudy.power.transfer import TransferMap


TAPER = "blackman-harris"
MAX_DELAY = 2e-6
"""Largest delay that is drawn, s, if the data have it."""


@dataclass(frozen=True)
class TwoDomains:
    """One or more complex spectra, (..., Nfreqs), in both domains.

    `frequency` is in Hz, and `delay` ascending in s, (Nfreqs,). `transform` are Blackman-Harris delay transforms in the
    unit of `values`: a constant spectrum has its own value at zero delay.
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
    width = channel_width(frequency)
    integral = width * make_taper(TAPER, frequency.size).sum()
    transform = delay_transform(values, frequency, TAPER) / integral
    return TwoDomains(frequency, delays(frequency.size, width), values, transform)


def frequency_and_delay(rows: int = 2) -> tuple[style.Figure, list[style.Axes], style.Axes]:
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


def delay_panel(axes: style.Axes, delay: np.ndarray, label: str) -> None:
    """Set scales and labels of axes of amplitudes against ascending `delay` (Ndelays,) s."""
    axes.set(yscale="log", xlabel=style.DELAY, ylabel=label, xlim=(delay[0] * 1e9, delay[-1] * 1e9))


def mark_horizon(axes: style.Axes, horizon: float, color: str = style.BLACK, zorder: float = 1) -> None:
    """Draw the edges of the wedge, ± `horizon` in s, as vertical dashed lines."""
    for sign in (-1, 1):
        axes.axvline(sign * horizon * 1e9, color=color, linestyle="--", linewidth=0.7, zorder=zorder)


def name_baseline(axes: style.Axes, antennas: tuple[int, int], baseline_length: float) -> None:
    """Write the antenna numbers and the length in m of a baseline into the upper right corner."""
    a, b = antennas
    label = rf"({a}, {b}), $|\mathbf{{b}}| = {baseline_length:.1f}$ m"
    axes.text(0.97, 0.95, label, transform=axes.transAxes, ha="right", va="top", fontsize=style.SMALL_SIZE + 0.5)


Cylinder: TypeAlias = "CylindricalSpectrum | TransferMap"


def delay_edges(centres: np.ndarray) -> np.ndarray:
    """Return the (N + 1,) edges halfway between (N,) increasing centres >= 0; none is below 0."""
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[max(2 * centres[0] - middle[0], 0.0)], middle, [2 * centres[-1] - middle[-1]]])


def draw_cells(axes: style.Axes, cylinder: Cylinder, values: np.ndarray, **look: Any) -> QuadMesh:
    """Draw values (Nb, Nd) over k_perp and k_parallel, and grey where they are not known or there are no baselines."""
    lengths = np.unique(cylinder.bin_edges)
    # There are cells between bins of lengths that are not adjacent.
    grid = np.full((cylinder.delay.size, lengths.size - 1), np.nan)
    grid[:, np.searchsorted(lengths, cylinder.bin_edges[:, 0])] = values.T
    axes.set_facecolor("0.8")
    k_perp = lengths * ratio(cylinder.k_perp, cylinder.baseline_length)
    cells = np.ma.masked_invalid(grid)
    return axes.pcolormesh(k_perp, delay_edges(cylinder.k_parallel), cells, rasterized=True, **look)


def draw_horizon(axes: style.Axes, cylinder: Cylinder, buffer: float, colour: str = "black") -> None:
    """Draw the horizon and, dashed, the delay `buffer` (s) beyond it, on axes of k_perp and k_parallel in h/Mpc."""
    lengths = cylinder.bin_edges[[0, -1], [0, 1]]
    k_perp = lengths * ratio(cylinder.k_perp, cylinder.baseline_length)
    per_second = ratio(cylinder.k_parallel, cylinder.delay)
    for extra, line, label in horizon_lines(buffer):
        edge = (horizon_delay(lengths) + extra) * per_second
        axes.plot(k_perp, edge, line, color=colour, linewidth=0.8, label=label)


def horizon_lines(buffer: float) -> tuple[tuple[float, str, str], ...]:
    """Return delays beyond the horizon, s, with their lines and labels."""
    return (0.0, "-", "horizon"), (buffer, "--", f"horizon + {buffer * 1e9:.0f} ns")


def name_horizon(axes: style.Axes) -> None:
    """Add the legend of `draw_horizon`."""
    axes.legend(loc="upper right", frameon=True, framealpha=0.9, edgecolor="none", fontsize=style.NOTE_SIZE)


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> float:
    """Return the constant factor between two proportional axes."""
    return float(numerator[-1] / denominator[-1])


def _scaled_by(factor: float) -> tuple[partial, partial]:
    """Return the transform to an axis that is `factor` times another, and its inverse."""
    return partial(np.multiply, factor), partial(np.multiply, 1 / factor)


def label_axes(axes: style.Axes, cylinder: Cylinder) -> None:
    """Set limits, with delays up to `MAX_DELAY`, and label k_perp (h/Mpc) below and metres above."""
    from matplotlib.ticker import MaxNLocator

    metres = ratio(cylinder.baseline_length, cylinder.k_perp)
    shortest, longest = cylinder.bin_edges[[0, -1], [0, 1]]
    top = min(delay_edges(cylinder.k_parallel)[-1], MAX_DELAY * ratio(cylinder.k_parallel, cylinder.delay))
    axes.set(xlim=(shortest / metres, longest / metres), ylim=(0, top), xlabel=style.K_PERPENDICULAR)
    axes.tick_params(which="both", top=False, right=False, direction="out")
    axes.locator_params(axis="x", nbins=3)
    lengths = axes.secondary_xaxis("top", functions=_scaled_by(metres))
    lengths.set_xlabel(style.BASELINE_LENGTH, fontsize=style.SMALL_SIZE, labelpad=2)
    lengths.tick_params(direction="out", labelsize=style.SMALL_SIZE, pad=1)
    lengths.xaxis.set_major_locator(MaxNLocator(nbins=3))


def delay_axis(axes: style.Axes, cylinder: Cylinder) -> None:
    """Add an axis of delays in ns on the right."""
    delays = axes.secondary_yaxis("right", functions=_scaled_by(1e9 * ratio(cylinder.delay, cylinder.k_parallel)))
    delays.set_ylabel(style.DELAY)
    delays.tick_params(direction="out")
