"""Run time per optimizer step against array size (the paper's Figs. ANTPOS_RUNTIME and MAXBL_RUNTIME)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.products.files import read_json
from calstudy.products.run_times import CASE, QUANTILES, PowerLaw, fit_power_law
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import MACHINE

LOOKS = style.SERIES[:4]
SHOWN = {
    "paper-step": "paper's Adamax, step",
    "adamax-step": "our Adamax, step",
    "default-step": "default solver, step",
    "default-solve": "default solver, solve",
}
"""Labels of the timings that the figures show."""
AXES = {"rows": ("number of antennas", r"N_\mathrm{ant}"), "line": ("longest baseline (m)", r"b_\mathrm{max}")}
CLOCKS = {"cpu": "one core", "gpu": "GPU"}


@dataclass(frozen=True)
class RuntimeSeries:
    """Run times of one machine or solver: median and ends of the central 95 %, (Nsizes,), s.

    `size` is the number of antennas, or the longest baseline in m, increasing; `fit` gives the medians as a power of
    it.
    """

    label: str
    size: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    fit: PowerLaw


def summarize_runtime(label: str, size: ArrayLike, seconds: Sequence[Sequence[float]]) -> RuntimeSeries:
    """Reduce the run times of every size to medians, 95 % bands and a power law; raise what `fit_power_law` raises."""
    sizes = np.asarray(size, dtype=float)
    low, median, high = np.array([np.quantile(item, QUANTILES) for item in seconds]).T
    return RuntimeSeries(label, sizes, median, low, high, fit_power_law(sizes, median))


def draw_runtime(
    series: Sequence[RuntimeSeries],
    size_label: str,
    symbol: str = r"\mathrm{size}",
    time_label: str = "time per step (s)",
) -> style.Figure:
    r"""Draw medians (markers), 95 % bands and fitted power laws (lines) on logarithmic axes, in one column.

    There are up to eight series, of which the second four have open markers and broken lines. `size_label` and
    `time_label` include the unit, such as ``"longest baseline (m)"``; `symbol` is the size in mathematical notation,
    for the fits in the legend: ``r"N_\mathrm{ant}"``.
    """
    figure = style.new_figure(style.ONE_COLUMN, 2.7 + 0.14 * len(series))
    axes = figure.subplots()
    # A marker on its fit, and the fitted exponent.
    entries: dict[str, Any] = {}
    for index, item in enumerate(series):
        filled, (marker, colour) = index < len(LOOKS), LOOKS[index % len(LOOKS)]
        axes.fill_between(item.size, item.low, item.high, color=colour, alpha=0.25, linewidth=0)
        look: dict[str, Any] = {"color": colour, "markersize": 4, "markerfacecolor": colour if filled else "w"}
        (points,) = axes.plot(item.size, item.median, marker, **look)
        line = "-" if filled else "--"
        (fit,) = axes.plot(item.size, item.fit.at(item.size), line, color=colour, linewidth=0.8)
        power = rf"$\propto {symbol}^{{\,{item.fit.exponent:.2f} \pm {item.fit.error:.2f}}}$"
        entries[f"{item.label} {power}"] = (fit, points)
    axes.set(xscale="log", yscale="log", xlabel=size_label, ylabel=time_label)
    style.label_one_two_five(axes.xaxis)
    figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=1)
    return figure


class Runtime(StudyFigure):
    """Time per step, or per solve, of the solvers against the size of the array."""

    kind: str = "runtime"

    of = ("runtime",)
    caption = "Run time against the size of the array: medians, central 95 %, fitted powers."
    tolerances = ((r".*", MACHINE),)

    panel: Literal["rows", "line"] = "rows"

    @property
    def label(self) -> str:
        """The name with the panel."""
        return f"runtime-{self.panel}"

    def draw(self, job: Job) -> Drawing:
        """Draw the time per step against the number of antennas, or against the longest baseline."""
        cases = [read_json(folder / CASE) for folder in job.inputs.values()]
        series = _series(cases)
        label, symbol = AXES[self.panel]
        clock = "processor time" if {case["device"] for case in cases} == {"cpu"} else "time"
        figure = draw_runtime(series, label, symbol, f"{clock} per step, or solve (s)")
        notes = {item.label: f"{item.fit.exponent:.2f} ± {item.fit.error:.2f}" for item in series}
        return Drawing(figure, series, notes)


def _series(cases: Sequence[Mapping[str, Any]]) -> list[RuntimeSeries]:
    """Return the shown run times, solver after solver, for each device."""
    devices = sorted({case["device"] for case in cases})
    series = []
    for device in devices:
        found = sorted((case for case in cases if case["device"] == device), key=lambda case: case["size"])
        sizes = [case["size"] for case in found]
        for kind, label in SHOWN.items():
            shown = label if devices == ["cpu"] else f"{label}, {CLOCKS[device]}"
            series.append(summarize_runtime(shown, sizes, [case["seconds"][kind] for case in found]))
    return series
