"""Signal loss of measured data: measured by an EoR that is added under the solved gains, and expected of the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.gains import gain_products
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import (
    antenna_pairs,
    baseline_vectors,
    crosses_of,
    from_cube,
    positions,
    rows_of,
    subset_template,
    to_cube,
)
from calstudy.calibrate.settings import GainFit
from calstudy.instrument.interface import model_of
from calstudy.power.binned import spherical_average, with_errors
from calstudy.power.cosmology import make_cosmology
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum, save_spectrum, write_csv
from calstudy.products.calibration import prepared_fit, read_result
from calstudy.products.expected_loss import LABEL, NOT_OF_THE_FIT, PROBES, binned
from calstudy.products.files import (
    AVERAGE,
    DATA,
    EXPECTED,
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
from calstudy.products.graph import MeasuredGraph, memoize, size_of
from calstudy.products.observed import average, calibrated, observed, read_observed
from calstudy.products.observed_results import observed_spectra
from calstudy.products.signal_loss import Injected, difference, write_corrected, write_transfer
from calstudy.products.spectra import EXCISION, InBlocks, cross_power
from calstudy.products.table import StudyTable
from calstudy.realdata.halves import PARITIES
from calstudy.run.task import Input, Task, called
from calstudy.simulate.interface import SimulationSize
from calstudy.verdicts.standing import HIGHEST, LARGEST_ERROR, LOWEST

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.expected_loss import ExpectedTransfer
    from calstudy.calibrate.records import CalibrationResult
    from calstudy.instrument.settings import Beam, Channels
    from calstudy.power.settings import PowerSettings
    from calstudy.simulate.settings import SimulationSettings
    from calstudy.sky.settings import Eor

FACTOR = "factor.json"
EXPECTED_TRANSFER = "expected-transfer"
"""Start of the names of the files of the expected transfer functions, which a polarization follows."""


@memoize
def eor(graph: MeasuredGraph, parity: str) -> Task:
    """Return the task of the EoR at the baselines, integrations and channels of one half."""
    injection, power = graph.experiment.injection, graph.experiment.power
    return SimulateEor(
        f"eor {parity}",
        eor=injection.eor,
        simulation=injection.simulation,
        cosmology=power.cosmology,
        beam=graph.beam,
        channels=graph.channels,
        data=observed(graph, parity),
    )


@memoize
def factor(graph: MeasuredGraph) -> Task:
    """Return the task of the factor of the EoR, which is the same for both halves."""
    level = graph.experiment.injection.level
    return SetLevel("level of the eor", level=level, eor=eor(graph, "even"), calibration=calibrated(graph, "even"))


def _added(graph: MeasuredGraph, parity: str) -> dict[str, Any]:
    return {"eor": eor(graph, parity), "factor": factor(graph), "calibration": calibrated(graph, parity)}


@memoize
def transfer(graph: MeasuredGraph) -> Task | None:
    """Return the task that measures T, or None if nothing is injected."""
    if graph.experiment.injection is None:
        return None
    signals, responses = [], []
    for parity in PARITIES:
        injected = Inject(f"data + eor {parity}", data=observed(graph, parity), **_added(graph, parity))
        blocks = graph.parts.averaging(graph.experiment.power, parity)
        signals.append(AverageEor(f"eor {parity}", **_added(graph, parity), **blocks))
        averages = [average(graph, "residual", parity, data) for data in (injected, None)]
        responses.append(difference(f"response to the eor {parity}", averages, "calibration"))
    return ObservedTransfer(
        "signal loss",
        power=graph.experiment.power,
        signal=cross_power(graph, "eor", signals),
        response=cross_power(graph, "response to the eor", responses),
        cross=cross_power(graph, "eor x response", [signals[0], responses[1]]),
        spectra=observed_spectra(graph),
    )


@memoize
def expected_loss(graph: MeasuredGraph) -> Task | None:
    """Return the task that predicts T for the middle solve; None without a fit by least squares, used as it is."""
    calibrator = graph.experiment.calibration
    if not isinstance(calibrator, GainFit) or calibrator.not_in_expected_loss:
        return None
    power = graph.experiment.power.with_defaults(*NOT_OF_THE_FIT)
    return ExpectedLossOfData(LABEL, power=power, **_of_data(graph, "even"))


@memoize
def expected_transfer(graph: MeasuredGraph, part: str) -> Task:
    """Return the task of the expected transfer function of every baseline, delay and polarization of a part."""
    return ExpectedTransfers(LABEL, **_of_data(graph, part))


def _of_data(graph: MeasuredGraph, part: str) -> dict[str, Any]:
    return {
        "data": observed(graph, part),
        "calibration": calibrated(graph, part),
        "calibrator": graph.experiment.calibration.with_defaults("assumed"),
        "sky_model": graph.experiment.observed.sky_model is not None,
        "probes": PROBES,
    }


class ObservedLossTable(StudyTable):
    """The signal loss and its prediction, if there is an injection."""

    of = "observed"
    place = 2

    def products(self, graph: MeasuredGraph) -> Sequence[Task | None]:
        """Return the products."""
        return [transfer(graph), expected_loss(graph)] if graph.experiment.injection else []


class SimulateEor(Task, stage="observed-eor", version=3):
    """The EoR of one half, in Jy and with the power of its P(k)."""

    eor: Eor
    simulation: SimulationSettings
    cosmology: str
    beam: Beam
    channels: Channels
    data: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the EoR to visibilities.uvh5."""
        from calstudy.instrument.beams import make_beam
        from calstudy.simulate.chunks import assemble, plan_chunks, simulate_chunk
        from calstudy.sky.eor import EorField

        data = crosses_of(read_visibilities(self.data / DATA))
        template = subset_template(data, np.unique(data.time_array), np.asarray(data.freq_array, float))
        if not np.array_equal(antenna_pairs(template), antenna_pairs(data)):
            raise ValueError("the template of the simulation has other baselines than the data")
        field = EorField(self.eor, template.freq_array, make_cosmology(self.cosmology))
        beam, simulation = make_beam(self.beam, self.channels), self.simulation
        model = model_of(self.beam)
        accuracy = simulation.nodes.accuracy(eor=True, smooth_beam=model.smooth, extent=model.extent)
        chunks = plan_chunks(template, accuracy, simulation.chunks)
        cubes = [simulate_chunk(simulation.engine, field.sky(chunk.nodes), beam, template, chunk) for chunk in chunks]
        found = from_cube(data, assemble(chunks, cubes))
        found.flag_array[:] = False
        write_visibilities(found, output / VISIBILITIES)
        return {"rms_jy": float(np.sqrt(np.mean(np.abs(found.data_array) ** 2)))}

    def _cost(self) -> Cost:
        size, simulation = size_of(self), self.simulation
        pixels, channels = 12 * self.eor.nside**2, size.channels.count
        slots = size.times * channels
        tolerance = simulation.nodes.accuracy(eor=True).tolerance
        engine = simulation.engine.cost(SimulationSize(pixels, slots, slots, size.antennas, 1, tolerance))
        at_once = channels / min(simulation.chunks, channels)
        disk = size.samples * COMPLEX128
        memory = engine.memory + pixels * (300 + 55 * at_once) + 3 * disk
        return Cost(10 + engine.seconds, max(memory, LIBRARIES_MEMORY), disk)


