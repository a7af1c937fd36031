"""The expected signal loss of a finished calibration."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVData

from calstudy.base.observation import Observation
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.expected_loss import (
    DENSE,
    TAPER,
    DelayModes,
    ExpectedTransfer,
    expected_transfer,
    jacobian_size,
)
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.preparation import prepare, problem_at
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import GainFit

PROBES = 16


def expect(
    data: UVData,
    settings: GainFit,
    result: CalibrationResult,
    assumed: Assumed | None = None,
    polarization: int = 0,
    taper: str = TAPER,
) -> ExpectedTransfer | None:
    """Return the expected remainder of a white signal in the middle one of the usable solves.

    It is exact for arrays whose matrices are small, and from `PROBES` random vectors for others. The baselines are
    those of `result.model`, repeated for each integration where several were solved together. `data`, `settings` and
    `assumed` (sky model and noise) are those of `calstudy.calibrate.execution.run_calibrator`, and `result` is its
    result; `polarization` is an index, `taper` that of the delay modes. Return None if no solve of this polarization
    gave a solution.
    """
    number = int(result.model.polarization_array[polarization])
    usable = [record for record in result.solutions if record.polarization == number and record.usable]
    if not usable:
        return None
    record = usable[len(usable) // 2]
    times = slice(record.integration, record.integration + record.n_integrations)
    prepared = prepare(Observation(data), settings, assumed or Assumed())
    solved = result.gains
    rows = np.searchsorted(solved.ant_array, prepared.data.numbers, sorter=np.argsort(solved.ant_array))
    antennas = np.argsort(solved.ant_array)[rows]
    gains = solved.gain_array[antennas, :, times.start, polarization]
    problem = problem_at(prepared, settings, times, polarization, gains)
    if isinstance(problem, str):
        return None
    model = to_cube(result.model)[times, :, :, polarization].reshape(problem.visibilities.shape)
    probes = None if jacobian_size(problem) <= DENSE else PROBES
    modes = DelayModes(prepared.data.frequencies, taper)
    return expected_transfer(problem, gains, model, modes, probes)
