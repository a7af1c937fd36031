"""Stages `calibrate-chunk` and `calibrate`: from measurements to gains, foreground models and residuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.own import run_calibrator
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.stages.files import read_json, read_visibilities, write_json, write_visibilities
from calstudy.stages.registry import Job

GAINS, SOLUTION = "gains.calh5", "solution.json"
VISIBILITIES = ("model.uvh5", "residual.uvh5")


def _integrations(data: UVData, index: int, count: int, together: int) -> UVData:
    """Return the `index`-th of `count` runs of consecutive integrations, as equal as can be.

    A run ends where one group of integrations that are solved `together` ends.
    """
    together = min(together, data.Ntimes)
    groups = -(-data.Ntimes // together)
    edges = np.linspace(0, groups, count + 1).round().astype(int) * together
    first, last = edges[index] * data.Nbls, min(edges[index + 1], data.Ntimes) * data.Nbls
    return data.select(blt_inds=np.arange(first, last), inplace=False, run_check=False)


def calibrate_chunk(job: Job) -> Mapping[str, Any]:
    """Calibrate a run of consecutive integrations."""
    index, count = job.settings["index"], job.settings["count"]
    settings = CalibrationSettings.model_validate(job.settings["calibration"])
    together = settings.integrations_per_solve
    data = _integrations(read_visibilities(job.inputs["data"] / "data.uvh5"), index, count, together)
    sky_model = None
    if "sky_model" in job.inputs:
        sky_model = read_visibilities(job.inputs["sky_model"] / "visibilities.uvh5")
        sky_model = _integrations(sky_model, index, count, together)
    result = run_calibrator(data, settings, sky_model)
    result.gains.write_calh5(job.output / GAINS)
    for name, uvd in zip(VISIBILITIES, (result.model, result.residual), strict=True):
        write_visibilities(uvd, job.output / name, single=True)
    summary = result.summary()
    write_json(job.output / SOLUTION, summary)
    return {"by_status": summary["by_status"]}


def assemble(job: Job) -> Mapping[str, Any]:
    """Join the runs of integrations into one set of gains, model, residual and solution log."""
    folders = [job.inputs[name] for name in sorted(job.inputs, key=lambda name: int(name.removeprefix("chunk")))]
    gains = UVCal.from_file([str(folder / GAINS) for folder in folders], axis="time")
    gains.write_calh5(job.output / GAINS)
    for name in VISIBILITIES:
        parts = [read_visibilities(folder / name) for folder in folders]
        joined = parts[0].fast_concat(parts[1:], "blt", inplace=False) if len(parts) > 1 else parts[0]
        write_visibilities(joined, job.output / name, single=True)
    records = [record for folder in folders for record in read_json(folder / SOLUTION)["records"]]
    records.sort(key=lambda record: (record["polarization"], record["time"]))
    by_status = dict.fromkeys(sorted({record["status"] for record in records}), 0)
    for record in records:
        by_status[record["status"]] += 1
        record["integration"] = int(np.abs(gains.time_array - record["time"]).argmin())
    write_json(job.output / SOLUTION, {"by_status": by_status, "records": records})
    seconds = [record["seconds"] for record in records]
    return {
        "by_status": by_status,
        "median_steps": float(np.median([record["n_steps"] for record in records])),
        "median_seconds_per_solve": float(np.median(seconds)),
        "warnings": _warnings(by_status, records),
    }


def _warnings(by_status: Mapping[str, int], records: list[Mapping[str, Any]]) -> list[str]:
    unconverged = len(records) - by_status.get("converged", 0)
    if not unconverged:
        return []
    example = next(record for record in records if record["status"] != "converged")
    return [
        f"{unconverged} of {len(records)} solves did not converge "
        f"({', '.join(f'{count} {status}' for status, count in by_status.items())}); integration "
        f"{example['integration']}: {example['message']}"
    ]
