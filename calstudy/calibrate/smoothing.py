"""Smooth gains in frequency and time, after they were fitted in every channel and integration."""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.polynomial.legendre import legvander

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.calibrate.basis import channel_grid, dpss_vectors, restrict
from calstudy.calibrate.interface import DpssSmoothing, PolynomialSmoothing, SmoothCal, Smoothing

EIGENVALUE_CUTOFF = 1e-9
"""Sequences with a smaller concentration are left out, as hera_cal does."""
SECONDS_PER_DAY = 86400.0


def smooth(
    gains: np.ndarray, flags: np.ndarray, data: Observation, numbers: np.ndarray, settings: Smoothing
) -> np.ndarray:
    """Smooth gains, (Nants, Nfreqs, Ntimes, Npols); flagged ones have no influence and stay as they are.

    Channels and integrations are those of `data`; `numbers` are those of the antennas, (Nants,). Raises InputError if
    the reference antenna has no gains, if channels or integrations are not even where they must be, or if there are too
    few integrations.
    """
    values = np.where(flags, 0, gains)
    if settings.reference_antenna is not None:
        if settings.reference_antenna not in numbers:
            raise _fault(f"reference_antenna: there is no antenna {settings.reference_antenna} in the data")
        reference = values[np.flatnonzero(numbers == settings.reference_antenna)[0]]
        if ((reference == 0) & ~flags.all(axis=0)).any():
            raise _fault(f"reference_antenna: antenna {settings.reference_antenna} is flagged where others are not")
        values = values * np.exp(-1j * np.angle(reference))
    smoothed = values.copy()
    if isinstance(settings, SmoothCal):
        if len(data.times) < 2:
            raise _fault("smooth-cal smooths over time, and there is a single integration")
        for a, p in np.argwhere(~flags.all(axis=(1, 2))):
            smoothed[a, :, :, p] = _smooth_cal(values[a, :, :, p].T, flags[a, :, :, p].T, data, settings).T
    else:
        in_frequency, in_time = _vectors(settings, data)
        for a, p in np.argwhere(~flags.all(axis=(1, 2))):
            smoothed[a, :, :, p] = fit(values[a, :, :, p], ~flags[a, :, :, p], in_frequency, in_time)
    return np.where(flags, gains, smoothed)


def _fault(sentence: str) -> InputError:
    return InputError(f"calibration.smooth_gains: {sentence}")


def _vectors(settings: Smoothing, data: Observation) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return orthonormal functions of frequency (Nfreqs, Nf) and of time (Ntimes, Nt), None for all."""
    seconds = (data.times - data.times[0]) * SECONDS_PER_DAY
    if isinstance(settings, PolynomialSmoothing):
        return _polynomials(data.frequencies, settings.frequency_degree), _polynomials(seconds, settings.time_degree)
    assert isinstance(settings, DpssSmoothing)
    return (
        _sequences(data.frequencies, settings.frequency_scale, "channels"),
        _sequences(seconds, settings.time_scale, "integrations"),
    )


def _polynomials(x: np.ndarray, degree: int | None) -> np.ndarray | None:
    if degree is None or degree + 1 >= x.size:
        return None
    scaled = 2 * (x - x.min()) / np.ptp(x) - 1
    return np.linalg.qr(legvander(scaled, degree))[0]


def _sequences(x: np.ndarray, scale: float | None, noun: str) -> np.ndarray | None:
    """Return sequences whose Fourier transform is concentrated within 1 / scale; None if they span everything."""
    if scale is None or x.size < 2:
        return None
    try:
        grid = channel_grid(x)
    except InputError:
        raise _fault(f"the {noun} must lie on an even grid to be smoothed by sequences") from None
    half_bandwidth = grid.n_channels * grid.width / scale
    if 2 * half_bandwidth >= grid.n_channels:
        return None
    return restrict(dpss_vectors(grid.n_channels, half_bandwidth, EIGENVALUE_CUTOFF), grid, EIGENVALUE_CUTOFF)


def fit(
    values: np.ndarray, used: np.ndarray, in_frequency: np.ndarray | None, in_time: np.ndarray | None
) -> np.ndarray:
    """Fit products of functions of frequency and of time to the used values in least squares.

    `values` are complex, (Nfreqs, Ntimes), and `used` is bool, of the same shape. Functions are orthonormal columns,
    (Nfreqs, Nf) and (Ntimes, Nt); with None, each channel or integration is fitted by itself.
    """
    if in_frequency is None and in_time is None:
        return values
    if in_frequency is None:
        return fit(values.T, used.T, in_time, None).T
    if used.all():
        partial = in_frequency @ (in_frequency.T @ values)
        return partial if in_time is None else (partial @ in_time) @ in_time.T
    if in_time is None:
        return np.column_stack([_weighted(values[:, t], used[:, t], in_frequency) for t in range(values.shape[1])])
    functions = np.einsum("fi,tj->ftij", in_frequency, in_time).reshape(values.size, -1)
    return _weighted(values.ravel(), used.ravel(), functions).reshape(values.shape)


def _weighted(values: np.ndarray, used: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """Fit functions (N, Nfunctions) to the used values (N,)."""
    if not used.any():
        return values
    # Functions that are degenerate on the used samples get the combination of minimum norm.
    normal = functions[used].T @ functions[used]
    return functions @ (
        np.linalg.pinv(normal, rcond=EIGENVALUE_CUTOFF, hermitian=True) @ (functions[used].T @ values[used])
    )


def _smooth_cal(gains: np.ndarray, flags: np.ndarray, data: Observation, settings: SmoothCal) -> np.ndarray:
    """Smooth gains (Ntimes, Nfreqs) as hera_cal does."""
    from hera_cal.smooth_cal import time_freq_2D_filter

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # hera_cal divides by what may be zero, and replaces it.
        warnings.simplefilter("ignore")
        found, _ = time_freq_2D_filter(
            gains,
            (~flags).astype(float),
            data.frequencies,
            data.times,
            freq_scale=settings.frequency_scale / 1e6,
            time_scale=settings.time_scale,
            method="DPSS",
        )
    if not (np.isfinite(found) & (found != 0) | flags).all() or not math.isfinite(np.abs(found[~flags]).max()):
        raise _fault("smooth-cal left gains that are not finite")
    return np.asarray(found)
