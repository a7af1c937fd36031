"""Quality of a calibration of measured data: chi^2 against the noise, and outliers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.settings import GainFit
from calstudy.products.corruption import LEVELS, PARITIES
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
from calstudy.products.observed import ObservedGraph, calibrated, observed
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    from calstudy.calibrate.records import CalibrationResult

QUALITY = "quality.json"


@once
def quality(graph: ObservedGraph) -> Task:
    """Return the task that measures the quality of the calibration of both halves."""
    inputs: dict[str, Task] = {}
    for parity in PARITIES:
        inputs |= {f"data:{parity}": observed(graph, parity), f"calibration:{parity}": calibrated(graph, parity)}
    settings = {
        "calibration": graph.calibration.with_defaults("assumed"),
        "autos": all(facts.autos for facts in graph.halves.facts.values()),
        "interleaved": graph.halves.interleaved,
        "sky_model": graph.observed.sky_model is not None,
    }
    return Task(OBSERVED_QUALITY, "quality of the calibration", settings, inputs)


def read_result(folder: Path) -> CalibrationResult:
    """Read a product of stage `calibrate`, whose records have only the first and the last loss."""
    from pyuvdata import UVCal

    from calstudy.calibrate.records import CalibrationResult, Solve

    model, residual = (read_visibilities(folder / name) for name in (MODEL, RESIDUAL))
    records = tuple(map(Solve.from_json, read_json(folder / SOLUTION)["records"]))
    return CalibrationResult(gains=UVCal.from_file(folder / GAINS), model=model, residual=residual, solutions=records)


def assess(job: Job) -> Mapping[str, Any]:
    """Write chi^2 of each half, chi^2 of integrations that were not fitted, and outliers to quality.json."""
    from calstudy.measured import quality as standing_out

    summary: dict[str, Any] = {}
    warnings = []
    data = {parity: read_visibilities(job.inputs[f"data:{parity}"] / DATA) for parity in PARITIES}
    results = {parity: read_result(job.inputs[f"calibration:{parity}"]) for parity in PARITIES}
    for parity in PARITIES:
        found = [
            standing_out.assess(data[parity], results[parity], index) for index in range(results[parity].model.Npols)
        ]
        warnings += [f"{parity}: {sentence}" for item in found for sentence in item.warnings]
        summary[parity] = {
            "quality": [item.described() for item in found],
            **_chi_squared(job, parity, data, results),
        }
    write_json(job.output / QUALITY, summary)
    return {
        "chi_squared": {parity: _without(summary[parity], "quality") for parity in PARITIES},
        "warnings": warnings,
    }


def _without(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key != name}


def _chi_squared(
    job: Job, parity: str, data: Mapping[str, Any], results: Mapping[str, CalibrationResult]
) -> dict[str, Any]:
    """Return chi^2 of one half, as fitted and with the solutions of the other half; empty without autocorrelations."""
    from calstudy.measured.goodness import chi_squared, held_out, predicted

    if not job.settings["autos"]:
        return {}
    other = PARITIES[1 - PARITIES.index(parity)]
    own, others = (predicted(results[name].gains, results[name].model) for name in (parity, other))
    total, samples = chi_squared(data[parity], own)
    unknowns = _unknowns(job, parity, data[parity])
    found: dict[str, Any] = {
        "samples": samples,
        "unknowns": unknowns,
        "per_sample": total / samples if samples else None,
        "per_degree_of_freedom": None if unknowns is None or samples <= unknowns else total / (samples - unknowns),
    }
    if job.settings["interleaved"]:
        total, count = held_out(data[parity], others)
        found["held_out"] = {
            "samples": count,
            "per_sample": total / count if count else None,
            # The noise of the data, and that of the mean of two predictions.
            "expected": None if unknowns is None or not samples else 1 + 0.5 * unknowns / samples,
        }
    return found


def _unknowns(job: Job, parity: str, data: Any) -> float | None:
    """Return the number of complex unknowns of all solves of one half; None for a calibration without least squares."""
    from calstudy.base.observation import Observation
    from calstudy.calibrate.interface import Assumed
    from calstudy.calibrate.preparation import make_problem, prepare
    from calstudy.calibrate.records import USABLE
    from calstudy.measured.goodness import count_unknowns

    settings = job.settings["calibration"]
    if not isinstance(settings, GainFit):
        return None
    folder = job.inputs[f"data:{parity}"]
    sky = Observation(read_visibilities(folder / VISIBILITIES)) if job.settings["sky_model"] else None
    noise = read_json(folder / LEVELS)["noise_std"] if settings.needs_noise else None
    prepared = prepare(Observation(data), settings, Assumed(sky, noise=noise))
    total = 0.0
    polarizations = data.polarization_array.tolist()
    for record in read_json(job.inputs[f"calibration:{parity}"] / SOLUTION)["records"]:
        if record["status"] not in USABLE:
            continue
        times = slice(record["integration"], record["integration"] + record["n_integrations"])
        problem = make_problem(prepared, settings, times, polarizations.index(record["polarization"]))
        found = None if isinstance(problem, str) else count_unknowns(problem, settings)
        if found is None:
            return None
        total += found
    return total


def _cost(task: Task) -> Cost:
    samples = size_of(task).samples
    return Cost(10 + 1e-5 * samples, LIBRARIES_MEMORY + 20 * samples * COMPLEX128, 1e6)


OBSERVED_QUALITY = Stage(name="observed-quality", version=1, make=assess, cost=_cost)
