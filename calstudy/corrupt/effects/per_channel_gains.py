"""Gains that are independent in every channel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class PerChannelGains(GainEffect):
    """g = 1 + sigma (n + i n'), independent per antenna and channel (paper §Simulations)."""

    sigma: float = Field(
        0.1, ge=0, le=10, description="rms of the real and of the imaginary part of g - 1, each (paper §Simulations)."
    )
    seed: int = Field(5, ge=0, description="Seed of n and n'.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1, Npols), with an independent draw for every polarization."""
        shape = observation.n_polarizations, observation.n_antennas, observation.n_channels
        real, imaginary = random.standard_normal((2, *shape))
        gains = 1 + self.sigma * (real + 1j * imaginary)
        return gains.transpose(1, 2, 0)[:, :, None]
