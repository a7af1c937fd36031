"""The calibration under test: gains, foreground models and residuals, solved in runs of consecutive integrations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import COMPLEX64, COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.execution import cost_of
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.records import SETTLED
from calstudy.experiment.model import Variant
from calstudy.products import corruption, sky_model
from calstudy.products.corruption import LEVELS
from calstudy.products.files import (
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    SOLUTION,
    VISIBILITIES,
    integration_times,
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
    from pyuvdata import UVData


@once
def calibration(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the calibration of one noise realization ("even" or "odd") of a variant."""
    # The assumed world enters only through the sky model, which is an input.
    inputs = calibration_inputs(graph, variant, parity)
    model = inputs.get("sky_model")
    calibrator = graph.experiment.calibration.for_data(inputs["data"].key, model.key if model else None)
    return calibration_of(calibrator.with_defaults("assumed"), inputs, temporary=not graph.keep_visibilities)


def calibration_inputs(graph: Graph, variant: Variant, parity: str) -> dict[str, Task]:
    """Return the inputs of the calibration of one noise realization ("even" or "odd") of a variant."""
    inputs, calibrator = {"data": corruption.data(graph, variant, parity)}, graph.experiment.calibration
    if (model := sky_model.sky_model(graph)) is not None:
        inputs["sky_model"] = model
    if calibrator.needs_noise:
        inputs["levels"] = corruption.levels(graph)
    if calibrator.needs_autos:
        inputs["autocorrelations"] = corruption.autocorrelations(graph, variant, parity)
    return inputs


