"""Visibilities of single baselines: data and model of one integration in frequency and delay, and the run's rms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calstudy.figures import Drawing, InspectedFigure, StudyFigure
from calstudy.instrument.layouts import make_layout
from calstudy.plotting import style
from calstudy.plotting.axes import (
    TAPER,
    TwoDomains,
    delay_panel,
    frequency_and_delay,
    in_two_domains,
    mark_horizon,
    name_baseline,
)
from calstudy.power.delay import channel_width, delay_transform, delays, horizon_delay
from calstudy.products import calibration, corruption, simulation
from calstudy.products.files import DATA, MODEL, RESIDUAL, VISIBILITIES
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, rms_of, scatter_of_noise


@dataclass(frozen=True)
class VisibilityComparison:
    """Spectra of one baseline at one integration in Jy, of which the residual is reference - model; |b| is in m."""

    antennas: tuple[int, int]
    baseline_length: float
    reference: TwoDomains
    model: TwoDomains
    residual: TwoDomains
    noise: TwoDomains


def compare_visibilities(
    baseline: tuple[tuple[int, int], float],
    frequency: np.ndarray,
    reference: np.ndarray,
    model: np.ndarray,
    noise: np.ndarray,
) -> VisibilityComparison:
    """Compare visibilities, (Nfreqs,) complex, Jy, on channels in Hz; a baseline is its antennas and |b| in m."""
    spectra = (in_two_domains(frequency, values) for values in (reference, model, reference - model, noise))
    return VisibilityComparison(*baseline, *spectra)


def draw_comparison(comparison: VisibilityComparison, labels: tuple[str, str]) -> style.Figure:
    """Draw real parts against frequency (left), and amplitudes of transforms and the wedge against delay (right).

    `labels` are the names of reference and model in the legend.
    """
    figure, (values, residuals), delays = frequency_and_delay()
    looks: tuple[tuple[style.Axes, TwoDomains, str, dict[str, Any]], ...] = (
        (values, comparison.reference, labels[0], {"color": style.BLACK, "linestyle": "-", "linewidth": 0.8}),
        (values, comparison.model, labels[1], {"color": style.ORANGE, "linestyle": "--", "linewidth": 0.9}),
        (residuals, comparison.noise, "thermal noise", {"color": style.MAGENTA, "linestyle": "-.", "linewidth": 0.8}),
        (residuals, comparison.residual, "residual", {"color": style.BLUE, "linestyle": ":", "linewidth": 1.1}),
    )
    for axes, spectrum, label, look in looks:
        axes.plot(spectrum.frequency / 1e6, spectrum.real, label=label, **look)
        delays.plot(spectrum.delay * 1e9, np.abs(spectrum.transform), label=label, **look)
    mark_horizon(delays, horizon_delay(comparison.baseline_length))
    values.set_ylabel(r"Re $V$ (Jy)")
    residuals.set_ylabel(r"Re residual (Jy)")
    delay_panel(delays, comparison.reference.delay, r"$|\widetilde{V}(\tau)|$ (Jy)")
    name_baseline(delays, comparison.antennas, comparison.baseline_length)
    figure.legend(handles=delays.get_lines()[:4], loc="outside upper center", ncols=4)
    return figure


def _inspected_spectra(job: Job, reference: Path) -> tuple[tuple[tuple[int, int], float], Iterator[np.ndarray]]:
    """Return the shown baseline and, in fitted channels, its reference, fitted model and noise."""
    from calstudy.products.selection import baseline, read_spectra, read_used, require_used

    integration = job.settings["integration"]
    pair, length = baseline(make_layout(job.settings["layout"]), job.settings["antennas"])
    paths = (reference, job.inputs["calibration"] / MODEL, job.inputs["noise"] / DATA)
    used = read_used(paths[1], [pair])[0, integration]
    require_used(used, pair, integration)
    return (pair, length), (used * read_spectra(path, [pair])[0, integration] for path in paths)


class Model(InspectedFigure):
    """True and fitted foregrounds of one baseline in one integration."""

    kind: str = "model"

    caption = "Foregrounds of one baseline: true and fitted."
    variants = ("residual", "noise")
    shown: ClassVar = {"noise": "noise"}
    needs_calibration = True
    tolerances = (
        (r"(model|residual)\..*", Drawn(rms_of("residual"), "the rms error of the model")),
        (r"noise\..*", Drawn(rms_of("noise"), "the rms of the noise")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return gains, calibration, true foregrounds and noise."""
        return {**super().inputs(graph), "foregrounds": required(simulation.foregrounds(graph))}

    def draw(self, job: Job) -> Drawing:
        """Draw the true foregrounds of a baseline and the fitted ones, on the scale of the true gains."""
        from calstudy.products.selection import read_aligned_gains

        baseline, (foregrounds, model, noise) = _inspected_spectra(job, job.inputs["foregrounds"] / VISIBILITIES)
        gains = read_aligned_gains(job.inputs["gains"], job.inputs["calibration"], job.settings["integration"])
        comparison = compare_visibilities(baseline, gains.frequency, foregrounds, model / gains.scale**2, noise)
        labels = (r"true foregrounds $F$", r"fitted model $\widehat{F}$")
        return Drawing(draw_comparison(comparison, labels), comparison)


