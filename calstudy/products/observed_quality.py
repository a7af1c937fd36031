"""Quality of a calibration of measured data: chi^2 against the noise, outliers, and the loss that the fit expects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.settings import GainFit
from calstudy.products.corruption import LEVELS
from calstudy.products.expected_loss import EXPECTED, PROBES, binned
from calstudy.products.files import (
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    SOLUTION,
    VISIBILITIES,
    read_json,
    read_visibilities,
    write_json,
)
from calstudy.products.graph import once, size_of
from calstudy.products.observed import DataGraph, ObservedGraph, calibrated, observed
from calstudy.realdata.halves import PARITIES
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    from pyuvdata import UVData

    from calstudy.calibrate.expected_loss import ExpectedTransfer
    from calstudy.calibrate.preparation import PreparedFit
    from calstudy.calibrate.records import CalibrationResult

QUALITY = "quality.json"
TRANSFER = "expected-transfer"
"""Start of the names of the files of the expected transfer functions, which a polarization follows."""


@once
def quality(graph: DataGraph) -> Task:
    """Return the task that measures the quality of the calibration of all parts."""
    inputs: dict[str, Task] = {}
    for part in graph.parts.facts:
        inputs |= {f"data:{part}": observed(graph, part), f"calibration:{part}": calibrated(graph, part)}
    settings = {
        "calibration": graph.calibration.with_defaults("assumed"),
        "autos": graph.parts.autos,
        "interleaved": graph.parts.interleaved,
        "sky_model": graph.observed.sky_model is not None,
    }
    return Task(OBSERVED_QUALITY, "quality of the calibration", settings, inputs)


@once
def expected(graph: ObservedGraph) -> Task | None:
    """Return the task of the T that the fit itself predicts, or None if it is not a least-squares fit."""
    if not isinstance(graph.calibration, GainFit):
        return None
    power = graph.power.with_defaults("pairs", "redundancy_tolerance", "coherent_time")
    settings = {**_settings(graph), "power": power}
    return Task(EXPECT, "expected signal loss", settings, _inputs(graph, "even"))


@once
def expected_transfer(graph: DataGraph, part: str) -> Task:
    """Return the task of the expected transfer function of every baseline, delay and polarization of a part."""
    return Task(EXPECT_TRANSFER, "expected signal loss", _settings(graph), _inputs(graph, part))


def _inputs(graph: DataGraph, part: str) -> dict[str, Task]:
    return {"data": observed(graph, part), "calibration": calibrated(graph, part)}


def _settings(graph: DataGraph) -> dict[str, Any]:
    sky_model = graph.observed.sky_model is not None
    return {"calibration": graph.calibration.with_defaults("assumed"), "sky_model": sky_model, "probes": PROBES}


def read_result(folder: Path) -> CalibrationResult:
    """Read a product of stage `calibrate`."""
    from pyuvdata import UVCal

    from calstudy.calibrate.records import CalibrationResult, Solve

    model, residual = (read_visibilities(folder / name) for name in (MODEL, RESIDUAL))
    records = tuple(map(Solve.from_json, read_json(folder / SOLUTION)["records"]))
    return CalibrationResult(gains=UVCal.from_file(folder / GAINS), model=model, residual=residual, solutions=records)


def assess(job: Job) -> Mapping[str, Any]:
    """Write chi^2 of each part, chi^2 of integrations that were not fitted, and outliers to quality.json."""
    from calstudy.realdata import quality as standing_out

    summary: dict[str, Any] = {}
    warnings = []
    parts = [name.removeprefix("data:") for name in job.inputs if name.startswith("data:")]
    data = {part: read_visibilities(job.inputs[f"data:{part}"] / DATA) for part in parts}
    results = {part: read_result(job.inputs[f"calibration:{part}"]) for part in parts}
    for part, result in results.items():
        found = [standing_out.assess(data[part], result, index) for index in range(result.model.Npols)]
        prefix = f"{part}: " if len(parts) > 1 else ""
        warnings += [f"{prefix}{sentence}" for item in found for sentence in item.warnings]
        summary[part] = {"quality": [item.described() for item in found], **_chi_squared(job, part, data, results)}
    write_json(job.output / QUALITY, summary)
    return {
        "chi_squared": {
            part: {key: value for key, value in found.items() if key != "quality"} for part, found in summary.items()
        },
        "warnings": warnings,
    }


def _chi_squared(
    job: Job, part: str, data: Mapping[str, UVData], results: Mapping[str, CalibrationResult]
) -> dict[str, Any]:
    """Return chi^2 of one part, as fitted and with the solutions of the other half; empty without autocorrelations."""
    from calstudy.realdata.quality import chi_squared, held_out, predicted

    if not job.settings["autos"]:
        return {}
    total, samples = chi_squared(data[part], predicted(results[part].gains, results[part].model))
    unknowns = _unknowns(job, part, data[part], results[part])
    found: dict[str, Any] = {
        "samples": samples,
        "unknowns": unknowns,
        "per_sample": total / samples if samples else None,
        "per_degree_of_freedom": None if unknowns is None or samples <= unknowns else total / (samples - unknowns),
    }
    if job.settings["interleaved"]:
        other = results[PARITIES[1 - PARITIES.index(part)]]
        total, count = held_out(data[part], predicted(other.gains, other.model))
        found["held_out"] = {
            "samples": count,
            "per_sample": total / count if count else None,
            # The noise of the data, and that of the mean of two predictions.
            "expected": None if unknowns is None or not samples else 1 + 0.5 * unknowns / samples,
        }
    return found


def _unknowns(job: Job, part: str, data: UVData, result: CalibrationResult) -> float | None:
    """Return the number of complex unknowns of all solves of one part; None for a calibration without least squares."""
    from calstudy.calibrate.preparation import make_problem
    from calstudy.realdata.quality import count_unknowns

    settings = job.settings["calibration"]
    if not isinstance(settings, GainFit):
        return None
    prepared, total = _prepared(job, job.inputs[f"data:{part}"], data), 0.0
    polarizations = data.polarization_array.tolist()
    for record in result.solutions:
        if not record.usable:
            continue
        times = slice(record.integration, record.integration + record.n_integrations)
        problem = make_problem(prepared, settings, times, polarizations.index(record.polarization))
        found = None if isinstance(problem, str) else count_unknowns(problem, settings)
        if found is None:
            return None
        total += found
    return total


def _prepared(job: Job, folder: Path, data: UVData) -> PreparedFit:
    """Return the fit of data with the sky model and the noise of the product in a folder."""
    from calstudy.base.observation import Observation
    from calstudy.calibrate.interface import Assumed
    from calstudy.calibrate.preparation import prepare

    settings = job.settings["calibration"]
    sky = Observation(read_visibilities(folder / VISIBILITIES)) if job.settings["sky_model"] else None
    noise = read_json(folder / LEVELS)["noise_std"] if settings.needs_noise else None
    return prepare(Observation(data), settings, Assumed(sky, noise=noise))


def expect(job: Job) -> Mapping[str, Any]:
    """Write the expected T of the middle integration of the even half, in bins of k and of length and delay."""
    import numpy as np

    from calstudy.base.visibilities import baseline_vectors
    from calstudy.power.tables import save_spectrum

    power, result = job.settings["power"], read_result(job.inputs["calibration"])
    found = _expect(job, result, 0, power.taper)
    if found is None:
        raise InputError("expected-loss: no solve of the calibration gave gains")
    lengths: np.ndarray = np.linalg.norm(baseline_vectors(result.model), axis=1)
    centre = float(np.mean(result.model.freq_array))
    save_spectrum(job.output / EXPECTED, binned(found, np.resize(lengths, len(found.transfer)), centre, power))
    return {"probes": job.settings["probes"]}


def expect_transfer(job: Job) -> Mapping[str, Any]:
    """Write the expected transfer function of every polarization that has solutions to a file of its own."""
    from calstudy.calibrate.expected_loss import TAPER
    from calstudy.power.tables import save_spectrum

    result = read_result(job.inputs["calibration"])
    for index, name in enumerate(result.model.get_pols()):
        found: Any = _expect(job, result, index, TAPER)
        if found is not None:
            save_spectrum(job.output / f"{TRANSFER}.{name}.h5", found)
    return {"probes": job.settings["probes"]}


def _expect(job: Job, result: CalibrationResult, polarization: int, taper: str) -> ExpectedTransfer | None:
    """Return the expected remainder of a white signal in the middle one of the usable solves, or None without any.

    It is exact for arrays whose matrices are small, and from random vectors for others. The baselines are those of the
    model, repeated for each integration where several were solved together.
    """
    import numpy as np

    from calstudy.base.visibilities import to_cube
    from calstudy.calibrate.expected_loss import DENSE, DelayModes, jacobian_size
    from calstudy.calibrate.expected_loss import expected_transfer as expected_of
    from calstudy.calibrate.preparation import problem_at

    number = int(result.model.polarization_array[polarization])
    usable = [record for record in result.solutions if record.polarization == number and record.usable]
    if not usable:
        return None
    record, folder = usable[len(usable) // 2], job.inputs["data"]
    times = slice(record.integration, record.integration + record.n_integrations)
    prepared = _prepared(job, folder, read_visibilities(folder / DATA))
    order = np.argsort(result.gains.ant_array)
    rows = order[np.searchsorted(result.gains.ant_array, prepared.data.numbers, sorter=order)]
    gains = result.gains.gain_array[rows, :, times.start, polarization]
    problem = problem_at(prepared, job.settings["calibration"], times, polarization, gains)
    if isinstance(problem, str):
        return None
    model = to_cube(result.model)[times, :, :, polarization].reshape(problem.visibilities.shape)
    probes = None if jacobian_size(problem) <= DENSE else job.settings["probes"]
    return expected_of(problem, gains, model, DelayModes(prepared.data.frequencies, taper), probes)


def _cost(task: Task) -> Cost:
    samples = size_of(task).samples
    return Cost(10 + 1e-5 * samples, LIBRARIES_MEMORY + 20 * samples * COMPLEX128, 1e6)


def _cost_of_expectation(task: Task) -> Cost:
    samples = size_of(task).samples
    return Cost(20, LIBRARIES_MEMORY + 1.5e9 + 10 * samples * COMPLEX128, 1e6)


OBSERVED_QUALITY = Stage(name="observed-quality", version=1, make=assess, cost=_cost)
EXPECT = Stage(name="observed-expected-loss", version=2, make=expect, cost=_cost_of_expectation)
EXPECT_TRANSFER = Stage(name="expected-transfer", version=1, make=expect_transfer, cost=_cost_of_expectation)
