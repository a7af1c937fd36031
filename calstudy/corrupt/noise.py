"""Thermal noise: the temperature of sky and receiver, the `corruption.noise` section, and draws."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from calstudy.base.constants import BOLTZMANN, SPEED_OF_LIGHT
from calstudy.base.schema import Section, choice, fault
from calstudy.base.units import Area, Frequency, Temperature

WATTS_PER_JANSKY = 1e-26


class SystemTemperature(Section):
    """The temperature of sky and receiver: receiver + sky (nu / sky_frequency)^sky_index."""

    receiver: Temperature = Field(50.0, ge=0, description="Of the receiver (Tingay et al. 2013, of the MWA).")
    sky: Temperature = Field(
        180.0, ge=0, description="Of the sky at `sky_frequency` (Furlanetto et al. 2006, away from the Galactic plane)."
    )
    sky_frequency: Frequency = Field(
        180e6, gt=0, description="At which the temperature of the sky is `sky` (Furlanetto et al. 2006)."
    )
    sky_index: float = Field(-2.6, ge=-5, le=1, description="Spectral index of the temperature of the sky.")

    def autocorrelations(self, frequencies: np.ndarray, effective_area: float | np.ndarray) -> np.ndarray:
        """Return V_aa = k T / A_e in Jy, (Nfreqs,), in the convention V_xx = 1/2 int A I of the simulation.

        Frequencies are channel centres, Hz, (Nfreqs,); the effective area is in m2, a number or (Nfreqs,).
        """
        kelvin = self.receiver + self.sky * (frequencies / self.sky_frequency) ** self.sky_index
        return BOLTZMANN * kelvin / effective_area / WATTS_PER_JANSKY


class Autocorrelations(SystemTemperature):
    """Autocorrelations of all antennas: k_B (receiver + sky (nu / sky_frequency)^sky_index) / effective_area."""

    effective_area: Area = Field(
        21.5,
        gt=0,
        description="Of an antenna (Tingay et al. 2013, of a tile of the MWA); required with any `instrument.beam` but "
        "mwa-*.",
    )


def effective_area(frequencies: np.ndarray, omega_p: np.ndarray) -> np.ndarray:
    """Return A_e = lambda^2 / Omega_p of a beam without losses, m2, from Hz and the solid angle of its power, sr."""
    return (SPEED_OF_LIGHT / frequencies) ** 2 / omega_p


AUTOCORRELATIONS = 1
"""A list of seeds gives another stream than any single number does."""


def _different(seeds: tuple[int, int]) -> tuple[int, int]:
    if seeds[0] == seeds[1]:
        raise fault("", f"of even and odd are both {seeds[0]}: their noise would be the same")
    return seeds


Seed = Annotated[int, Field(ge=0)]
Seeds = Annotated[
    tuple[Seed, Seed],
    Field(description="Seeds of the even and odd realization."),
    AfterValidator(_different),
]


OF_TWINS = Field(
    None,
    description="Seeds of data without the EoR; null: the noise of the data with it, so that their difference is the "
    "EoR alone. Blind challenges need noise of its own.",
)


class NoiseRelativeToEor(Section):
    """Thermal noise with a standard deviation of `factor` times the rms of the EoR visibilities (paper: 10)."""

    kind: Literal["times-eor"] = "times-eor"
    factor: float = Field(10.0, gt=0, le=1e9)
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class NoiseRelativeToForegrounds(Section):
    """Thermal noise of `factor` times the rms of the foreground visibilities (paper §Low SNR: 0.1)."""

    kind: Literal["times-foregrounds"]
    factor: float = Field(0.1, gt=0, le=1e9)
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class RadiometerNoise(SystemTemperature):
    """Thermal noise in absolute units, by the radiometer equation: k_B T / (A_e sqrt(width x integration x nights)).

    T is receiver + sky (nu / sky_frequency)^sky_index. This is the standard deviation of the complex noise in xx or yy,
    per baseline, channel, integration and realization; width and integration are those of the instrument. Foregrounds
    are in absolute units; for the EoR to be so too, set `corruption.eor_level` to null.
    """

    kind: Literal["radiometer"]
    effective_area: Area | None = Field(
        None, gt=0, description="Of an antenna; null: wavelength^2 over the solid angle of `instrument.beam`."
    )
    nights: int = Field(1, ge=1, description="Nights at the same sidereal time that are averaged coherently.")
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class NoNoise(Section):
    """No thermal noise: the even and odd data are the same."""

    kind: Literal["none"]


Noise = Annotated[
    NoiseRelativeToEor | NoiseRelativeToForegrounds | RadiometerNoise | NoNoise, choice("kind", "times-eor")
]


def thermal_noise(shape: tuple[int, ...], std: float | np.ndarray, seed: int) -> np.ndarray:
    """Draw circular complex Gaussian noise with E|n|^2 = std^2, independent in every sample, complex128.

    `std` is a number or an array that broadcasts with the shape. The same seed and shape give the same noise.
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