class Data(InspectedFigure):
    """Data of one baseline and the fitted gains times model, in one integration."""

    kind: str = "data"

    caption = "Data of one baseline, fitted gains times model, and what is left."
    variants = ("residual", "noise")
    shown: ClassVar = {"data": "residual", "noise": "noise"}
    needs_calibration = True
    tolerances = ((r".*", Drawn(rms_of("noise"), "the rms of the noise")),)

    def draw(self, job: Job) -> Drawing:
        """Draw the data of a baseline with fitted gains times model, and with the noise in them."""
        from calstudy.products.selection import read_gains

        baseline, (data, model, noise) = _inspected_spectra(job, job.inputs["data"] / DATA)
        true, fitted = read_gains(job.inputs["gains"]), read_gains(job.inputs["calibration"])
        both = (gains.at(job.settings["integration"], baseline[0]) for gains in (true, fitted))
        corruption_factor, correction = (gains[0] * gains[1].conj() for gains in both)
        spectra = data, correction * model, corruption_factor * noise
        comparison = compare_visibilities(baseline, fitted.frequency, *spectra)
        labels = (r"data $V$", r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$")
        return Drawing(draw_comparison(comparison, labels), comparison)


@dataclass(frozen=True)
class BaselineSpectra:
    """RMS over integrations of one baseline's delay transforms, as in `LINES`, (Ndelays,) real, Jy Hz.

    `baseline_length` is |b| in m; delays are ascending, s.
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


def draw_baselines(baselines: Sequence[BaselineSpectra]) -> style.Figure:
    """Draw one panel per baseline on common axes, with the edges of the wedge; a single one fills one column."""
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
    entries = grid[0, 0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside upper center", ncols=3 if n_columns == 1 else 6)
    return figure


def _draw_baseline(axes: style.Axes, spectra: BaselineSpectra) -> None:
    for name, (label, look) in LINES.items():
        values = getattr(spectra, name)
        if values is not None:
            axes.plot(spectra.delay * 1e9, values, label=label, **look)
    mark_horizon(axes, horizon_delay(spectra.baseline_length))
    name_baseline(axes, spectra.antennas, spectra.baseline_length)
    axes.set(yscale="log", xlim=(spectra.delay[0] * 1e9, spectra.delay[-1] * 1e9))


SHOWN_BASELINES = 4
"""Number of baselines in the figure where the experiment names none."""


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
        shown = {"data": "residual", "noise": "noise", "uncorrupted": "uncorrupted"}
        names = {name: variant for name, variant in shown.items() if variant in variants}
        inputs = {name: corruption.data(graph, variants[variant], realization) for name, variant in names.items()}
        return {"calibration": calibration.calibration(graph, variants["residual"], realization), **inputs}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baselines."""
        pairs = graph.experiment.outputs.inspect.baselines
        shown = None if pairs is None else [list(pair) for pair in pairs]
        return {"layout": graph.experiment.instrument.layout, "baselines": shown}

    def draw(self, job: Job) -> Drawing:
        """Draw the RMS over time of delay transforms of some baselines."""
        from calstudy.products.selection import baseline, read_gains, read_spectra, read_used, spread_in_length

        layout = make_layout(job.settings["layout"])
        places = job.settings["baselines"] or spread_in_length(layout, SHOWN_BASELINES)
        pairs, lengths = zip(*(baseline(layout, place) for place in places), strict=True)
        gains = read_gains(job.inputs["calibration"])
        residual = read_spectra(job.inputs["calibration"] / RESIDUAL, pairs)
        sides = ([pair[side] for pair in pairs] for side in (0, 1))
        first, second = (gains.over(residual.shape[1], numbers).swapaxes(0, 1) for numbers in sides)
        model = first * second.conj() * read_spectra(job.inputs["calibration"] / MODEL, pairs)
        measured = [name for name in ("data", "noise", "uncorrupted") if name in job.inputs]
        data = {name: read_spectra(job.inputs[name] / DATA, pairs) for name in measured}
        used = read_used(job.inputs["calibration"] / RESIDUAL, pairs)
        shown = {}
        for name, values in {"residual": residual, "model": model, **data}.items():
            transform = delay_transform(used * values, gains.frequency, TAPER)
            shown[name] = np.sqrt(np.mean(np.abs(transform) ** 2, axis=-2))
        delay = delays(gains.frequency.size, channel_width(gains.frequency))
        panels = [
            BaselineSpectra(pair, length, delay, **{name: values[index] for name, values in shown.items()})
            for index, (pair, length) in enumerate(zip(pairs, lengths, strict=True))
        ]
        return Drawing(draw_baselines(panels), panels)