class SetLevel(Task, stage="observed-level", version=2):
    """The factor of the EoR, from cross-correlations."""

    level: float | None
    eor: Input
    calibration: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the factor to factor.json."""
        found = 1.0
        sky = read_visibilities(self.eor / VISIBILITIES).data_array
        if self.level is not None:
            model = crosses_of(read_visibilities(self.calibration / MODEL))
            values = model.data_array[~model.flag_array]
            if not values.size or not np.any(values):
                raise InputError(
                    "injection.level: is relative to the fitted foregrounds, which are zero or all flagged"
                )
            rms = [np.sqrt(np.mean(np.abs(array) ** 2)) for array in (values, sky)]
            found = float(10 ** (self.level / 10) * rms[0] / rms[1])
        write_json(output / FACTOR, {"factor": found})
        return {"factor": found}

    def _cost(self) -> Cost:
        return _cost_of_average(self)


class Added(Task):
    """What is made of the EoR multiplied by its factor."""

    eor: Input
    factor: Input
    calibration: Input

    def signal(self) -> UVData:
        """Read the EoR multiplied by its factor."""
        sky = read_visibilities(self.eor / VISIBILITIES)
        sky.data_array *= read_json(self.factor / FACTOR)["factor"]
        return sky


class Inject(Added, stage="inject", version=1):
    """The data plus g_a g_b* times the EoR; nothing is added where there is no solution."""

    data: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the data to data.uvh5."""
        from pyuvdata import UVCal

        data, sky = read_visibilities(self.data / DATA), self.signal()
        pairs = antenna_pairs(sky)
        products, unsolved = gain_products(UVCal.from_file(self.calibration / GAINS), pairs)
        to_cube(data)[:, rows_of(data, pairs)] += np.where(unsolved, 0, products) * to_cube(sky)
        write_visibilities(data, output / DATA)
        return {}

    def _cost(self) -> Cost:
        disk = size_of(self).samples * COMPLEX128
        return Cost(3 + disk * 1e-8, LIBRARIES_MEMORY + 6 * disk, disk)


