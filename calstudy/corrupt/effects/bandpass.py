"""Gains that are smooth in frequency."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.corrupt.interface import GainEffect
from calstudy.corrupt.shapes import Polynomial, Shape

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class Bandpass(GainEffect):
    """g = 1 + sigma (x + i y), with x and y smooth in frequency, of unit variance, independent for every antenna."""

    version: ClassVar[int] = 2

    sigma: float = Field(
        0.1,
        ge=0,
        le=1,
        description="rms over the band of the real and of the imaginary part of g - 1, each; the default is a "
        "choice of this project.",
    )
    shape: Shape = Polynomial(kind="polynomial")
    seed: int = Field(11, ge=0, description="Seed of x and y.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1, Npols), with an independent draw for every polarization."""
        components = self.shape.components(observation.frequencies)
        shape = observation.n_antennas, observation.n_polarizations, components.shape[1]
        real, imaginary = random.standard_normal((2, *shape)) @ components.T
        return np.moveaxis(1 + self.sigma * (real + 1j * imaginary), 2, 1)[:, :, None]
