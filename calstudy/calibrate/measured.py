"""From visibilities in files' terms to the problems that solvers take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.joint import JointGroup
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.products import require_parallel_hands
from calstudy.calibrate.redundant_start import redundant_start
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.starts import starting_gains
from calstudy.calibrate.structure import make_structure, repeat_structure
from calstudy.calibrate.weights import make_weights
from calstudy.errors import InputError
from calstudy.gains import read_gains
from calstudy.visibilities import antenna_pairs, flag_cube, to_cube


@dataclass(frozen=True, eq=False)
class Measured:
    """The arrays of a calibration.

    Attributes
    ----------
    data
        The visibilities that are calibrated: without the autocorrelations, unless they are fitted.
    numbers
        The antenna numbers that indices of the structure stand for, (Nants,).
    structure
        Of the fit of one integration.
    visibilities, weights
        Shape (Ntimes, Nbls, Nfreqs, Npols).
    start
        Gains to start from, (Nants, Nfreqs, Ntimes, Npols).
    sky
        The sky model like the visibilities, or None.
    """

    data: UVData
    numbers: np.ndarray
    structure: FitStructure
    visibilities: np.ndarray
    weights: np.ndarray
    start: np.ndarray
    sky: np.ndarray | None


def measure(
    data: UVData,
    settings: CalibrationSettings,
    sky_model: UVData | None = None,
    gains: UVCal | None = None,
    joint: Sequence[JointGroup] = (),
) -> Measured:
    """Collect what is fitted; parameters and errors as in `calstudy.calibrate.calamity.calibrate`."""
    fitted = _fitted_baselines(data, settings.autos)
    weights = make_weights(data, fitted, settings.weights)
    data = _keep(data, fitted)
    sky = None
    if sky_model is not None:
        sky = _matching_cube(fitted_part(sky_model, settings.autos), data)
    elif settings.calibrator == "sky-based":
        raise InputError("calibration.calibrator: 'sky-based' needs a sky model, and there is none")
    _require_finite(data)
    structure, numbers = make_structure(data, settings, joint)
    if gains is None and settings.initial_gains.kind == "file":
        gains = read_gains(settings.initial_gains.path, "calibration.initial_gains.path")
    if gains is None and settings.initial_gains.kind == "redundant":
        start = redundant_start(data, numbers, weights, settings.initial_gains, settings.redundancy_tolerance)
    else:
        start = starting_gains(data, numbers, gains)
    return Measured(data, numbers, structure, to_cube(data), weights, start, sky)


def make_problem(
    measured: Measured, settings: CalibrationSettings, times: slice, polarization: int
) -> CalibrationProblem | str:
    """Return the problem of some consecutive integrations together, or the reason why there is none."""
    structure = repeat_structure(measured.structure, times.stop - times.start)

    def rows(cube: np.ndarray) -> np.ndarray:
        return cube[times, :, :, polarization].reshape(structure.n_baselines, structure.n_frequencies)

    weights, visibilities = rows(measured.weights), rows(measured.visibilities)
    flagged = float(np.mean(weights == 0))
    if flagged == 1:
        return "every sample is flagged or has no weight"
    if flagged >= settings.skip_flagged:
        return f"{100 * flagged:.0f} % of the samples are flagged, which skip_flagged excludes"
    if not np.any(visibilities, where=weights > 0):
        return "the data are zero"
    return CalibrationProblem(
        structure,
        visibilities,
        weights,
        measured.start[:, :, times.start, polarization],
        None if measured.sky is None else rows(measured.sky),
        settings.prior,
        settings.calibrator == "sky-based",
    )


def _fitted_baselines(data: UVData, autos: bool) -> np.ndarray:
    """Return which baselines are calibrated, shape (Nbls,), after checking that there are some."""
    require_parallel_hands(data)
    to_cube(data)
    is_auto = antenna_pairs(data)[:, 0] == antenna_pairs(data)[:, 1]
    if autos and not is_auto.any():
        raise ValueError("calibration.autos is true, but the data hold no autocorrelations")
    if not autos and is_auto.all():
        raise ValueError("the data hold no cross-correlations, so that there is nothing to calibrate")
    return np.ones(is_auto.shape, bool) if autos else ~is_auto


def fitted_part(data: UVData, autos: bool) -> UVData:
    """Return the baselines that are calibrated; raises as `calibrate` does if there are none."""
    return _keep(data, _fitted_baselines(data, autos))


def _keep(data: UVData, fitted: np.ndarray) -> UVData:
    if fitted.all():
        return data
    return data.select(blt_inds=np.flatnonzero(np.tile(fitted, data.Ntimes)), inplace=False)


def _require_finite(data: UVData) -> None:
    bad = ~(np.isfinite(to_cube(data)) | flag_cube(data))
    if bad.any():
        t, baseline, channel, _ = np.argwhere(bad)[0]
        a, b = antenna_pairs(data)[baseline]
        raise ValueError(
            f"{bad.sum()} unflagged visibilities are not finite, the first on baseline ({a}, {b}), integration {t}, "
            f"channel {channel}; flag them"
        )


def _matching_cube(sky_model: UVData, data: UVData) -> np.ndarray:
    """Return the sky model's cube; ValueError unless it has the baselines, times, channels and hands of the data."""
    sky = to_cube(sky_model)
    if (
        sky.shape != to_cube(data).shape
        or not np.array_equal(antenna_pairs(sky_model), antenna_pairs(data))
        or not np.allclose(sky_model.freq_array, data.freq_array, rtol=1e-9, atol=0)
        or not np.allclose(sky_model.time_array, data.time_array, rtol=0, atol=1e-6)
        or not np.array_equal(sky_model.polarization_array, data.polarization_array)
    ):
        raise ValueError(
            "the sky model must have the baselines, times, channels and polarizations of the data, in the same order"
        )
    return sky
