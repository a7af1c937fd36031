"""RMS over time of delay-transformed visibilities (the paper's Figs. INSPECT_BLS and INSPECT_BLS_LOW_SNR)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.gains import inspected_calibration
from calstudy.plotting import style
from calstudy.plotting.axes import TAPER, mark_horizon, name_baseline
from calstudy.power.delay import channel_width, delay_transform, delays, horizon_delay
from calstudy.products import corruption
from calstudy.products.files import DATA, MODEL, RESIDUAL
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, scatter_of_noise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class BaselineSpectra:
    """RMS over integrations of one baseline's delay transforms, each (Ndelays,) real, Jy Hz.

    `data` are the uncalibrated visibilities V, `model` the fitted foregrounds times gains, ĝ_a ĝ_b* F̂, `residual` the
    calibrated residuals R, and `uncorrupted` S+F+N without gain errors, if they are to be drawn. `baseline_length` is
    |b| in m; delays are ascending, s.
    """

    antennas: tuple[int, int]
    baseline_length: float
    delay: np.ndarray
    data: np.ndarray
    model: np.ndarray
    residual: np.ndarray
    noise: np.ndarray
    uncorrupted: np.ndarray | None = None


LINES: dict[str, tuple[str, dict[str, Any]]] = {
    "uncorrupted": (r"$S+F+N$", {"color": style.BLACK, "linestyle": "-", "linewidth": 0.8}),
    "data": (r"uncalibrated $V$", {"color": style.GREY, "linestyle": "-", "linewidth": 1.6}),
    "model": (r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$", {"color": style.MAGENTA, "linestyle": "-", "linewidth": 0.7}),
    "noise": (r"noise $N$", {"color": style.ORANGE, "linestyle": ":", "linewidth": 1.3}),
    "residual": (r"residual $R$", {"color": style.CYAN, "linestyle": "--", "linewidth": 1.1}),
}


@style.journal_style()
def draw_baselines(baselines: Sequence[BaselineSpectra]) -> Figure:
    """Draw one panel per baseline, at least one, on common axes, with the edges of the wedge.

    A single baseline fills one column.
    """
    if not baselines:
        raise ValueError("a figure of baselines needs at least one baseline")
    n_columns = min(2, len(baselines))
    n_rows = -(-len(baselines) // n_columns)
    width = style.ONE_COLUMN if n_columns == 1 else style.TWO_COLUMNS
    figure = style.new_figure(width, 0.9 + 2.0 * n_rows if n_columns == 2 else 3.1)
    grid = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes, spectra in zip(grid.flat, baselines, strict=False):
        _draw_baseline(axes, spectra)
    for axes in grid.flat[len(baselines) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(r"RMS $|\widetilde{V}(\tau)|$ (Jy Hz)")
    for column, axes in enumerate(grid[-1]):
        lowest = axes if axes.get_visible() else grid[-2, column]
        lowest.set_xlabel(style.DELAY)
        lowest.tick_params(labelbottom=True)
    handles = grid[0, 0].get_lines()[: sum(getattr(baselines[0], name) is not None for name in LINES)]
    figure.legend(handles=handles, loc="outside upper center", ncols=3 if n_columns == 1 else 6)
    return figure


def _draw_baseline(axes: Axes, spectra: BaselineSpectra) -> None:
    for name, (label, look) in LINES.items():
        values = getattr(spectra, name)
        if values is not None:
            axes.plot(spectra.delay * 1e9, values, label=label, **look)
    mark_horizon(axes, horizon_delay(spectra.baseline_length))
    name_baseline(axes, spectra.antennas, spectra.baseline_length)
    axes.set(yscale="log", xlim=(spectra.delay[0] * 1e9, spectra.delay[-1] * 1e9))


SHOWN_BASELINES = 4
"""Number of baselines in the figure where the experiment names none."""


def rms_over_time(spectra: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Return the rms over integrations of the Blackman-Harris delay transforms, real, (..., Ndelays), Jy Hz.

    Spectra are visibilities in Jy, (..., Ntimes, Nfreqs); frequencies are channel centres in Hz, (Nfreqs,).
    """
    return np.sqrt(np.mean(np.abs(delay_transform(spectra, frequency, TAPER)) ** 2, axis=-2))


class Baselines(StudyFigure):
    """Data, model and residual of some baselines against delay."""

    kind: str = "baselines"

    caption = "RMS over time of delay-transformed visibilities of several baselines."
    variants = ("residual", "noise")
    needs_calibration = True
    tolerances = ((r".*", Drawn(scatter_of_noise, "the scatter over delays of the noise's rms over time", rms=3.0)),)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return calibration, data and noise, and uncorrupted data where the experiment has them."""
        variants, realization = graph.experiment.variants, graph.experiment.outputs.inspect.realization
        names = {"data": "residual", "noise": "noise", "uncorrupted": "uncorrupted"}
        inputs = {
            name: corruption.data(graph, variants[variant], realization)
            for name, variant in names.items()
            if variant in variants
        }
        return {"calibration": inspected_calibration(graph)["calibration"], **inputs}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baselines."""
        pairs = graph.experiment.outputs.inspect.baselines
        shown = None if pairs is None else [list(pair) for pair in pairs]
        return {"layout": graph.experiment.instrument.layout, "baselines": shown}

    def draw(self, job: Job) -> Drawing:
        """Draw the RMS over time of delay transforms of some baselines."""
        from calstudy.products.selection import (
            baseline,
            layout_of,
            read_gains,
            read_spectra,
            read_used,
            spread_in_length,
        )

        layout = layout_of(job.settings["layout"])
        places = job.settings["baselines"] or spread_in_length(layout, SHOWN_BASELINES)
        pairs, lengths = zip(*(baseline(layout, place) for place in places), strict=True)
        gains = read_gains(job.inputs["calibration"])
        residual = read_spectra(job.inputs["calibration"] / RESIDUAL, pairs)
        sides = ([pair[side] for pair in pairs] for side in (0, 1))
        first, second = (gains.over(residual.shape[1], numbers).swapaxes(0, 1) for numbers in sides)
        model = first * second.conj() * read_spectra(job.inputs["calibration"] / MODEL, pairs)
        spectra = {"residual": residual, "model": model}
        measured = [name for name in ("data", "noise", "uncorrupted") if name in job.inputs]
        spectra |= {name: read_spectra(job.inputs[name] / DATA, pairs) for name in measured}
        used = read_used(job.inputs["calibration"] / RESIDUAL, pairs)
        shown = {name: rms_over_time(used * values, gains.frequency) for name, values in spectra.items()}
        delay = delays(gains.frequency.size, channel_width(gains.frequency))
        panels = [
            BaselineSpectra(pair, length, delay, **{name: values[index] for name, values in shown.items()})
            for index, (pair, length) in enumerate(zip(pairs, lengths, strict=True))
        ]
        return Drawing(draw_baselines(panels), panels)
