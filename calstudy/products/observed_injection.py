"""Signal loss of measured data: a simulated EoR is added under the solved gains, and the data are calibrated again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.products import signal_loss
from calstudy.products.calibration import calibration_of
from calstudy.products.corruption import PARITIES
from calstudy.products.files import (
    AVERAGE,
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    VISIBILITIES,
    read_json,
    read_visibilities,
    spectrum_file,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import once, required, size_of
from calstudy.products.observed import (
    ObservedGraph,
    average,
    calibrated,
    calibration_inputs,
    crossed,
    crosses_of,
    observed,
)
from calstudy.products.observed_quality import expected
from calstudy.products.observed_spectra import observed_spectra
from calstudy.products.signal_loss import DIFFERENCE
from calstudy.products.spectra import EXCISION, blocks_of, read_delay_spectra
from calstudy.run.task import Job, Stage, Task
from calstudy.simulate.interface import SimulationSize

if TYPE_CHECKING:
    from pyuvdata import UVData

FACTOR = "factor.json"
LARGEST_ERROR = 0.5
"""Standard deviation of a T that is measured: T is a fraction, and 95 % intervals of larger ones hold all of 0 to 1."""


@once
def eor(graph: ObservedGraph, parity: str) -> Task:
    """Return the task of the EoR at the baselines, integrations and channels of one half."""
    injection = graph.injection
    if injection is None:
        raise LookupError("the study injects nothing")
    settings = {
        "eor": injection.eor,
        "simulation": injection.simulation,
        "cosmology": graph.power.cosmology,
        **graph.beam_settings,
    }
    return Task(SIMULATE_EOR, f"eor {parity}", settings, {"data": observed(graph, parity)})


@once
def factor(graph: ObservedGraph) -> Task:
    """Return the task of the factor of the EoR, which is the same for both halves."""
    inputs = {"eor": eor(graph, "even"), "calibration": calibrated(graph, "even")}
    level = graph.injection.level if graph.injection else None
    return Task(SET_LEVEL, "level of the eor", {"level": level}, inputs)


@once
def injected(graph: ObservedGraph, parity: str) -> Task:
    """Return the task of the data of one half with the EoR added."""
    inputs = {
        "data": observed(graph, parity),
        "eor": eor(graph, parity),
        "factor": factor(graph),
        "calibration": calibrated(graph, parity),
    }
    return Task(INJECT, f"data + eor {parity}", {}, inputs)


@once
def response(graph: ObservedGraph, parity: str) -> Task:
    """Return the task of the averaged response of the residual of one half to the EoR."""
    data = injected(graph, parity)
    again = calibration_of(graph.calibration.with_defaults("assumed"), calibration_inputs(graph, data, parity))
    own = average(graph, "residual", parity)
    with_signal = Task(own.stage, f"residual + eor {parity}", own.settings, {"data": data, "calibration": again})
    inputs = {"with_signal": with_signal, "without_signal": own}
    return Task(DIFFERENCE, f"response to the eor {parity}", {}, inputs)


@once
def signal(graph: ObservedGraph, parity: str) -> Task:
    """Return the task of the averaged EoR of one half, as added but without the gains."""
    inputs = {"eor": eor(graph, parity), "factor": factor(graph), "calibration": calibrated(graph, parity)}
    return Task(AVERAGE_EOR, f"eor {parity}", graph.parts.averaging(graph.power), inputs)


@once
def transfer(graph: ObservedGraph) -> Task | None:
    """Return the task that measures T, or None if nothing is injected."""
    if graph.injection is None:
        return None
    signals, responses = ({parity: make(graph, parity) for parity in PARITIES} for make in (signal, response))
    inputs = {
        "signal": crossed(graph, "eor", signals["even"], signals["odd"]),
        "response": crossed(graph, "response to the eor", responses["even"], responses["odd"]),
        "cross": crossed(graph, "eor x response", signals["even"], responses["odd"]),
        "spectra": observed_spectra(graph),
    }
    return Task(OBSERVED_TRANSFER, "signal loss", {"power": graph.power}, inputs)


def injection_tables(graph: ObservedGraph) -> list[Task]:
    """Return the products of an injection whose files are tables of a run."""
    return [] if graph.injection is None else [required(transfer(graph)), *filter(None, [expected(graph)])]


def simulate_eor(job: Job) -> Mapping[str, Any]:
    """Write the EoR of one half, in Jy and with the power of its P(k), to visibilities.uvh5."""
    import numpy as np

    from calstudy.base.visibilities import antenna_pairs, from_cube
    from calstudy.instrument.beams import make_beam
    from calstudy.instrument.interface import model_of
    from calstudy.instrument.telescope import subset_template
    from calstudy.power.cosmology import make_cosmology
    from calstudy.simulate.chunks import assemble, plan_chunks, simulate_chunk
    from calstudy.sky.eor import EorField

    settings = job.settings
    data = read_visibilities(job.inputs["data"] / DATA)
    data = crosses_of(data)
    template = subset_template(data, np.unique(data.time_array), np.asarray(data.freq_array, float))
    if not np.array_equal(antenna_pairs(template), antenna_pairs(data)):
        raise ValueError("the template of the simulation has other baselines than the data")
    field = EorField(settings["eor"], template.freq_array, make_cosmology(settings["cosmology"]))
    beam, simulation = make_beam(settings["beam"], settings["channels"]), settings["simulation"]
    accuracy = simulation.nodes.for_eor(smooth_beam=model_of(settings["beam"]).smooth)
    chunks = plan_chunks(template, accuracy, simulation.chunks)
    cubes = [simulate_chunk(simulation.engine, field.sky(chunk.channels), beam, template, chunk) for chunk in chunks]
    found = from_cube(data, assemble(chunks, cubes))
    found.flag_array[:] = False
    write_visibilities(found, job.output / VISIBILITIES)
    return {"rms_jy": float(np.sqrt(np.mean(np.abs(found.data_array) ** 2)))}


def set_level(job: Job) -> Mapping[str, Any]:
    """Write the factor of the EoR to factor.json."""
    import numpy as np

    level, found = job.settings["level"], 1.0
    sky = read_visibilities(job.inputs["eor"] / VISIBILITIES).data_array
    if level is not None:
        model = read_visibilities(job.inputs["calibration"] / MODEL)
        values = model.data_array[~model.flag_array]
        if not values.size or not np.any(values):
            raise InputError("injection.level: is relative to the fitted foregrounds, which are zero or all flagged")
        rms = [np.sqrt(np.mean(np.abs(array) ** 2)) for array in (values, sky)]
        found = float(10 ** (level / 10) * rms[0] / rms[1])
    write_json(job.output / FACTOR, {"factor": found})
    return {"factor": found}


def inject(job: Job) -> Mapping[str, Any]:
    """Write the data plus g_a g_b* times the EoR to data.uvh5; nothing is added where there is no solution."""
    import numpy as np
    from pyuvdata import UVCal

    from calstudy.base.gains import gain_products
    from calstudy.base.visibilities import antenna_pairs, rows_of, to_cube

    data, sky = read_visibilities(job.inputs["data"] / DATA), _signal(job)
    pairs = antenna_pairs(sky)
    products, unsolved = gain_products(UVCal.from_file(job.inputs["calibration"] / GAINS), pairs)
    to_cube(data)[:, rows_of(data, pairs)] += np.where(unsolved, 0, products) * to_cube(sky)
    write_visibilities(data, job.output / DATA)
    return {}


def _signal(job: Job) -> UVData:
    """Return the EoR multiplied by its factor."""
    sky = read_visibilities(job.inputs["eor"] / VISIBILITIES)
    sky.data_array *= read_json(job.inputs["factor"] / FACTOR)["factor"]
    return sky


def average_eor(job: Job) -> Mapping[str, Any]:
    """Write the average of the EoR to average.uvh5, with the baselines and flags of the residual."""
    from calstudy.base.visibilities import antenna_pairs, from_cube, rows_of, to_cube
    from calstudy.power.average import average_in_blocks

    residual, sky = crosses_of(read_visibilities(job.inputs["calibration"] / RESIDUAL)), _signal(job)
    signal = from_cube(residual, to_cube(sky)[:, rows_of(sky, antenna_pairs(residual))])
    write_visibilities(average_in_blocks(signal, blocks_of(job, signal)), job.output / AVERAGE)
    return {}


def measure(job: Job) -> Mapping[str, Any]:
    """Write T, spectra of the injected EoR, and the power of the residual corrected by T."""
    from calstudy.power.binned import spherical_average
    from calstudy.power.errors import with_errors
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.power.tables import load_spectrum, save_spectrum, write_csv
    from calstudy.power.transfer import Injection

    settings = job.settings["power"]
    delays = {name: read_delay_spectra(job.inputs[name]) for name in ("signal", "response", "cross")}
    # The signal was multiplied by the fitted gains: T is free of the unknown flux scale.
    summary = signal_loss.write_transfer(job.output, Injection(**delays), settings, 1.0, LARGEST_ERROR)
    signals = {}
    for modes, excise in EXCISION.items():
        spectrum = spherical_average(delays["signal"], settings, excise)
        signals[modes] = with_errors(spectrum, signal=spectrum)
        save_spectrum(job.output / spectrum_file("eor", modes), signals[modes])
        write_csv(job.output / f"eor.{modes}.csv", signals[modes])
    residual = load_spectrum(job.inputs["spectra"] / spectrum_file("residual", "outside-wedge"), SphericalSpectrum)
    signal_loss.write_corrected(job.output, residual, signals["outside-wedge"])
    return {"transfer": summary, "warnings": _not_measured(summary)}


def _not_measured(summary: Mapping[str, Any]) -> list[str]:
    """Return a sentence that names the bands outside the wedge in which T is not measured; none without any."""
    unknown = [band for band in summary["outside-wedge"] if band["transfer"] is None and band["error"] is not None]
    if not unknown:
        return []
    named = ", ".join(
        f"{low:g} to {high:g} (error {band['error']:.2g})" for band in unknown for low, high in [band["k"]]
    )
    return [
        f"T is not measured at k of {named} h/Mpc: an error above {LARGEST_ERROR:g} leaves open all that T can be; "
        "interference that is not flagged (observed.flag_interference: true), few integrations or a weak "
        "injection.level are the usual reasons"
    ]


def _cost_of_eor(task: Task) -> Cost:
    size, settings = size_of(task), task.settings
    pixels, channels = 12 * settings["eor"].nside ** 2, size.channels.count
    slots, simulation = size.times * channels, settings["simulation"]
    tolerance = simulation.nodes.for_eor(smooth_beam=True).tolerance
    engine = simulation.engine.cost(SimulationSize(pixels, slots, slots, size.antennas, 1, tolerance))
    at_once = channels / min(simulation.chunks, channels)
    disk = size.samples * COMPLEX128
    memory = engine.memory + pixels * (300 + 55 * at_once) + 3 * disk
    return Cost(10 + engine.seconds, max(memory, LIBRARIES_MEMORY), disk)


def _cost_of_data(task: Task) -> Cost:
    disk = size_of(task).samples * COMPLEX128
    return Cost(3 + disk * 1e-8, LIBRARIES_MEMORY + 6 * disk, disk)


def _cost_of_average(task: Task) -> Cost:
    size = size_of(task)
    disk = task.settings.get("blocks", 1) * size.samples / size.times * COMPLEX128
    return Cost(2, LIBRARIES_MEMORY + 8 * size.samples * COMPLEX128, disk)


SIMULATE_EOR = Stage(name="observed-eor", version=3, make=simulate_eor, cost=_cost_of_eor)
SET_LEVEL = Stage(name="observed-level", version=1, make=set_level, cost=_cost_of_average)
INJECT = Stage(name="inject", version=1, make=inject, cost=_cost_of_data)
AVERAGE_EOR = Stage(name="observed-eor-average", version=1, make=average_eor, cost=_cost_of_average)
OBSERVED_TRANSFER = Stage(name="observed-transfer", version=3, make=measure, cost=lambda task: Cost(4, disk=1e6))
