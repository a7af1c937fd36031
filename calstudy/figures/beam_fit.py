"""Check of the beam: its smooth fit in frequency against the table, and other interpolations against the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, get_args

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin
from calstudy.base.visibilities import baseline_vectors, from_cube, subset_template
from calstudy.experiment.model import Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.instrument.beam_models.tables import MwaEmbeddedBeam
from calstudy.instrument.settings import Channels, InstrumentSettings
from calstudy.plotting import style
from calstudy.power.delay import horizon_delay
from calstudy.run.task import Job
from calstudy.simulate.nodes import integration_times

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.instrument.beams import GriddedBeam
    from calstudy.simulate.floor import DelayFloor
    from calstudy.simulate.settings import SimulationSettings
    from calstudy.sky.settings import SkySettings


INTERPOLATIONS = get_args(MwaEmbeddedBeam.model_fields["interpolation"].annotation)
SMOOTH = INTERPOLATIONS[0]
INTERPOLATION_COLOURS = {
    "chebyshev": style.BLUE,
    "cubic": style.GREEN,
    "linear": style.ORANGE,
    "nearest": style.RED,
}
"""One colour for each interpolation in every figure."""


@dataclass(frozen=True)
class BeamInterpolation:
    """Differences between Jones components, relative to the zenith, over directions, feeds and components.

    The fit is compared with the table at the `tabulated` frequencies, `others` with the fit at the `channels`, Hz.
    """

    tabulated: np.ndarray
    fit_rms: np.ndarray
    fit_max: np.ndarray
    channels: np.ndarray
    others: dict[str, np.ndarray]


def not_tabulated(experiment: Experiment) -> str | None:
    """Return a refusal of a beam in closed form, which is not interpolated, or None."""
    if hasattr(experiment.instrument.beam, "interpolation"):
        return None
    return f"checks the fit of a beam, and {experiment.instrument.beam.label} is a formula, exact at every frequency"


def compare_interpolations(instrument: InstrumentSettings, step: int = 4) -> BeamInterpolation:
    """Compare a beam's fit with its table, and other interpolations with the fit at one of `step` channels."""
    beams = {name: interpolated(instrument.beam, instrument.channels, name) for name in INTERPOLATIONS}
    tabulated = beams[SMOOTH].table.tabulated_frequencies
    difference = _difference(beams[SMOOTH], beams["nearest"], tabulated)
    settings = instrument.channels
    channels = settings.frequencies[::step]
    others = {name: _rms(_difference(beam, beams[SMOOTH], channels)) for name, beam in beams.items() if name != SMOOTH}
    largest = np.abs(difference).max(axis=(0, 1, 3, 4))
    return BeamInterpolation(tabulated, _rms(difference), largest, channels, others)


def interpolated(beam: Plugin, channels: Channels, interpolation: str) -> GriddedBeam:
    """Return a tabulated beam, fitted over the channels, with one of `INTERPOLATIONS` between its frequencies."""
    from calstudy.instrument.beams import GriddedBeam, make_beam

    found = make_beam(beam.model_copy(update={"interpolation": interpolation}), channels)
    assert isinstance(found, GriddedBeam)
    return found


def _difference(beam: GriddedBeam, other: GriddedBeam, frequencies: np.ndarray) -> np.ndarray:
    """Return J - J', (2, Nfeeds, Nfreqs, Nza, Naz)."""
    return beam.at(frequencies).data_array - other.at(frequencies).data_array


def _rms(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(difference) ** 2, axis=(0, 1, 3, 4)))


def draw_interpolations(found: BeamInterpolation) -> style.Figure:
    """Draw differences of Jones components, relative to the zenith, against frequency."""
    figure = style.new_figure(style.ONE_COLUMN, 2.9)
    axes = figure.subplots()
    blue, tabulated = INTERPOLATION_COLOURS[SMOOTH], found.tabulated / 1e6
    axes.plot(tabulated, found.fit_max, "^", color=blue, markerfacecolor="white", label="fit − table, largest")
    axes.plot(tabulated, found.fit_rms, "o", color=blue, label="fit − table, rms")
    for name, rms in found.others.items():
        label, colour = f"{name} − fit, rms", INTERPOLATION_COLOURS[name]
        axes.plot(found.channels / 1e6, rms, color=colour, linewidth=0.8, label=label)
    axes.set(yscale="log", xlabel=style.FREQUENCY, ylabel=r"$|\Delta J|\,/\,|J_\mathrm{zenith}|$")
    axes.margins(x=0.01)
    figure.legend(loc="outside upper center", ncols=2)
    return figure


class BeamFitFigure(StudyFigure):
    """The smooth fit of a tabulated beam in frequency against its table, and other interpolations against the fit."""

    kind: str = "beam-fit"

    caption = "Interpolations of the beam in frequency: differences of Jones components over the zenith."
    reads: ClassVar = {}
    sections = ("instrument",)

    def refusal(self, experiment: Experiment) -> str | None:
        """Refuse a beam in closed form."""
        return not_tabulated(experiment)

    def draw(self, job: Job) -> Drawing:
        """Compare the interpolations."""
        found = compare_interpolations(job.settings["instrument"])
        rms = {name: float(np.sqrt(np.mean(values**2))) for name, values in found.others.items()}
        fit = {"rms": float(np.sqrt(np.mean(found.fit_rms**2))), "largest": float(found.fit_max.max())}
        return Drawing(draw_interpolations(found), found, {"fit": fit, "rms_to_fit": rms})