def calibration_of(settings: Calibrator, inputs: Mapping[str, Task], temporary: bool = False) -> Task:
    """Return the task of the calibration of any data.

    The inputs are ``data``; ``sky_model``, if there is one; ``levels``, if the calibrator needs the level of the noise;
    and ``autocorrelations``, if it needs them and the data have none.
    """
    data = inputs["data"]
    solves = -(-size_of(data).times // settings.integrations_per_solve)
    # Gains smoothed in time need all integrations.
    together = settings.smooth_gains is not None and settings.smooth_gains.over_time
    count = 1 if together else min(settings.chunks, solves)
    chunks = {
        f"chunk{index:03d}": Task(
            CALIBRATE_CHUNK,
            f"{data.label} {index + 1}/{count}",
            {"calibration": settings, "index": index, "count": count},
            inputs,
            temporary=True,
        )
        for index in range(count)
    }
    return Task(CALIBRATE, data.label, {}, chunks, temporary=temporary)


def _times_of_chunk(path: Path, index: int, count: int, together: int) -> np.ndarray:
    """Return the times of run `index` of `count` runs of consecutive integrations, which are as equal as possible.

    A run ends at the end of a group of integrations that are solved `together`.
    """
    import numpy as np

    times = integration_times(path)
    together = min(together, times.size)
    groups = -(-times.size // together)
    edges = np.linspace(0, groups, count + 1).round().astype(int) * together
    return times[edges[index] : edges[index + 1]]


def read_calibrated(
    inputs: Mapping[str, Path], times: np.ndarray | None = None
) -> tuple[UVData, UVData | None, float | None]:
    """Read data, sky model and noise level of a calibration at some integrations (JD), by default all.

    The folders are those of `calibration_inputs`; a sky model or noise level that is not an input is None.
    """
    from calstudy.calibrate.sky_model import common_baselines

    data = read_visibilities(inputs["data"] / DATA, times)
    sky = read_visibilities(inputs["sky_model"] / VISIBILITIES, times) if "sky_model" in inputs else None
    if "autocorrelations" in inputs:
        data = with_autocorrelations(data, read_visibilities(inputs["autocorrelations"] / DATA, times))
        if sky is not None:
            sky, data, _ = common_baselines(sky, data, autos=False)
    noise = read_json(inputs["levels"] / LEVELS)["noise_std"] if "levels" in inputs else None
    return data, sky, noise


def with_autocorrelations(data: UVData, autos: UVData) -> UVData:
    """Return data with the autocorrelations of each integration after all other baselines."""
    import numpy as np

    joined = data.fast_concat([autos], "blt", inplace=False)
    rows = [np.arange(uvd.Nblts).reshape(uvd.Ntimes, uvd.Nbls) for uvd in (data, autos)]
    joined.reorder_blts(order=np.hstack([rows[0], data.Nblts + rows[1]]).ravel(), run_check=False)
    return joined


def calibrate_chunk(job: Job) -> Mapping[str, Any]:
    """Calibrate a run of consecutive integrations."""
    from calstudy.base.observation import Observation
    from calstudy.calibrate.execution import run_calibrator
    from calstudy.calibrate.weights import conspicuous

    index, count, settings = (job.settings[name] for name in ("index", "count", "calibration"))
    times = _times_of_chunk(job.inputs["data"] / DATA, index, count, settings.integrations_per_solve)
    data, sky, noise = read_calibrated(job.inputs, times)
    told = conspicuous(Observation(data))
    result = run_calibrator(settings, data, sky, noise=noise)
    result.gains.write_calh5(job.output / GAINS)
    for name, uvd in ((MODEL, result.model), (RESIDUAL, result.residual)):
        write_visibilities(uvd, job.output / name, single=True)
    summary = {**result.summary(), "told": told}
    write_json(job.output / SOLUTION, summary)
    return {"by_status": summary["by_status"]}


def assemble(job: Job) -> Mapping[str, Any]:
    """Join the runs of integrations into one set of gains, model, residual and solution log."""
    import numpy as np
    from pyuvdata import UVCal

    folders = [job.inputs[name] for name in sorted(job.inputs, key=lambda name: int(name.removeprefix("chunk")))]
    gains = UVCal.from_file([str(folder / GAINS) for folder in folders], axis="time")
    gains.write_calh5(job.output / GAINS)
    for name in (MODEL, RESIDUAL):
        parts = [read_visibilities(folder / name) for folder in folders]
        joined = parts[0].fast_concat(parts[1:], "blt", inplace=False) if len(parts) > 1 else parts[0]
        write_visibilities(joined, job.output / name, single=True)
    solutions = [read_json(folder / SOLUTION) for folder in folders]
    records = [record for solution in solutions for record in solution["records"]]
    told = list(dict.fromkeys(text for solution in solutions for text in solution.get("told", [])))
    records.sort(key=lambda record: (record["polarization"], record["time"]))
    by_status = dict.fromkeys(sorted({record["status"] for record in records}), 0)
    for record in records:
        by_status[record["status"]] += 1
        record["integration"] = int(np.abs(gains.time_array - record["time"]).argmin())
    write_json(job.output / SOLUTION, {"by_status": by_status, "records": records})
    seconds = [record["seconds"] for record in records]
    steps = [record["n_steps"] for record in records if record["n_steps"] is not None]
    return {
        "by_status": by_status,
        **({"median_steps": float(np.median(steps))} if steps else {}),
        "median_seconds_per_solve": float(np.median(seconds)),
        "warnings": told + _warnings(by_status, records),
    }


def _warnings(by_status: Mapping[str, int], records: list[Mapping[str, Any]]) -> list[str]:
    unconverged = [record for record in records if record["status"] not in SETTLED]
    if not unconverged:
        return []
    example = unconverged[0]
    stalled = [
        "where solves stall, results depend on where they start: T is not determined better than by the spread of two "
        "starts, which another 'calibration.chunks' shows"
    ]
    return (stalled if "stalled" in by_status else []) + [
        f"{len(unconverged)} of {len(records)} solves did not converge "
        f"({', '.join(f'{count} {status}' for status, count in by_status.items())}); integration "
        f"{example['integration']}: {example['message']}"
    ]


def _cost_of_chunk(task: Task) -> Cost:
    size, pieces = size_of(task), task.settings["count"]
    solves = cost_of(task.settings["calibration"], replace(size, times=-(-size.times // pieces)))
    # Data and sky model, with flags and sample counts, and results.
    files = (COMPLEX64 + COMPLEX128 + 10 + 8 * COMPLEX128) * size.samples / pieces
    return Cost(solves.seconds, solves.memory + files, 2 * size.samples * COMPLEX64 / pieces)


def _cost(task: Task) -> Cost:
    disk = 2 * size_of(task).samples * COMPLEX64
    return Cost(0.7 + disk * 5e-9, LIBRARIES_MEMORY + 3 * disk, disk)


CALIBRATE_CHUNK = Stage(name="calibrate-chunk", version=6, make=calibrate_chunk, cost=_cost_of_chunk)
CALIBRATE = Stage(name="calibrate", version=2, make=assemble, cost=_cost)
