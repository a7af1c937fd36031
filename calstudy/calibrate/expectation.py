"""The signal loss to be expected of a finished calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pyuvdata import UVData

from calstudy.calibrate.absorption import DENSE, ExpectedTransfer, expected_transfer, jacobian_size
from calstudy.calibrate.joint import JointGroup
from calstudy.calibrate.measured import make_problem, measure
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.tangent import DelayModes
from calstudy.visibilities import to_cube

PROBES = 16


def expect(
    data: UVData,
    settings: CalibrationSettings,
    result: CalibrationResult,
    sky_model: UVData | None = None,
    polarization: int = 0,
    joint: Sequence[JointGroup] = (),
) -> ExpectedTransfer | None:
    """Return what is expected to be left of a white signal in the middle one of the usable solves.

    Exact for arrays whose matrices are small, from `PROBES` random vectors for others; the baselines are those of
    `result.model`, those of one integration after the other where several were solved together.

    Parameters
    ----------
    data, settings, sky_model, joint
        As they were given to `calstudy.calibrate.calamity.calibrate`.
    result
        What it returned.
    polarization
        Index of the polarization.

    Returns
    -------
    None if no solve of this polarization gave a solution.
    """
    number = int(result.model.polarization_array[polarization])
    usable = [
        record
        for record in result.solutions
        if record.polarization == number and record.status in ("converged", "max-steps", "stalled")
    ]
    if not usable:
        return None
    record = usable[len(usable) // 2]
    times = slice(record.integration, record.integration + record.n_integrations)
    measured = measure(data, settings, sky_model, joint=joint)
    problem = make_problem(measured, settings, times, polarization)
    solved = result.gains
    rows = np.searchsorted(solved.ant_array, measured.numbers, sorter=np.argsort(solved.ant_array))
    antennas = np.argsort(solved.ant_array)[rows]
    gains = solved.gain_array[antennas, :, times.start, polarization]
    model = to_cube(result.model)[times, :, :, polarization].reshape(problem.visibilities.shape)
    probes = None if jacobian_size(problem) <= DENSE else PROBES
    modes = DelayModes(np.asarray(data.freq_array, float))
    return expected_transfer(problem, gains, model, modes, probes)