NO_DELAY = "instrument.channels: too wide or too few, no delay lies beyond the horizon and the main lobe"
PAPER_FLOOR = -45.0
"""Artefacts of beam interpolation in the paper, dB of brightness."""
LINES = {"dolph-chebyshev": "-", "blackman-harris": ":"}


@dataclass(frozen=True)
class InterpolationFloor:
    """Delay spectra, and floors by taper, of foregrounds simulated with one interpolation of the beam.

    `spectrum` is the rms over the shortest third of the baselines, over its largest value, with the Dolph-Chebyshev
    taper, at `delay` >= 0, s. `horizon` is the longest horizon delay of these baselines, s.
    """

    delay: np.ndarray
    spectrum: np.ndarray
    horizon: float
    floors: dict[str, DelayFloor]


def compare_floors(
    instrument: InstrumentSettings, sky: SkySettings, simulation: SimulationSettings
) -> dict[str, InterpolationFloor]:
    """Simulate every channel of the middle integration, once with every interpolation of a tabulated beam."""
    from calstudy.instrument.telescope import make_template
    from calstudy.simulate.chunks import simulate_visibilities
    from calstudy.sky.foregrounds import make_foregrounds

    whole = make_template(instrument)
    times = integration_times(whole)
    template = subset_template(whole, times[len(times) // 2 :][:1], whole.freq_array)
    sources = make_foregrounds(sky.foregrounds, whole.freq_array, sky.diffuse).sky
    accuracy = simulation.nodes.accuracy(eor=False, smooth_beam=False, smooth_sky=False)
    floors = {}
    for name in INTERPOLATIONS:
        beam = interpolated(instrument.beam, instrument.channels, name)
        cube = simulate_visibilities(simulation.engine, sources, beam, template, accuracy)
        floors[name] = _measure(from_cube(template, cube))
    return floors


def _measure(foregrounds: UVData) -> InterpolationFloor:
    from calstudy.simulate.floor import MAIN_LOBES, delay_floor, delay_profile, floor_buffers, folded_spectrum

    buffers = floor_buffers(foregrounds)
    if len(buffers) < len(MAIN_LOBES):
        raise InputError(NO_DELAY)
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    short = lengths <= np.quantile(lengths, 1 / 3)
    delays, power = delay_profile(foregrounds, "dolph-chebyshev")
    delay, folded = folded_spectrum(delays, power[short].mean(axis=0))
    return InterpolationFloor(
        delay=delay,
        spectrum=np.sqrt(folded / folded.max()),
        horizon=horizon_delay(float(lengths[short].max())),
        floors={taper: delay_floor(foregrounds, buffer, taper) for taper, buffer in buffers.items()},
    )


def draw_delay_floors(floors: Mapping[str, InterpolationFloor], eor_level: float | None) -> style.Figure:
    """Draw delay spectra of short baselines, and the floor against baseline length; `eor_level` in dB or None."""
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, sharey=True)
    for name, floor in floors.items():
        colour = INTERPOLATION_COLOURS[name]
        left.plot(floor.delay * 1e9, 10 * np.log10(floor.spectrum), color=colour, linewidth=0.8, label=name)
        for taper, line in LINES.items():
            steps = floor.floors[taper]
            right.stairs(steps.rms_db, steps.edges, baseline=None, linewidth=1.0, color=colour, linestyle=line)
    horizon = next(iter(floors.values())).horizon
    left.axvline(horizon * 1e9, color=style.BLACK, linestyle="--", linewidth=0.7)
    for axes in (left, right):
        axes.axhline(PAPER_FLOOR, color=style.GREY, linewidth=0.6, linestyle="-.")
    left.set(xlabel=style.DELAY, ylabel="brightness relative to peak (dB)", ylim=(-105, 3))
    left.margins(x=0)
    right.set(xlabel=style.BASELINE_LENGTH)
    for line, label in (("-", "Dolph–Chebyshev"), (":", "Blackman–Harris"), ("-.", "paper's artefacts")):
        right.plot([], [], color=style.GREY, linestyle=line, label=label)
    if eor_level is not None:
        left.axhline(eor_level, color=style.BLACK, linewidth=0.6)
        right.axhline(eor_level, color=style.BLACK, linewidth=0.6, label="EoR asked for")
    right.legend(loc="upper right")
    left.legend(loc="upper right")
    return figure


class DelayFloorFigure(StudyFigure):
    """The delay floor of the foregrounds at one integration, for every interpolation of the beam in frequency."""

    kind: str = "delay-floor"

    caption = "Delay floor of the foregrounds for every interpolation of the beam in frequency."
    needs_foregrounds = True
    reads: ClassVar = {}
    sections = ("instrument", "sky", "simulation", "corruption.eor_level")

    def refusal(self, experiment: Experiment) -> str | None:
        """Refuse an experiment without foregrounds, or with a beam in closed form."""
        return super().refusal(experiment) or not_tabulated(experiment)

    def draw(self, job: Job) -> Drawing:
        """Simulate with every interpolation."""
        floors = compare_floors(**{name: job.settings[name] for name in ("instrument", "sky", "simulation")})
        notes = {name: {taper: found.worst_db for taper, found in item.floors.items()} for name, item in floors.items()}
        return Drawing(draw_delay_floors(floors, job.settings["eor_level"]), floors, notes)
