"""Levels of the components of a measurement relative to one another."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.corrupt.noise import RadiometerNoise, effective_area

if TYPE_CHECKING:
    from calstudy.corrupt.settings import CorruptionSettings
    from calstudy.instrument.settings import InstrumentSettings


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Amplitudes of the components, in Jy.

    `foreground_rms` and `eor_rms` are rms of the visibilities as simulated, over baselines other than autocorrelations,
    times and channels; `eor_factor` multiplies the EoR. `noise_std` is the standard deviation of the complex noise per
    baseline, channel, integration and realization; its rms over channels where they differ. `noise_spectrum`,
    (Nfreqs, Npols), then holds it for every channel and polarization.
    """

    foreground_rms: float
    eor_rms: float
    eor_factor: float
    noise_std: float
    noise_spectrum: list[list[float]] | None = None

    @property
    def noise(self) -> float | np.ndarray:
        """Standard deviation of the noise, a number or (Nfreqs, Npols)."""
        return self.noise_std if self.noise_spectrum is None else np.array(self.noise_spectrum)

    def as_json(self) -> dict[str, Any]:
        """Return the amplitudes as plain JSON types, without absent ones."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def rms(visibilities: np.ndarray) -> float:
    """Return sqrt(mean |V|^2) over all samples."""
    return float(np.sqrt(np.mean(visibilities.real**2 + visibilities.imag**2)))


def noise_of_samples(noise: float | np.ndarray, amplitudes: np.ndarray, used: np.ndarray) -> float:
    """Return sigma of the noise of samples after gains; its inverse square is the mean of their inverse variances.

    `noise` is sigma before gains, a number or (Nfreqs, Npols). `amplitudes`, |g_a g_b|, and `used`, bool, broadcast to
    (Ntimes, Nbls, Nfreqs, Npols). Samples that are not used, or whose gains are zero, do not count.
    """
    sigma, used = np.broadcast_arrays(noise * amplitudes, used & (amplitudes > 0))
    return float(np.mean(1 / sigma[used] ** 2) ** -0.5) if used.any() and np.any(noise) else 0.0


def radiometer_std(noise: RadiometerNoise, instrument: InstrumentSettings) -> np.ndarray:
    """Return the standard deviation of the complex noise, V_aa / sqrt(width integration nights), Jy, (Nfreqs, Npols).

    The beam of the instrument gives the effective area where the noise settings do not.
    """
    from calstudy.instrument.beams import make_beam

    channels = instrument.channels
    frequencies = channels.frequencies
    if noise.effective_area is not None:
        areas = [np.full(channels.count, noise.effective_area)] * len(instrument.polarizations)
    else:
        beam = make_beam(instrument.beam, channels)
        solid_angles = (beam.solid_angles(frequencies, polarization)[0] for polarization in instrument.polarizations)
        areas = [effective_area(frequencies, omega_p) for omega_p in solid_angles]
    samples = channels.width * instrument.times.integration * noise.nights
    return np.stack([noise.autocorrelations(frequencies, area) for area in areas], axis=-1) / np.sqrt(samples)


def eor_factor(foreground_rms: float, eor_rms: float, level: float | None) -> float:
    """Return the factor that scales the EoR to a level below the foregrounds in decibels; one if that is None.

    The rms are those of the simulated visibilities, Jy. Raise InputError if one of them is zero that is needed.
    """
    if eor_rms <= 0:
        raise InputError("sky.eor: its visibilities are all zero")
    if level is None:
        return 1.0
    if foreground_rms <= 0:
        raise InputError("corruption.eor_level: the foregrounds it refers to are all zero")
    return 10 ** (level / 10) * foreground_rms / eor_rms


def set_levels(
    foreground_rms: float, eor_rms: float, settings: CorruptionSettings, radiometer: np.ndarray | None = None
) -> Levels:
    """Scale the EoR to `eor_level` below the foregrounds and the noise to its reference.

    The paper's decibels are of brightness: -40 dB is a ratio of rms visibilities of 1e-4, so that the residuals' -45 dB
    are -90 dB in the power spectrum. The rms of the simulated visibilities and the standard deviation of radiometer
    noise, (Nfreqs, Npols), are in Jy. Raise InputError if a component is zero that must be scaled, or scaled to.
    """
    factor = eor_factor(foreground_rms, eor_rms, settings.eor_level)
    noise, spectrum = settings.noise, None
    if noise.kind == "none":
        std = 0.0
    elif noise.kind == "radiometer":
        if radiometer is None:
            raise ValueError("radiometer noise needs its standard deviation")
        std, spectrum = rms(radiometer), radiometer.tolist()
    elif noise.kind == "times-eor":
        std = noise.factor * factor * eor_rms
    else:
        std = noise.factor * foreground_rms
    return Levels(
        foreground_rms=foreground_rms, eor_rms=eor_rms, eor_factor=factor, noise_std=std, noise_spectrum=spectrum
    )
