"""Run time per optimizer step against array size (the paper's Figs. ANTPOS_RUNTIME and MAXBL_RUNTIME)."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from calstudy.bench.scaling import RuntimeSeries
from calstudy.figures import style

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.MAGENTA)
MARKERS = ("o", "s", "D", "^")
MOST = 2 * len(COLOURS)
"""Series in one figure; the second four have open markers and broken lines."""


@style.journal_style()
def draw_runtime(
    series: Sequence[RuntimeSeries],
    size_label: str,
    symbol: str = r"\mathrm{size}",
    stand_ins: Sequence[str] = (),
    time_label: str = "time per step (s)",
) -> Figure:
    r"""Draw medians (markers), 95 % bands and fitted power laws (lines) on logarithmic axes, in one column.

    Parameters
    ----------
    series
        One to eight.
    size_label
        Label of the lower axis with its unit, such as ``"number of antennas"`` or ``"longest baseline (m)"``.
    symbol
        The size in mathematical notation, for the fits in the legend: ``r"N_\mathrm{ant}"``.
    stand_ins
        See `calstudy.figures.style.note_stand_ins`.
    time_label
        Label of the upright axis with its unit.

    Raises
    ------
    ValueError
        If there are not one to eight series.
    """
    if not 1 <= len(series) <= MOST:
        raise ValueError(f"a run-time figure has 1 to {MOST} series, not {len(series)}")
    figure = style.new_figure(style.ONE_COLUMN, 2.7 + 0.14 * len(series))
    axes = figure.subplots()
    for index, item in enumerate(series):
        colour, marker = COLOURS[index % len(COLOURS)], MARKERS[index % len(COLOURS)]
        filled = index < len(COLOURS)
        axes.fill_between(item.size, item.low, item.high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(item.size, item.median, marker, color=colour, markersize=4, markerfacecolor=colour if filled else "w")
        axes.plot(item.size, item.fit.at(item.size), color=colour, linewidth=0.8, linestyle="-" if filled else "--")
    axes.set(xscale="log", yscale="log", xlabel=size_label, ylabel=time_label)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    _add_legend(figure, series, symbol)
    style.note_stand_ins(figure, stand_ins)
    return figure


def _add_legend(figure: Figure, series: Sequence[RuntimeSeries], symbol: str) -> None:
    """Put one line per series above the axes: its marker on its fit, what it is, and the fitted exponent."""
    lines = figure.axes[0].get_lines()
    handles = [(lines[2 * index + 1], lines[2 * index]) for index in range(len(series))]
    labels = [
        rf"{item.label} $\propto {symbol}^{{\,{item.fit.exponent:.2f} \pm {item.fit.error:.2f}}}$" for item in series
    ]
    figure.legend(handles, labels, loc="outside upper left", ncols=1)
