"""Thermal noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calstudy.corrupt.temperature import effective_area

if TYPE_CHECKING:
    from calstudy.corrupt.settings import RadiometerNoise
    from calstudy.instrument.settings import InstrumentSettings

AUTOCORRELATIONS = 1
"""A list of seeds gives another stream than any single number does."""


def radiometer_std(noise: RadiometerNoise, instrument: InstrumentSettings) -> np.ndarray:
    """Return the standard deviation of the complex noise, V_aa / sqrt(width integration nights), Jy, (Nfreqs, Npols).

    The beam of the instrument gives the effective area where the noise settings do not.
    """
    from calstudy.instrument.beams import make_beam

    channels = instrument.channels
    frequencies = channels.first + channels.width * np.arange(channels.count)
    if noise.effective_area is not None:
        areas = [np.full(channels.count, noise.effective_area)] * len(instrument.polarizations)
    else:
        beam = make_beam(instrument.beam, channels)
        solid_angles = (beam.solid_angles(frequencies, polarization)[0] for polarization in instrument.polarizations)
        areas = [effective_area(frequencies, omega_p) for omega_p in solid_angles]
    samples = channels.width * instrument.times.integration * noise.nights
    return np.stack([noise.autocorrelations(frequencies, area) for area in areas], axis=-1) / np.sqrt(samples)


def thermal_noise(shape: tuple[int, ...], std: float | np.ndarray, seed: int) -> np.ndarray:
    """Draw circular complex Gaussian noise with E|n|^2 = std^2, independent in every sample, complex128.

    `std` is a number or an array that broadcasts with the shape; the real and the imaginary part have std / sqrt(2)
    each. The same seed and shape give the same noise.
    """
    rng = np.random.default_rng(seed)
    noise = np.empty(shape, dtype=np.complex128)
    noise.real = rng.standard_normal(shape)
    noise.imag = rng.standard_normal(shape)
    noise *= std / np.sqrt(2)
    return noise


def autocorrelations(shape: tuple[int, ...], std: float | np.ndarray, samples: float, seed: int) -> np.ndarray:
    """Draw autocorrelations of antennas whose cross-correlations have noise, before any gains, float64, Jy.

    By the radiometer equation noise of E|n|^2 = std^2 comes from autocorrelations of std sqrt(samples), sky and
    receiver together, whose own noise has the standard deviation std. `std` is a number or an array that broadcasts;
    `samples` is the channel width times the averaged time. The same seed and shape give the same autocorrelations,
    independent of `thermal_noise` of this seed.
    """
    rng = np.random.default_rng([seed, AUTOCORRELATIONS])
    return np.asarray(std * (np.sqrt(samples) + rng.standard_normal(shape)))
