"""From simulated components to measurements: the levels of EoR and noise, and the effects with their draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gains
from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.resources import COMPLEX64, COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import antenna_rows, flag_cube, from_cube, positions, to_cube
from calstudy.corrupt.interface import Effect, GainEffect, apply_effect, draw_flags, draw_truth
from calstudy.corrupt.levels import Levels, noise_of_samples, radiometer_std, rms, set_levels
from calstudy.corrupt.noise import Noise, NoNoise, RadiometerNoise, thermal_noise
from calstudy.corrupt.noise import autocorrelations as draw
from calstudy.experiment.model import Variant
from calstudy.instrument.as_built import AsBuilt
from calstudy.instrument.settings import InstrumentSettings
from calstudy.products import simulation
from calstudy.products.files import (
    DATA,
    GAINS,
    VISIBILITIES,
    read_json,
    read_visibilities,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.realdata.halves import PARITIES
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from calstudy.corrupt.settings import CorruptionSettings

LEVELS, TRUTH = "levels.json", "truth.h5"


def truths(graph: Graph) -> tuple[Task, ...]:
    """Return the tasks that draw the truth of each effect of the experiment, in the order of the effects."""
    return tuple(_truth(graph, place) for place in range(len(graph.experiment.corruption.effects)))


@memoize
def _truth(graph: Graph, place: int) -> Task:
    effect = graph.experiment.corruption.effects[place]
    return DrawEffect(effect.label, instrument=_antennas(graph, [effect]), effect=effect)


def _antennas(graph: Graph, effects: Sequence[Effect]) -> InstrumentSettings:
    """Return the instrument on which effects act: without beams, with true positions if an effect uses them."""
    instrument = graph.experiment.instrument
    nominal = instrument.without_beams()
    if not any(effect.uses_positions for effect in effects):
        return nominal
    return nominal.model_copy(update={"as_built": AsBuilt(positions=instrument.as_built.positions)})


@memoize
def gains(graph: Graph) -> Task:
    """Return the task of the true gains: the product of all effects on the gains, unity if there are none."""
    drawn = zip(graph.experiment.corruption.effects, truths(graph), strict=True)
    factors = tuple(truth for effect, truth in drawn if isinstance(effect, GainEffect))
    return MultiplyGains("true gains", instrument=graph.experiment.instrument.without_beams(), truth=factors)


@memoize
def levels(graph: Graph) -> Task:
    """Return the task of the levels: the factors of the EoR and the noise."""
    corruption = graph.experiment.corruption.with_defaults("effects")
    noise = corruption.noise if corruption.noise.kind == "none" else corruption.noise.with_defaults("seeds")
    return MeasureLevels(
        "levels",
        corruption=corruption.model_copy(update={"noise": noise}),
        instrument=graph.experiment.instrument if isinstance(noise, RadiometerNoise) else None,
        eor=simulation.eor(graph),
        foregrounds=simulation.foregrounds(graph),
    )


@memoize
def noise_level(graph: Graph, variant: Variant) -> Task:
    """Return the task of the level of the noise of the data of a variant, as a calibrator may know it."""
    flagging = _flagging(graph)
    return MeasureNoise(
        "noise of corrupted data" if variant.effects else "noise of data",
        instrument=_antennas(graph, [effect for effect, _ in flagging]),
        nights=_nights(graph.experiment.corruption.noise),
        flagged_by=tuple(effect for effect, _ in flagging),
        levels=levels(graph),
        gains=gains(graph) if variant.effects else None,
        truth=tuple(truth for _, truth in flagging),
    )


def _flagging(graph: Graph) -> list[tuple[Effect, Task]]:
    """Return the effects that flag, with the tasks that draw their truth."""
    effects = graph.experiment.corruption.effects
    return [(effect, _truth(graph, place)) for place, effect in enumerate(effects) if effect.can_flag]


@memoize
def data(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of one noise realization ("even" or "odd") of a variant before calibration."""
    experiment = graph.experiment
    # All variants need the same samples, because they are compared and provide errors for each other.
    flagging = _flagging(graph)
    effects = experiment.corruption.effects if variant.effects else ()
    acting = effects or tuple(effect for effect, _ in flagging)
    label, seed = " + ".join(variant.components), None
    if "noise" in variant.components:
        noise = experiment.corruption.noise
        if isinstance(noise, NoNoise):
            raise LookupError(f"{label}: corruption.noise is 'none'")
        own = None if "eor" in variant.components else noise.seeds_without_eor
        seed = (own or noise.seeds)[PARITIES.index(parity)]
        label = f"{label} {parity}"
    return Corrupt(
        f"corrupted data ({label})" if effects else label,
        components=sorted(variant.components),
        instrument=_antennas(graph, acting),
        noise_seed=seed,
        nights=_nights(experiment.corruption.noise),
        effects=tuple(effects),
        flagged_by=() if effects else acting,
        levels=levels(graph),
        foregrounds=simulation.foregrounds(graph) if "foregrounds" in variant.components else None,
        eor=simulation.eor(graph) if "eor" in variant.components else None,
        truth=truths(graph) if effects else tuple(truth for _, truth in flagging),
        temporary=not graph.keep_visibilities,
    )


