"""The delay transform of visibilities (paper §Reduction of Simulation Products and Power Spectra)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT, UNEVEN

FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)

TAPERS = {"blackman-harris": "blackmanharris", "hann": "hann", "tukey": "tukey", "none": "boxcar"}
"""The tapers of `calstudy.power.settings.PowerSettings`, and their names in scipy.signal.windows."""


def make_taper(name: str, n_channels: int) -> np.ndarray:
    """Return the taper T(nu), shape (n_channels,), peak 1; raise ValueError for an unknown name."""
    if name not in TAPERS:
        raise ValueError(f"taper {name!r} is unknown, allowed: {', '.join(TAPERS)}")
    from scipy.signal import windows

    return getattr(windows, TAPERS[name])(n_channels)


def horizon_delay(length: FloatOrArray) -> FloatOrArray:
    """Return the delay of the horizon |b|/c in s for baseline lengths in m, of the same shape."""
    return length / SPEED_OF_LIGHT


def delays(n_channels: int, channel_width: float) -> np.ndarray:
    """Return the delays in s of a band of channels `channel_width` Hz wide, ascending, shape (n_channels,)."""
    return np.fft.fftshift(np.fft.fftfreq(n_channels, d=channel_width))


def delay_transform(visibilities: np.ndarray, frequencies: np.ndarray, taper: str) -> np.ndarray:
    """Transform visibilities from frequency to delay.

    V~(tau) = dnu sum_nu exp(2 pi i tau nu) V(nu) T(nu) (paper, third equation of §Reduction of Simulation Products).
    Visibilities in Jy have frequency along the last axis, the complex result in Jy Hz has delay in the order of
    `delays`. Frequencies are equally spaced ascending channel centres in Hz, (Nfreqs,). Raises ValueError if they do
    not match the last axis or are not equally spaced, or the taper is not in `TAPERS`.
    """
    visibilities = np.asarray(visibilities)
    n_channels = frequencies.size
    if visibilities.shape[-1] != n_channels:
        raise ValueError(f"visibilities have {visibilities.shape[-1]} channels, frequencies {n_channels}")
    width = channel_width(frequencies)
    transform = np.fft.ifft(visibilities * make_taper(taper, n_channels), axis=-1) * (n_channels * width)
    transform = np.fft.fftshift(transform, axes=-1)
    transform *= np.exp(2j * np.pi * delays(n_channels, width) * frequencies[0])
    return transform


def channel_width(frequencies: np.ndarray) -> float:
    """Return the spacing in Hz of `frequencies` (Nfreqs,); raise ValueError unless equally spaced and ascending."""
    steps = np.diff(frequencies)
    if steps.size == 0 or steps.min() <= 0 or np.ptp(steps) > UNEVEN * steps.mean():
        raise ValueError("frequencies must be at least two equally spaced ascending channels")
    return float((frequencies[-1] - frequencies[0]) / steps.size)


def mode_correlation(taper: str, n_channels: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Return the correlation of the powers of two delays of one baseline, for white Gaussian data.

    A taper T mixes neighbouring delays: V~(tau) and V~(tau + m/B) have the correlation A(m) / A(0), where A(m) is
    sum T^2 w exp(2 pi i m n / N), and the powers, products of even and odd data, the modulus of that of both. `weights`
    w are 0 where channels are flagged, of even and odd data, (..., n_channels, 2); None if no channel is. The
    coefficients, means over the leading axes, are for separations of 0, 1, ... n_channels // 2 delay bins, shape
    (n_channels // 2 + 1,); they are periodic in n_channels.
    """
    window = make_taper(taper, n_channels)[:, None] ** 2 * (np.ones((n_channels, 2)) if weights is None else weights)
    amplitude = np.abs(np.fft.rfft(window, axis=-2)).prod(axis=-1)
    return (amplitude / amplitude[..., :1]).reshape(-1, amplitude.shape[-1]).mean(axis=0)
