"""The power that antennas receive: temperatures of sky and receiver, and the resulting autocorrelations."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from calstudy.base.constants import BOLTZMANN, SPEED_OF_LIGHT
from calstudy.base.schema import Section
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

    def kelvin(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the system temperature, K, (Nfreqs,), at channel centres in Hz."""
        return self.receiver + self.sky * (frequencies / self.sky_frequency) ** self.sky_index

    def autocorrelations(self, frequencies: np.ndarray, effective_area: float | np.ndarray) -> np.ndarray:
        """Return V_aa = k T / A_e in Jy, (Nfreqs,), in the convention V_xx = 1/2 int A I of the simulation.

        Frequencies are channel centres, Hz, (Nfreqs,); the effective area of an antenna is in m2, a number or
        (Nfreqs,).
        """
        return BOLTZMANN * self.kelvin(frequencies) / effective_area / WATTS_PER_JANSKY


class Autocorrelations(SystemTemperature):
    """Autocorrelations of all antennas: k_B (receiver + sky (nu / sky_frequency)^sky_index) / effective_area."""

    effective_area: Area = Field(
        21.5,
        gt=0,
        description="Of an antenna (Tingay et al. 2013, of a tile of the MWA); required with any `instrument.beam` but "
        "mwa-*.",
    )

    def jansky(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the autocorrelations, Jy, (Nfreqs,), at channel centres in Hz."""
        return self.autocorrelations(frequencies, self.effective_area)


def effective_area(frequencies: np.ndarray, omega_p: np.ndarray) -> np.ndarray:
    """Return A_e = lambda^2 / Omega_p of a beam without losses, m2, from Hz and the solid angle of its power, sr."""
    return (SPEED_OF_LIGHT / frequencies) ** 2 / omega_p
