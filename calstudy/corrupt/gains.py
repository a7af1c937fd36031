"""The corrupting gains of a study: drawn, exactly unity, or read from a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calstudy.errors import InputError
from calstudy.gains import gains_for, make_uvcal, read_gains

if TYPE_CHECKING:
    from pathlib import Path

    from pyuvdata import UVCal, UVData

    from calstudy.corrupt.settings import Gains, ReflectionGains


def per_channel_gains(n_antennas: int, n_channels: int, sigma: float, seed: int) -> np.ndarray:
    """Draw g = 1 + sigma (n + i n') with n, n' standard normal (paper §Reduction of Simulation Products).

    Returns
    -------
    ndarray, complex128, shape (n_antennas, n_channels)
        Independent for every antenna and channel.
    """
    rng = np.random.default_rng(seed)
    real, imaginary = rng.standard_normal((2, n_antennas, n_channels))
    return 1 + sigma * (real + 1j * imaginary)


def reflection_gain(frequencies: np.ndarray, amplitude: float, delay: float, phase: float) -> np.ndarray:
    """Evaluate g = 1 / (1 + r exp[-i (2 pi nu tau + phi)]) (paper Eq. REFGAIN).

    Parameters
    ----------
    frequencies
        In Hz, any shape.
    amplitude, delay, phase
        r (below 1), tau in seconds, and phi in radian.
    """
    return 1 / (1 + amplitude * np.exp(-1j * (2 * np.pi * frequencies * delay + phase)))


def draw_reflection_gains(n_antennas: int, frequencies: np.ndarray, settings: ReflectionGains) -> np.ndarray:
    """Draw one cable reflection per antenna: r exponential, tau normal, phi uniform (paper §Low SNR).

    Returns
    -------
    ndarray, complex128, shape (n_antennas, Nfreqs)

    Raises
    ------
    InputError
        If a drawn amplitude is not below one: such a reflection does not decay.
    """
    rng = np.random.default_rng(settings.seed)
    amplitudes = rng.exponential(settings.amplitude, n_antennas)
    delays = rng.normal(settings.delay, settings.delay_scatter, n_antennas)
    phases = rng.uniform(0, 2 * np.pi, n_antennas)
    if amplitudes.max(initial=0) >= 1:
        raise InputError(
            f"corruption.gains.amplitude = {settings.amplitude}: drew a reflection of {amplitudes.max():.2f}, "
            "which must stay below 1; use a smaller mean"
        )
    return reflection_gain(frequencies, amplitudes[:, None], delays[:, None], phases[:, None])


def gains_from_file(path: Path, template: UVData) -> UVCal:
    """Read a CalH5 or calfits file of gains that are constant in time; flagged gains are taken as unity.

    Returns
    -------
    UVCal
        In the convention "divide", with the template's antennas, channels and polarizations.

    Raises
    ------
    InputError
        If the file cannot be read, holds several times, or lacks antennas, channels or polarizations of the template.
    """
    gains = read_gains(path, "corruption.gains.path")
    if gains.Ntimes != 1:
        raise InputError(
            f"corruption.gains.path = {str(path)!r}: holds {gains.Ntimes} times; the corrupting gains are constant in "
            "time, so that one is needed"
        )
    values = gains_for(gains, template)
    return make_uvcal(template, np.where(np.isfinite(values), values, 1))


def make_gains(settings: Gains, template: UVData) -> UVCal:
    """Return the true gains, constant in time, for the antennas, channels and polarizations of `template`.

    Every polarization of an antenna gets an independent draw.

    Raises
    ------
    InputError
        If a gain file does not fit the template, or a drawn reflection does not decay.
    """
    if settings.kind == "file":
        return gains_from_file(settings.path, template)
    n_antennas, n_feeds = template.Nants_telescope, template.Npols
    frequencies = template.freq_array
    if settings.kind == "unity":
        gains = np.ones((n_antennas * n_feeds, frequencies.size), dtype=complex)
    elif settings.kind == "per-channel":
        gains = per_channel_gains(n_antennas * n_feeds, frequencies.size, settings.sigma, settings.seed)
    else:
        gains = draw_reflection_gains(n_antennas * n_feeds, frequencies, settings)
    return make_uvcal(template, gains.reshape(n_feeds, n_antennas, 1, -1).transpose(1, 3, 2, 0))
