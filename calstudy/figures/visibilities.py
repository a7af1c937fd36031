"""One visibility and its model, in frequency and delay (the paper's Figs. MODEL_RESID and CALIBRATED_RESID)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.gains import inspected, inspected_calibration
from calstudy.plotting import style
from calstudy.plotting.axes import (
    TwoDomains,
    delay_panel,
    frequency_and_delay,
    in_two_domains,
    mark_horizon,
    name_baseline,
)
from calstudy.power.delay import horizon_delay
from calstudy.products import corruption, simulation
from calstudy.products.files import DATA, MODEL, VISIBILITIES
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, rms_of

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class VisibilityComparison:
    """One baseline at one integration, with spectra (Nfreqs,) in Jy; `baseline_length` is |b| in m.

    The residual is reference - model, and the noise is the thermal noise in the data.
    """

    antennas: tuple[int, int]
    baseline_length: float
    reference: TwoDomains
    model: TwoDomains
    residual: TwoDomains
    noise: TwoDomains


class Visibilities(NamedTuple):
    """Spectra of one baseline at one integration, (Nfreqs,) complex, Jy."""

    reference: np.ndarray
    model: np.ndarray
    noise: np.ndarray


def compare_visibilities(
    antennas: tuple[int, int], baseline_length: float, frequency: np.ndarray, visibilities: Visibilities
) -> VisibilityComparison:
    """Compare visibilities on channels `frequency` (Nfreqs,) Hz; the length |b| is in m."""
    reference, model, noise = visibilities
    spectra = (in_two_domains(frequency, values) for values in (reference, model, reference - model, noise))
    return VisibilityComparison(antennas, baseline_length, *spectra)


def draw_comparison(comparison: VisibilityComparison, labels: tuple[str, str]) -> Figure:
    """Draw real parts against frequency (left) and amplitudes of transforms against delay (right).

    The reference is solid, the model dashed, the residual dotted, the noise dash-dotted. Vertical lines are the edges
    of the wedge. `labels` are the names of reference and model in the legend.
    """
    figure, (values, residuals), delays = frequency_and_delay()
    looks: tuple[tuple[Axes, TwoDomains, str, dict[str, Any]], ...] = (
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


@style.journal_style()
def draw_model(comparison: VisibilityComparison) -> Figure:
    """Draw true foregrounds F (the reference) and their fitted model F̂, both without gains."""
    return draw_comparison(comparison, (r"true foregrounds $F$", r"fitted model $\widehat{F}$"))


def _inspected_spectra(job: Job, reference: Path) -> tuple[tuple[int, int], float, Visibilities]:
    """Return the shown baseline, its length and, in fitted channels, its reference, fitted model and noise."""
    from calstudy.products.selection import baseline, layout_of, read_spectra, read_used, require_used

    integration = job.settings["integration"]
    pair, length = baseline(layout_of(job.settings["layout"]), job.settings["antennas"])
    paths = (reference, job.inputs["calibration"] / MODEL, job.inputs["noise"] / DATA)
    used = read_used(paths[1], [pair])[0, integration]
    require_used(used, pair, integration)
    return pair, length, Visibilities(*(used * read_spectra(path, [pair])[0, integration] for path in paths))


class Model(StudyFigure):
    """True and fitted foregrounds of one baseline in one integration."""

    kind: str = "model"

    caption = "Foregrounds of one baseline: true and fitted."
    variants = ("residual", "noise")
    needs_calibration = True
    tolerances = (
        (r"(model|residual)\..*", Drawn(rms_of("residual"), "the rms error of the model")),
        (r"noise\..*", Drawn(rms_of("noise"), "the rms of the noise")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return gains, calibration, true foregrounds and noise."""
        experiment = graph.experiment
        noise = corruption.data(graph, experiment.variants["noise"], experiment.outputs.inspect.realization)
        return {**inspected_calibration(graph), "foregrounds": required(simulation.foregrounds(graph)), "noise": noise}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baseline and integration."""
        return inspected(graph)

    def draw(self, job: Job) -> Drawing:
        """Draw the true foregrounds of a baseline and the fitted ones, on the scale of the true gains."""
        from calstudy.products.selection import read_aligned_gains

        pair, length, (foregrounds, model, noise) = _inspected_spectra(job, job.inputs["foregrounds"] / VISIBILITIES)
        gains = read_aligned_gains(job.inputs["gains"], job.inputs["calibration"], job.settings["integration"])
        shown = Visibilities(foregrounds, model / gains.scale**2, noise)
        comparison = compare_visibilities(pair, length, gains.frequency, shown)
        return Drawing(draw_model(comparison), comparison)


@style.journal_style()
def draw_data(comparison: VisibilityComparison) -> Figure:
    """Draw data V (the reference) and the model visibility ĝ_a ĝ_b* F̂, with the thermal noise of the data."""
    return draw_comparison(comparison, (r"data $V$", r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$"))


class Data(StudyFigure):
    """Data of one baseline and the fitted gains times model, in one integration."""

    kind: str = "data"

    caption = "Data of one baseline, fitted gains times model, and what is left."
    variants = ("residual", "noise")
    needs_calibration = True
    tolerances = ((r".*", Drawn(rms_of("noise"), "the rms of the noise")),)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return gains, calibration, data and noise."""
        experiment = graph.experiment
        data, noise = (
            corruption.data(graph, experiment.variants[name], experiment.outputs.inspect.realization)
            for name in ("residual", "noise")
        )
        return {**inspected_calibration(graph), "data": data, "noise": noise}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baseline and integration."""
        return inspected(graph)

    def draw(self, job: Job) -> Drawing:
        """Draw the data of a baseline with fitted gains times model, and with the noise in them."""
        from calstudy.products.selection import read_gains

        pair, length, (data, model, noise) = _inspected_spectra(job, job.inputs["data"] / DATA)
        true, fitted = read_gains(job.inputs["gains"]), read_gains(job.inputs["calibration"])
        both = (gains.at(job.settings["integration"], pair) for gains in (true, fitted))
        corruption_factor, correction = (gains[0] * gains[1].conj() for gains in both)
        shown = Visibilities(data, correction * model, corruption_factor * noise)
        comparison = compare_visibilities(pair, length, fitted.frequency, shown)
        return Drawing(draw_data(comparison), comparison)
