"""Gains with reflections in the cables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.units import Delay
from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class ReflectionGains(GainEffect):
    """One cable reflection per antenna: r exponential, tau normal, phi uniform (paper Eq. REFGAIN, §Low SNR)."""

    amplitude: float = Field(0.01, ge=0, lt=1, description="Mean of the exponential distribution of r.")
    delay: Delay = Field(1200e-9, description="Mean of the normal distribution of the delay.")
    delay_scatter: Delay = Field(100e-9, ge=0, description="Standard deviation of that distribution.")
    seed: int = Field(5, ge=0, description="Seed of r, tau and phi.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1, Npols), with an independent draw for every polarization.

        Raise InputError if a drawn amplitude is not below one: such a reflection does not decay.
        """
        shape = (observation.n_polarizations, observation.n_antennas)
        amplitudes = random.exponential(self.amplitude, shape)
        delays = random.normal(self.delay, self.delay_scatter, shape)
        phases = random.uniform(0, 2 * np.pi, shape)
        if amplitudes.max() >= 1:
            raise InputError(
                f"corruption.effects: amplitude = {self.amplitude}: drew a reflection of {amplitudes.max():.2f}, which "
                "must stay below 1; use a smaller mean"
            )
        gains = reflection_gain(observation.frequencies, amplitudes[..., None], delays[..., None], phases[..., None])
        return gains.transpose(1, 2, 0)[:, :, None]


def reflection_gain(
    frequencies: np.ndarray, amplitude: float | np.ndarray, delay: float | np.ndarray, phase: float | np.ndarray
) -> np.ndarray:
    """Evaluate g = 1 / (1 + r exp[-i (2 pi nu tau + phi)]) (paper Eq. REFGAIN).

    Frequencies are in Hz; r is below 1, tau in s and phi in rad, numbers or arrays that broadcast with the frequencies.
    """
    return 1 / (1 + amplitude * np.exp(-1j * (2 * np.pi * frequencies * delay + phase)))