class AverageEor(Added, InBlocks, stage="observed-eor-average", version=1):
    """The average of the EoR, as added but without the gains, with the baselines and flags of the residual."""

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the average to average.uvh5."""
        from calstudy.power.average import average_in_blocks

        residual, sky = crosses_of(read_visibilities(self.calibration / RESIDUAL)), self.signal()
        signal = from_cube(residual, to_cube(sky)[:, rows_of(sky, antenna_pairs(residual))])
        write_visibilities(average_in_blocks(signal, self.blocks_of(signal)), output / AVERAGE)
        return {}

    def _cost(self) -> Cost:
        return _cost_of_average(self)


class ObservedTransfer(Injected, stage="observed-transfer", version=7, cost=Cost(4, disk=1e6)):
    """T of measured data."""

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write T, spectra of the injected EoR, and the power of the residual corrected by T."""
        found = self.read()
        # The signal was multiplied by the fitted gains: T is free of the unknown flux scale.
        summary = write_transfer(output, found, self.power, 1.0, only_measured=True)
        signals = {}
        for modes, excise in EXCISION.items():
            spectrum = spherical_average(found.signal, self.power, excise)
            signals[modes] = with_errors(spectrum, signal=spectrum)
            save_spectrum(output / spectrum_file("eor", modes), signals[modes])
            write_csv(output / f"eor.{modes}.csv", signals[modes])
        residual = load_spectrum(self.spectra / spectrum_file("residual", "outside-wedge"), SphericalSpectrum)
        write_corrected(output, residual, signals["outside-wedge"], reduced=True)
        return {"transfer": summary, "warnings": _not_measured(summary)}


def _not_measured(summary: Mapping[str, Any]) -> list[str]:
    """Return a sentence that names the bands outside the wedge in which T is not measured; none without any."""
    unknown = [band for band in summary["outside-wedge"] if band["error"] is not None and band["not_measured"]]
    if not unknown:
        return []
    named = ", ".join(f"{low:g} to {high:g} ({band['not_measured']})" for band in unknown for low, high in [band["k"]])
    return [
        f"T is not measured at k of {named} h/Mpc: T is the part of the EoR that is left, so that a T below {LOWEST:g} "
        f"or above {HIGHEST:g} is none, and an error above {LARGEST_ERROR:g} leaves open what it is; interference that "
        "is not flagged (observed.flag_interference: true; if it is on, select a quieter band), few integrations or a "
        "weak injection.level are the usual reasons"
    ]


def _cost_of_average(task: Task) -> Cost:
    size = size_of(task)
    disk = getattr(task, "blocks", 1) * size.samples / size.times * COMPLEX128
    return Cost(2, LIBRARIES_MEMORY + 8 * size.samples * COMPLEX128, disk)


class _OfData(Task):
    """The calibration of a part of measured data, which have the sky model and the noise with them."""

    data: Input
    calibration: Input
    calibrator: GainFit = called("calibration")
    sky_model: bool
    probes: int

    def expect(self, result: CalibrationResult, polarization: int, taper: str) -> ExpectedTransfer | None:
        """Return the expected remainder of a white signal in the middle one of the usable solves, or None without any.

        It is exact for arrays whose matrices are small, and from random vectors for others. The baselines are those of
        the model, repeated for each integration where several were solved together.
        """
        from calstudy.calibrate.expected_loss import DENSE, DelayModes, jacobian_size
        from calstudy.calibrate.expected_loss import expected_transfer as expected_of
        from calstudy.calibrate.preparation import problem_at

        number = int(result.model.polarization_array[polarization])
        usable = [record for record in result.solutions if record.polarization == number and record.usable]
        if not usable:
            return None
        record = usable[len(usable) // 2]
        prepared = prepared_fit(self.calibrator, *read_observed(self.data, self.calibrator, self.sky_model))
        rows = positions(result.gains.ant_array, prepared.data.numbers)
        gains = result.solved_gains(record, rows, polarization)
        problem = problem_at(prepared, self.calibrator, record.times, polarization, gains, record)
        if isinstance(problem, str):
            return None
        model = to_cube(result.model)[record.times, :, :, polarization].reshape(problem.visibilities.shape)
        probes = None if jacobian_size(problem) <= DENSE else self.probes
        return expected_of(problem, gains, model, DelayModes(prepared.data.frequencies, taper), probes)

    def _cost(self) -> Cost:
        return Cost(20, LIBRARIES_MEMORY + 1.5e9 + 10 * size_of(self).samples * COMPLEX128, 1e6)


class ExpectedLossOfData(_OfData, stage="observed-expected-loss", version=3):
    """The expected T of the middle solve of one half of measured data, of the first polarization that has solutions."""

    power: PowerSettings

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the expected T in bins of k and of length and delay."""
        result = read_result(self.calibration)
        expected = (self.expect(result, index, self.power.taper) for index in range(result.model.Npols))
        found = next((one for one in expected if one is not None), None)
        if found is None:
            raise InputError("expected-loss: no solve of the calibration gave gains")
        lengths: np.ndarray = np.linalg.norm(baseline_vectors(result.model), axis=1)
        centre = float(np.mean(result.model.freq_array))
        save_spectrum(output / EXPECTED, binned(found, np.resize(lengths, len(found.transfer)), centre, self.power))
        return {"probes": self.probes}


class ExpectedTransfers(_OfData, stage="expected-transfer", version=1):
    """The expected transfer functions of all polarizations of measured data."""

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the transfer function of every polarization that has solutions to a file of its own."""
        from calstudy.calibrate.expected_loss import TAPER

        result = read_result(self.calibration)
        for index, name in enumerate(result.model.get_pols()):
            found: Any = self.expect(result, index, TAPER)
            if found is not None:
                save_spectrum(output / f"{EXPECTED_TRANSFER}.{name}.h5", found)
        return {"probes": self.probes}