def _nights(noise: Noise) -> int | None:
    """Return the number of nights in the average that the data are; None for one."""
    nights = noise.nights if isinstance(noise, RadiometerNoise) else 1
    return nights if nights > 1 else None


@memoize
def autocorrelations(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the autocorrelations of one realization, without the EoR, which is far below their noise."""
    noise = graph.experiment.corruption.noise
    if isinstance(noise, NoNoise):
        raise LookupError("autocorrelations: corruption.noise is 'none'")
    return Autocorrelate(
        f"autocorrelations {parity}",
        instrument=graph.experiment.instrument.without_beams(),
        noise_seed=noise.seeds[PARITIES.index(parity)],
        nights=_nights(noise) or 1,
        levels=levels(graph),
        gains=gains(graph) if variant.effects else None,
        temporary=not graph.keep_visibilities,
    )


class DrawEffect(Task, stage="effect", version=1):
    """The truth of an effect."""

    instrument: InstrumentSettings
    effect: Effect

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the arrays drawn by the effect to truth.h5, one data set each."""
        import h5py

        from calstudy.instrument.telescope import make_template

        effect, observation = self.effect, Observation(make_template(self.instrument, as_built=True))
        truth = draw_truth(effect, observation)
        with h5py.File(output / TRUTH, "w") as file:
            for name, array in truth.items():
                file[name] = array
        notes: dict[str, Any] = {"arrays": {name: list(array.shape) for name, array in truth.items()}}
        if (flags := draw_flags(effect, observation, truth)) is not None:
            notes["flagged_fraction"] = float(flags.mean())
            if flags.shape[2] > 1 and flags.any():
                notes["warnings"] = [
                    f"effect {effect.label!r} flags {100 * flags.mean():.2g} % of the samples: spectra with gaps mix "
                    "delays, and what is left of the foregrounds leaks beyond the wedge"
                ]
        return notes

    def _cost(self) -> Cost:
        return _cost_of_gains(self, [self.effect])


def read_truth(folder: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a product of the stage `effect`."""
    import h5py

    with h5py.File(folder / TRUTH, "r") as file:
        return {name: data[()] for name, data in file.items()}


class MultiplyGains(Task, stage="gains", version=2):
    """The product of the gains of all effects."""

    instrument: InstrumentSettings
    truth: tuple[Input, ...]

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the gains to gains.calh5."""
        from calstudy.instrument.telescope import make_template

        template = make_template(self.instrument)
        factors = [read_truth(folder)["gains"] for folder in self.truth]
        # Gains that are constant during the run have a single time.
        n_times = max((gains.shape[2] for gains in factors), default=1)
        product = np.ones((template.telescope.Nants, template.Nfreqs, n_times, template.Npols), dtype=complex)
        rows = antenna_rows(template)
        for gains in factors:
            product[rows] *= gains
        make_uvcal(template, product).write_calh5(output / GAINS)
        return {}

    def _cost(self) -> Cost:
        return _cost_of_gains(self, [truth.effect for truth in self.truth])


class MeasureLevels(Task, stage="levels", version=2):
    """The scales of EoR and noise."""

    corruption: CorruptionSettings
    instrument: InstrumentSettings | None = None
    eor: Input
    foregrounds: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the scales to levels.json."""
        foregrounds, eor = (
            0.0 if folder is None else rms(to_cube(read_visibilities(folder / VISIBILITIES)))
            for folder in (self.foregrounds, self.eor)
        )
        noise, radiometer = self.corruption.noise, None
        if isinstance(noise, RadiometerNoise) and self.instrument is not None:
            radiometer = radiometer_std(noise, self.instrument)
        levels = set_levels(foregrounds, eor, self.corruption, radiometer)
        write_json(output / LEVELS, levels.as_json())
        found = replace(levels, noise_spectrum=None).as_json()
        return {"levels_jy": found, "warnings": self._floor_warnings()}

    def _floor_warnings(self) -> list[str]:
        """Warn if the simulated foregrounds leak more power beyond the horizon than the EoR has."""
        level = self.corruption.eor_level
        if self.foregrounds is None or level is None:
            return []
        floors = read_json(self.foregrounds / simulation.QUALITY)["delay_floor"]
        return [
            f"the simulated foregrounds have a delay floor of {floor['worst_db']} dB beyond the horizon "
            f"({taper} taper), above the EoR at {level:g} dB"
            for taper, floor in floors.items()
            if floor["worst_db"] > level
        ]

    def _cost(self) -> Cost:
        noise = self.corruption.noise
        beam = 10 if isinstance(noise, RadiometerNoise) and noise.effective_area is None else 0
        samples = size_of(self).samples
        return Cost(0.2 + 1.5e-7 * samples + beam, LIBRARIES_MEMORY + 3 * samples * COMPLEX128, 1e5)


class Corrupt(Task, stage="corrupt", version=2):
    """The sum of some of F, S and N after the effects.

    Effects that flag, `flagged_by`, set their flags even in data on which no effect acts.
    """

    components: Sequence[str]
    instrument: InstrumentSettings
    noise_seed: int | None = None
    nights: int | None = None
    effects: tuple[Effect, ...] = ()
    flagged_by: tuple[Effect, ...] = ()
    levels: Input
    foregrounds: Input = None
    eor: Input = None
    truth: tuple[Input, ...] = ()

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the data to data.uvh5."""
        from calstudy.instrument.telescope import make_template

        found = Levels(**read_json(self.levels / LEVELS))
        template = make_template(self.instrument)
        cube = np.zeros((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), dtype=np.complex128)
        for folder, factor in ((self.foregrounds, 1.0), (self.eor, found.eor_factor)):
            if folder is not None:
                cube += factor * to_cube(read_visibilities(folder / VISIBILITIES))
        if self.noise_seed is not None:
            cube += thermal_noise(cube.shape, found.noise, self.noise_seed)
        observation = Observation(make_template(self.instrument, as_built=True))
        if self.effects:
            for effect, folder in zip(self.effects, self.truth, strict=True):
                cube = apply_effect(effect, cube, observation, read_truth(folder))
        flags = _flags(self.effects or self.flagged_by, self.truth, observation)
        data = from_cube(template, cube)
        flag_cube(data)[:] = flags
        data.nsample_array[:] = self.nights or 1
        write_visibilities(data, output / DATA, single=True)
        notes: dict[str, Any] = {"rms_jy": rms(cube)}
        if flags.any():
            notes["flagged_fraction"] = float(flags.mean())
        return notes

    def _cost(self) -> Cost:
        size = size_of(self)
        effects = [effect.cost(size) for effect in self.effects]
        seconds = 0.2 + size.samples * 1.3e-7 + sum(cost.seconds for cost in effects)
        memory = LIBRARIES_MEMORY + 5 * size.samples * COMPLEX128 + max((cost.memory for cost in effects), default=0.0)
        return Cost(seconds, memory, size.samples * COMPLEX64)


def _flags(effects: Sequence[Effect], truths: Sequence[Path], observation: Observation) -> np.ndarray:
    """Return the flags of effects, (Ntimes, Nbls, Nfreqs, Npols), of which products hold the truth."""
    flags = np.zeros(observation.shape, dtype=bool)
    for effect, folder in zip(effects, truths, strict=True):
        if effect.can_flag and (flagged := draw_flags(effect, observation, read_truth(folder))) is not None:
            flags |= flagged
    return flags


class MeasureNoise(Task, stage="noise-level", version=1):
    """The standard deviation of the noise of samples of the data with nsamples of one."""

    instrument: InstrumentSettings
    nights: int | None = None
    flagged_by: tuple[Effect, ...] = ()
    levels: Input
    gains: Input = None
    truth: tuple[Input, ...] = ()

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the standard deviation to levels.json."""
        from calstudy.instrument.telescope import make_template

        sigma = Levels(**read_json(self.levels / LEVELS)).noise * np.sqrt(self.nights or 1)
        observation = Observation(make_template(self.instrument, as_built=True))
        used = ~_flags(self.flagged_by, self.truth, observation) & ~observation.autos[:, None, None]
        amplitudes = np.ones((1, 1, 1, 1))
        if self.gains is not None:
            true = read_gains(self.gains / GAINS, "true gains")
            rows = positions(true.ant_array, observation.numbers)
            of_antennas = np.abs(true.gain_array[rows]).transpose(2, 0, 1, 3)
            first, second = observation.antennas.T
            amplitudes = of_antennas[:, first] * of_antennas[:, second]
        noise = noise_of_samples(sigma, amplitudes, used)
        write_json(output / LEVELS, {"noise_std": noise})
        return {"noise_jy": noise}

    def _cost(self) -> Cost:
        samples = size_of(self).samples
        return Cost(0.2 + 5e-8 * samples, LIBRARIES_MEMORY + 5 * samples * COMPLEX64, 1e5)


def read_noise(folder: Path) -> float:
    """Read sigma of the noise of a sample, as calibrators are given it; raises InputError if it is not known."""
    if not (folder / LEVELS).exists():
        raise InputError("calibration.foreground_prior.noise: must be given, for no unflagged autocorrelations tell it")
    return float(read_json(folder / LEVELS)["noise_std"])


class Autocorrelate(Task, stage="autocorrelations", version=1):
    """The autocorrelations after the gains; other effects do not change them."""

    instrument: InstrumentSettings
    noise_seed: int
    nights: float
    levels: Input
    gains: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the autocorrelations to data.uvh5."""
        from calstudy.instrument.telescope import make_template

        template = make_template(self.instrument, autos=True)
        template.select(blt_inds=np.flatnonzero(template.ant_1_array == template.ant_2_array), run_check=False)
        sigma = Levels(**read_json(self.levels / LEVELS)).noise
        samples = self.instrument.channels.width * self.instrument.times.integration * self.nights
        cube = draw(Observation(template).shape, sigma, samples, self.noise_seed)
        if self.gains is not None:
            true = read_gains(self.gains / GAINS, "true gains")
            rows = positions(true.ant_array, template.ant_1_array[: template.Nbls])
            cube = cube * np.moveaxis(np.abs(true.gain_array[rows]) ** 2, 2, 0)
        autos = from_cube(template, cube.astype(complex))
        autos.nsample_array[:] = self.nights
        write_visibilities(autos, output / DATA, single=True)
        return {}

    def _cost(self) -> Cost:
        size = size_of(self)
        disk = size.antennas * size.channels.count * size.times * size.polarizations * COMPLEX64
        return Cost(0.2 + disk * 1e-7, LIBRARIES_MEMORY + 8 * disk, disk)


def _cost_of_gains(task: Task, effects: Sequence[Effect]) -> Cost:
    """Return the cost of gains, whose number depends on antennas, channels and, if they drift, integrations."""
    size = size_of(task)
    times = size.times if any(isinstance(effect, GainEffect) and effect.varies for effect in effects) else 1
    disk = size.antennas * size.channels.count * times * size.polarizations * COMPLEX128
    return Cost(0.2 + disk * 1e-7, LIBRARIES_MEMORY + 8 * disk, 1e6 + disk)
