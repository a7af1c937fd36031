"""Arrays of the diagnostic figure of a calibration."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVData

from calstudy.base.visibilities import antenna_pairs, baseline_vectors, flag_cube, to_cube
from calstudy.calibrate.basis import channel_grid
from calstudy.calibrate.records import CalibrationResult
from calstudy.measured.quality import assess
from calstudy.observed.diagnostics_figure import MAX_ANTENNAS, Diagnostics, delay_rms


def diagnose(data: UVData, result: CalibrationResult, polarization: int = 0) -> Diagnostics:
    """Collect the arrays of the diagnostic figure for one polarization, given by its index.

    `data` are those of `calstudy.calibrate.execution.run_calibrator`, and `result` is its result.
    """
    model = result.model
    kept = {tuple(pair) for pair in antenna_pairs(model).tolist()}
    rows = np.array([tuple(pair) in kept for pair in antenna_pairs(data).tolist()])
    lengths = np.linalg.norm(baseline_vectors(model), axis=1)
    order = np.argsort(lengths, kind="stable")
    grid = channel_grid(np.asarray(model.freq_array, float))
    flags = flag_cube(result.residual)[..., polarization]
    measured = np.where(flags, 0, to_cube(data)[..., polarization][:, rows])
    spectra = [
        delay_rms(np.where(flags, 0, cube)[:, order], grid.positions, grid.n_channels)
        for cube in (measured, to_cube(model)[..., polarization], to_cube(result.residual)[..., polarization])
    ]
    antennas, gains = _shown_gains(result, polarization)
    number = int(model.polarization_array[polarization])
    records = [record for record in result.solutions if record.polarization == number]
    quality = assess(data, result, polarization)
    return Diagnostics(
        polarization=model.get_pols()[polarization],
        unit=model.vis_units,
        delay=np.fft.fftshift(np.fft.fftfreq(grid.n_channels, grid.width)),
        lengths=lengths[order],
        data=spectra[0],
        model=spectra[1],
        residual=spectra[2],
        frequency=np.asarray(model.freq_array, float),
        antennas=antennas,
        gains=gains,
        losses=tuple(record.loss_history / record.loss_history[0] for record in records if record.loss_history.size),
        chi2_antennas=quality.antennas,
        chi2_by_antenna=quality.chi2_by_antenna,
        chi2_by_channel=quality.chi2_by_channel,
        chi2_by_integration=quality.chi2_by_integration,
        converged=np.array([record.status == "converged" for record in records if record.loss_history.size]),
    )


def _shown_gains(result: CalibrationResult, polarization: int) -> tuple[np.ndarray, np.ndarray]:
    """Return names of antennas with solutions, spread over the array, and their gains, NaN where flagged."""
    gains = result.gains
    flags = gains.flag_array[..., polarization]
    used = np.flatnonzero(~flags.all(axis=(1, 2)))
    used = (
        used[np.unique(np.linspace(0, used.size - 1, min(used.size, MAX_ANTENNAS)).astype(int))] if used.size else used
    )
    values = np.where(flags[used], np.nan, gains.gain_array[used, :, :, polarization])
    times = np.flatnonzero(~flags.all(axis=(0, 1)))
    middle = times[times.size // 2] if times.size else 0
    names = dict(zip(gains.telescope.antenna_numbers.tolist(), gains.telescope.antenna_names, strict=True))
    return np.array([str(names[int(number)]) for number in gains.ant_array[used]]), values[:, :, middle]
