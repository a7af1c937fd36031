"""From simulated components to measurements: the levels of EoR and noise, and the effects with their draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import COMPLEX64, COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.corrupt.interface import Effect, GainEffect
from calstudy.corrupt.noise import NoNoise, RadiometerNoise
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
from calstudy.products.graph import Graph, once, size_of
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

PARITIES = ("even", "odd")
"""Names of the two noise realizations."""
LEVELS, TRUTH = "levels.json", "truth.h5"


def truths(graph: Graph) -> list[Task]:
    """Return the tasks that draw the truth of each effect of the experiment, in the order of the effects."""
    return [_truth(graph, place) for place in range(len(graph.experiment.corruption.effects))]


@once
def _truth(graph: Graph, place: int) -> Task:
    effect = graph.experiment.corruption.effects[place]
    return Task(DRAW_EFFECT, effect.label, {"instrument": _antennas(graph, [effect]), "effect": effect})


def _antennas(graph: Graph, effects: Sequence[Effect]) -> InstrumentSettings:
    """Return the instrument on which effects act: without beams, with true positions if an effect uses them."""
    instrument = graph.experiment.instrument
    nominal = instrument.without_beams()
    if not any(effect.uses_positions for effect in effects):
        return nominal
    return nominal.model_copy(update={"as_built": AsBuilt(positions=instrument.as_built.positions)})


@once
def gains(graph: Graph) -> Task:
    """Return the task of the true gains: the product of all effects on the gains, unity if there are none."""
    effects = graph.experiment.corruption.effects
    drawn = zip(effects, truths(graph), strict=True)
    factors = [truth for effect, truth in drawn if isinstance(effect, GainEffect)]
    settings = {"instrument": graph.experiment.instrument.without_beams()}
    return Task(MULTIPLY_GAINS, "true gains", settings, _numbered(factors))


def _numbered(tasks: Sequence[Task]) -> dict[str, Task]:
    return {f"truth{place:03d}": task for place, task in enumerate(tasks)}


@once
def levels(graph: Graph) -> Task:
    """Return the task of the levels: the factors of the EoR and the noise."""
    inputs = {"eor": simulation.eor(graph)}
    if (foregrounds := simulation.foregrounds(graph)) is not None:
        inputs["foregrounds"] = foregrounds
    corruption = graph.experiment.corruption.with_defaults("effects")
    noise = corruption.noise if corruption.noise.kind == "none" else corruption.noise.with_defaults("seeds")
    settings: dict[str, Any] = {"corruption": corruption.model_copy(update={"noise": noise})}
    if isinstance(noise, RadiometerNoise):
        settings["instrument"] = graph.experiment.instrument
    return Task(MEASURE_LEVELS, "levels", settings, inputs)


@once
def data(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of one noise realization ("even" or "odd") of a variant before calibration."""
    experiment = graph.experiment
    # All variants need the same samples, because they are compared and provide errors for each other.
    flagging = [place for place, effect in enumerate(experiment.corruption.effects) if effect.can_flag]
    effects = experiment.corruption.effects if variant.effects else ()
    acting = effects or [experiment.corruption.effects[place] for place in flagging]
    settings: dict[str, Any] = {"components": sorted(variant.components), "instrument": _antennas(graph, acting)}
    inputs = {"levels": levels(graph)}
    label = "+".join(variant.components)
    if "noise" in variant.components:
        noise = experiment.corruption.noise
        if isinstance(noise, NoNoise):
            raise LookupError(f"{label}: corruption.noise is 'none'")
        own = None if "eor" in variant.components else noise.seeds_without_eor
        settings["noise_seed"] = (own or noise.seeds)[PARITIES.index(parity)]
        label = f"{label} {parity}"
    if "foregrounds" in variant.components and (foregrounds := simulation.foregrounds(graph)) is not None:
        inputs["foregrounds"] = foregrounds
    if "eor" in variant.components:
        inputs["eor"] = simulation.eor(graph)
    if effects:
        settings["effects"] = list(effects)
        inputs |= _numbered(truths(graph))
        label = f"effects on ({label})"
    elif flagging:
        settings["flagged_by"] = acting
        inputs |= _numbered([_truth(graph, place) for place in flagging])
    return Task(CORRUPT, label, settings, inputs, temporary=not graph.keep_visibilities)


