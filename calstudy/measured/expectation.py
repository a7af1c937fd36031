"""The signal loss to be expected of a finished calibration."""

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
from calstudy.calibrate.interface import USABLE, Assumed
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
    """Return what is expected to be left of a white signal in the middle one of the usable solves.

    Exact for arrays whose matrices are small, from `PROBES` random vectors for others; the baselines are those of
    `result.model`, those of one integration after the other where several were solved together.

    Parameters
    ----------
    data, settings
        As they were given to `calstudy.calibrate.execution.run_calibrator`.
    result
        What it returned.
    assumed
        Sky model and noise, if there were any.
    polarization
        Index of the polarization.
    taper
        Of the delay modes.

    Returns
    -------
    None if no solve of this polarization gave a solution.
    """
    number = int(result.model.polarization_array[polarization])
    usable = [record for record in result.solutions if record.polarization == number and record.status in USABLE]
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
