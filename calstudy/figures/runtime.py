"""Run time per optimizer step against array size (the paper's Figs. ANTPOS_RUNTIME and MAXBL_RUNTIME)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from calstudy.figures import style

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.MAGENTA)
MARKERS = ("o", "s", "D", "^")


@dataclass(frozen=True)
class RuntimeSeries:
    """Run times of one machine or solver.

    Attributes
    ----------
    label
        Machine or solver.
    size
        Number of antennas, or longest baseline in m, (Nsizes,), increasing.
    median, low, high
        Median and ends of the central 95 % of the run times, (Nsizes,), s.
    amplitude, exponent
        The fit median = amplitude · size^exponent, s and 1.
    """

    label: str
    size: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    amplitude: float
    exponent: float


def summarize_runtime(label: str, size: np.ndarray, seconds: np.ndarray) -> RuntimeSeries:
    """Reduce measured run times to medians, 95 % bands and a power law.

    Parameters
    ----------
    label
        Machine or solver.
    size
        Number of antennas or longest baseline, (Nsizes,), at least two.
    seconds
        Run times of single steps, (Nsizes, Nsteps).

    Raises
    ------
    ValueError
        If there are fewer than two sizes, the shapes do not match or a time is not positive.
    """
    size, seconds = np.asarray(size, dtype=float), np.asarray(seconds, dtype=float)
    if size.size < 2 or seconds.ndim != 2 or len(seconds) != size.size or not (seconds > 0).all():
        raise ValueError(
            f"run times '{label}': expected positive times (Nsizes, Nsteps) at two sizes or more, "
            f"got {seconds.shape} for {size.size} sizes"
        )
    low, median, high = np.quantile(seconds, [0.025, 0.5, 0.975], axis=1)
    exponent, logarithm = np.polyfit(np.log(size), np.log(median), 1)
    return RuntimeSeries(label, size, median, low, high, float(np.exp(logarithm)), float(exponent))


@style.journal_style()
def draw_runtime(
    series: Sequence[RuntimeSeries], size_label: str, symbol: str = r"\mathrm{size}", stand_ins: Sequence[str] = ()
) -> Figure:
    r"""Draw medians (markers), 95 % bands and fitted power laws (lines) on logarithmic axes, in one column.

    Parameters
    ----------
    series
        One to four.
    size_label
        Label of the lower axis with its unit, such as ``"number of antennas"`` or ``"longest baseline (m)"``.
    symbol
        The size in mathematical notation, for the fits in the legend: ``r"N_\mathrm{ant}"``.
    stand_ins
        See `calstudy.figures.style.note_stand_ins`.

    Raises
    ------
    ValueError
        If there are not one to four series.
    """
    if not 1 <= len(series) <= len(COLOURS):
        raise ValueError(f"a run-time figure has 1 to {len(COLOURS)} series, not {len(series)}")
    figure = style.new_figure(style.ONE_COLUMN, 2.8)
    axes = figure.subplots()
    for item, colour, marker in zip(series, COLOURS, MARKERS, strict=False):
        axes.fill_between(item.size, item.low, item.high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(item.size, item.median, marker, color=colour, markersize=4, label=item.label)
        fit = item.amplitude * item.size**item.exponent
        axes.plot(item.size, fit, color=colour, linewidth=0.8, label=rf"$\propto {symbol}^{{\,{item.exponent:.2f}}}$")
    axes.set(xscale="log", yscale="log", xlabel=size_label, ylabel="time per step (s)")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.legend(loc="upper left", ncols=len(series) if len(series) > 1 else 1)
    style.note_stand_ins(figure, stand_ins)
    return figure
