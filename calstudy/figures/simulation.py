"""The simulated components alone: wedge of F, P(k) of S against its input, delay spectra of three baselines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from calstudy.checks.simulation import BaselineDelays, SimulationLook
from calstudy.figures import style
from calstudy.figures.cylinder import cells, draw_horizon, label_axes
from calstudy.figures.domains import horizon_delay
from calstudy.figures.spherical import SIGMAS_95
from calstudy.figures.wedge import EMPTY, POSITIVE

MAX_DELAY = 2e-6


@style.journal_style()
def draw_simulation(look: SimulationLook, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw the wedge of F and P(k) of S above, and delay spectra of a short, a middle and a long baseline below.

    Parameters
    ----------
    look
        What was measured.
    stand_ins
        Printed below.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 5.2)
    above, below = figure.subfigures(2, 1, height_ratios=(1.25, 1))
    wedge, spherical = above.subplots(1, 2)
    _draw_wedge(above, wedge, look)
    _draw_power(spherical, look)
    panels = below.subplots(1, len(look.baselines), sharey=True)
    for axes, baseline in zip(panels, look.baselines, strict=True):
        _draw_baseline(axes, baseline, look.buffer)
    panels[0].set_ylabel(r"rms $|\widetilde{V}(\tau)|$ (Jy Hz)")
    handles, labels = panels[0].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_wedge(figure: Figure, axes: Axes, look: SimulationLook) -> None:
    x, y, power = cells(look.wedge, np.abs(look.wedge.power.real))
    shown = power[np.isfinite(power) & (power > 0)]
    norm = LogNorm(10 ** np.floor(np.log10(np.quantile(shown, 0.01))), 10 ** np.ceil(np.log10(shown.max())))
    axes.set_facecolor(EMPTY)
    filled = np.ma.maximum(np.ma.masked_invalid(power), norm.vmin)
    mesh = axes.pcolormesh(x, y, filled, norm=norm, cmap=POSITIVE, rasterized=True)
    draw_horizon(axes, look.wedge, look.buffer)
    label_axes(axes, look.wedge, MAX_DELAY)
    axes.set_ylabel(style.K_PARALLEL)
    axes.legend(loc="upper right", frameon=True, framealpha=0.9, edgecolor="none", fontsize=style.NOTE_SIZE)
    bar = figure.colorbar(mesh, ax=axes, pad=0.02)
    bar.set_label(rf"$|P^F|$ ({style.POWER_UNIT})")
    bar.ax.tick_params(which="both", direction="out")


def _draw_power(axes: Axes, look: SimulationLook) -> None:
    spectrum = look.eor
    finite = np.isfinite(spectrum.power.real)
    ratio = spectrum.power.real[finite] / look.expected[finite]
    half = SIGMAS_95 * spectrum.error[finite] / look.expected[finite]
    axes.axhline(1, color=style.BLACK, linewidth=0.9, zorder=3)
    axes.errorbar(spectrum.k[finite], ratio, half, fmt="o", color=style.BLUE, markersize=2.2, elinewidth=0.7)
    reach = 1.05 * float(np.max(np.abs(ratio - 1) + half))
    axes.set(xscale="log", xlabel=style.WAVENUMBER, ylabel=r"$P^S$ over its input", ylim=(1 - reach, 1 + reach))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title("bars: 95 % of the sample variance", fontsize=style.SMALL_SIZE)


def _draw_baseline(axes: Axes, baseline: BaselineDelays, buffer: float) -> None:
    nanoseconds = baseline.delay * 1e9
    axes.plot(nanoseconds, baseline.foregrounds, color=style.RED, linewidth=0.9, label="$F$")
    axes.plot(nanoseconds, baseline.eor, color=style.BLUE, linewidth=0.7, label="$S$, at the level on the data")
    horizon = horizon_delay(baseline.length)
    for extra, line, label in ((0.0, "-", "horizon"), (buffer, "--", f"horizon + {buffer * 1e9:.0f} ns")):
        for sign in (-1, 1):
            where = sign * (horizon + extra) * 1e9
            axes.axvline(where, color=style.BLACK, linestyle=line, linewidth=0.6, label=label if sign > 0 else None)
    span = min(MAX_DELAY, float(baseline.delay[-1])) * 1e9
    axes.set(yscale="log", xlabel=style.DELAY, xlim=(-span, span))
    first, second = baseline.antennas
    axes.set_title(rf"({first}, {second}), $|\mathbf{{b}}| = {baseline.length:.1f}$ m")
