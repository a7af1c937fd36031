"""Stage `agreement`: measure a calibration against the truth of the simulation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pyuvdata import UVData

from calstudy.calibrate.agreement import Baselines, Fit, Truth, as_json, measure_agreement
from calstudy.instrument.layouts import redundant_groups
from calstudy.stages.files import read_visibilities, write_json
from calstudy.stages.registry import Job
from calstudy.stages.selection import read_gains
from calstudy.visibilities import antenna_pairs, baseline_vectors, to_cube

AGREEMENT = "agreement.json"


def measure(job: Job) -> Mapping[str, Any]:
    """Write the measurements of the first polarization, and how redundant the array is, to agreement.json."""
    data = read_visibilities(job.inputs["data"] / "data.uvh5")
    true, fitted = read_gains(job.inputs["gains"]), read_gains(job.inputs["calibration"])
    solved = ~fitted.flags.any(axis=(1, 2))
    vectors = baseline_vectors(data)
    baselines = Baselines(
        antennas=np.searchsorted(fitted.numbers, antenna_pairs(data)),
        lengths=np.linalg.norm(vectors, axis=1),
        frequency=data.freq_array,
        buffer=job.settings["buffer"],
    )
    truth = Truth(
        gains=true.of(fitted.numbers)[0],
        foregrounds=_cube(job.inputs["foregrounds"] / "visibilities.uvh5")[solved],
        noise=_cube(job.inputs["noise"] / "data.uvh5")[solved],
        data=to_cube(data)[solved, ..., 0],
    )
    model, residual = (_cube(job.inputs["calibration"] / f"{name}.uvh5")[solved] for name in ("model", "residual"))
    found = measure_agreement(truth, Fit(fitted.values[solved], model, residual), baselines)
    write_json(
        job.output / AGREEMENT,
        {
            "measurements": as_json(found),
            "redundant_fraction": _redundant_fraction(vectors, job.settings["redundancy_tolerance"]),
            "integrations": int(solved.sum()),
            "integrations_without_solution": int((~solved).sum()),
        },
    )
    return {}


def _cube(path: Path) -> np.ndarray:
    """Return the first polarization of a product, (Ntimes, Nbls, Nfreqs)."""
    uvd: UVData = read_visibilities(path)
    return to_cube(uvd)[..., 0]


def _redundant_fraction(vectors: np.ndarray, tolerance: float) -> float:
    """Return which part of the baselines has a redundant partner."""
    groups = redundant_groups(vectors, tolerance)
    return float(np.mean(np.bincount(groups.index)[groups.index] > 1))