@once
def autocorrelations(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the autocorrelations of one noise realization ("even" or "odd") of a variant.

    They do not contain the EoR, which is far below their noise.
    """
    noise = graph.experiment.corruption.noise
    if isinstance(noise, NoNoise):
        raise LookupError("autocorrelations: corruption.noise is 'none'")
    settings: dict[str, Any] = {
        "instrument": graph.experiment.instrument.without_beams(),
        "noise_seed": noise.seeds[PARITIES.index(parity)],
        "nights": noise.nights if isinstance(noise, RadiometerNoise) else 1,
    }
    inputs = {"levels": levels(graph)}
    if variant.effects:
        inputs["gains"] = gains(graph)
    return Task(AUTOCORRELATE, f"autocorrelations {parity}", settings, inputs, temporary=not graph.keep_visibilities)


def draw_effect(job: Job) -> Mapping[str, Any]:
    """Write the arrays drawn by an effect to truth.h5, one data set each."""
    import h5py

    from calstudy.base.observation import Observation
    from calstudy.corrupt.interface import draw_flags, draw_truth
    from calstudy.instrument.telescope import make_template

    effect, observation = job.settings["effect"], Observation(make_template(job.settings["instrument"], as_built=True))
    truth = draw_truth(effect, observation)
    with h5py.File(job.output / TRUTH, "w") as file:
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


def read_truth(folder: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a product of the stage `effect`."""
    import h5py

    with h5py.File(folder / TRUTH, "r") as file:
        return {name: data[()] for name, data in file.items()}


def multiply_gains(job: Job) -> Mapping[str, Any]:
    """Write the product of the gains of all effects to gains.calh5."""
    import numpy as np

    from calstudy.base.gains import make_uvcal
    from calstudy.base.visibilities import antenna_rows
    from calstudy.instrument.telescope import make_template

    template = make_template(job.settings["instrument"])
    factors = [read_truth(folder)["gains"] for folder in job.inputs.values()]
    # Gains that are constant during the run have a single time.
    n_times = max((gains.shape[2] for gains in factors), default=1)
    product = np.ones((template.telescope.Nants, template.Nfreqs, n_times, template.Npols), dtype=complex)
    rows = antenna_rows(template)
    for gains in factors:
        product[rows] *= gains
    make_uvcal(template, product).write_calh5(job.output / GAINS)
    return {}


def measure_levels(job: Job) -> Mapping[str, Any]:
    """Write the scales of EoR and noise to levels.json."""
    from calstudy.base.visibilities import to_cube
    from calstudy.corrupt.levels import rms, set_levels
    from calstudy.corrupt.noise import radiometer_std

    measured = {
        name: rms(to_cube(read_visibilities(job.inputs[name] / VISIBILITIES))) if name in job.inputs else 0.0
        for name in ("foregrounds", "eor")
    }
    settings = job.settings["corruption"]
    noise = settings.noise
    radiometer = radiometer_std(noise, job.settings["instrument"]) if isinstance(noise, RadiometerNoise) else None
    levels = set_levels(measured["foregrounds"], measured["eor"], settings, radiometer)
    write_json(job.output / LEVELS, levels.as_json())
    found = replace(levels, noise_spectrum=None).as_json()
    return {"levels_jy": found, "warnings": _floor_warnings(job)}


def _floor_warnings(job: Job) -> list[str]:
    """Warn if the simulated foregrounds leak more power beyond the horizon than the EoR has."""
    level = job.settings["corruption"].eor_level
    if "foregrounds" not in job.inputs or level is None:
        return []
    floors = read_json(job.inputs["foregrounds"] / simulation.QUALITY)["delay_floor"]
    return [
        f"the simulated foregrounds have a delay floor of {floor['worst_db']} dB beyond the horizon "
        f"({taper} taper), above the EoR at {level:g} dB"
        for taper, floor in floors.items()
        if floor["worst_db"] > level
    ]


def corrupt(job: Job) -> Mapping[str, Any]:
    """Write the sum of F, S and N, or of those in the settings, after all effects, to data.uvh5.

    The flags of all effects are set in all data, even where the effects do not act.
    """
    import numpy as np

    from calstudy.base.observation import Observation
    from calstudy.base.visibilities import flag_cube, from_cube, to_cube
    from calstudy.corrupt.interface import apply_effect, draw_flags
    from calstudy.corrupt.levels import Levels, rms
    from calstudy.corrupt.noise import thermal_noise
    from calstudy.instrument.telescope import make_template

    found = Levels(**read_json(job.inputs["levels"] / LEVELS))
    template = make_template(job.settings["instrument"])
    components = job.settings["components"]
    cube = np.zeros((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), dtype=np.complex128)
    for name, factor in (("foregrounds", 1.0), ("eor", found.eor_factor)):
        if name in components:
            cube += factor * to_cube(read_visibilities(job.inputs[name] / VISIBILITIES))
    if "noise" in components:
        cube += thermal_noise(cube.shape, found.noise, job.settings["noise_seed"])
    observation = Observation(make_template(job.settings["instrument"], as_built=True))
    flags = np.zeros(cube.shape, dtype=bool)
    for place, effect in enumerate(job.settings.get("effects", job.settings.get("flagged_by", ()))):
        truth = read_truth(job.inputs[f"truth{place:03d}"])
        if "effects" in job.settings:
            cube = apply_effect(effect, cube, observation, truth)
        if (flagged := draw_flags(effect, observation, truth)) is not None:
            flags |= flagged
    data = from_cube(template, cube)
    flag_cube(data)[:] = flags
    write_visibilities(data, job.output / DATA, single=True)
    notes: dict[str, Any] = {"rms_jy": rms(cube)}
    if flags.any():
        notes["flagged_fraction"] = float(flags.mean())
    return notes


def autocorrelate(job: Job) -> Mapping[str, Any]:
    """Write the autocorrelations after the gains to data.uvh5; other effects do not change them."""
    import numpy as np

    from calstudy.base.gains import read_gains
    from calstudy.base.observation import Observation
    from calstudy.base.visibilities import from_cube
    from calstudy.corrupt.levels import Levels
    from calstudy.corrupt.noise import autocorrelations as draw
    from calstudy.instrument.telescope import make_template

    settings = job.settings["instrument"]
    template = make_template(settings, autos=True)
    template.select(blt_inds=np.flatnonzero(template.ant_1_array == template.ant_2_array), run_check=False)
    sigma = Levels(**read_json(job.inputs["levels"] / LEVELS)).noise
    samples = settings.channels.width * settings.times.integration * job.settings["nights"]
    cube = draw(Observation(template).shape, sigma, samples, job.settings["noise_seed"])
    if "gains" in job.inputs:
        true = read_gains(job.inputs["gains"] / GAINS, "true gains")
        order = np.argsort(true.ant_array)
        rows = order[np.searchsorted(true.ant_array, template.ant_1_array[: template.Nbls], sorter=order)]
        cube = cube * np.moveaxis(np.abs(true.gain_array[rows]) ** 2, 2, 0)
    write_visibilities(from_cube(template, cube.astype(complex)), job.output / DATA, single=True)
    return {}


def _cost_of_autocorrelations(task: Task) -> Cost:
    size = size_of(task)
    disk = size.antennas * size.channels.count * size.times * size.polarizations * COMPLEX64
    return Cost(1 + disk * 1e-7, LIBRARIES_MEMORY + 8 * disk, disk)


def _cost_of_corruption(task: Task) -> Cost:
    size = size_of(task)
    effects = [effect.cost(size) for effect in task.settings.get("effects", ())]
    seconds = 1 + size.samples * 1e-7 + sum(cost.seconds for cost in effects)
    memory = LIBRARIES_MEMORY + 5 * size.samples * COMPLEX128 + max((cost.memory for cost in effects), default=0.0)
    return Cost(seconds, memory, size.samples * COMPLEX64)


def _cost_of_levels(task: Task) -> Cost:
    noise = task.settings["corruption"].noise
    beam = 10 if isinstance(noise, RadiometerNoise) and noise.effective_area is None else 0
    return Cost(0.5 + beam, LIBRARIES_MEMORY + 3 * size_of(task).samples * COMPLEX128, 1e5)


def _cost_of_gains(task: Task) -> Cost:
    """Return the cost of gains, whose number depends on antennas, channels and, if they drift, integrations."""
    size = size_of(task)
    effects = (
        [task.settings["effect"]] if "effect" in task.settings else [t.settings["effect"] for t in task.needs.values()]
    )
    times = size.times if any(getattr(effect, "drift", None) is not None for effect in effects) else 1
    disk = size.antennas * size.channels.count * times * size.polarizations * COMPLEX128
    return Cost(1 + disk * 1e-7, LIBRARIES_MEMORY + 8 * disk, 1e6 + disk)


DRAW_EFFECT = Stage(name="effect", version=1, make=draw_effect, cost=_cost_of_gains)
MULTIPLY_GAINS = Stage(name="gains", version=2, make=multiply_gains, cost=_cost_of_gains)
MEASURE_LEVELS = Stage(name="levels", version=2, make=measure_levels, cost=_cost_of_levels)
CORRUPT = Stage(name="corrupt", version=2, make=corrupt, cost=_cost_of_corruption)
AUTOCORRELATE = Stage(name="autocorrelations", version=1, make=autocorrelate, cost=_cost_of_autocorrelations)
