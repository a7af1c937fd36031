"""Signals that leak between the analogue chains of two antennas."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.units import Delay, FluxDensity
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class Crosstalk(Effect):
    """A term in every baseline that is constant in time: c exp(-2 pi i nu tau), with c complex normal, tau normal.

    Kern et al. (2019) found such terms in HERA, at delays of cables.
    """

    uses_positions: ClassVar[bool] = False

    amplitude: FluxDensity = Field(
        0.1, ge=0, description="rms of the modulus of c over the baselines; the default is a choice of this project."
    )
    delay: Delay = Field(
        900e-9, description="Mean of the normal distribution of the delay; the default is a choice of this project."
    )
    delay_scatter: Delay = Field(
        50e-9,
        ge=0,
        description="Standard deviation of the delay over the baselines; the default is a choice of this project.",
    )
    seed: int = Field(8, ge=0, description="Seed of the amplitudes and delays.")

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return amplitudes (Jy, complex) and delays (s) of the cross-correlations, (Nbls, 1, Npols)."""
        shape = (observation.n_baselines, 1, observation.n_polarizations)
        real, imaginary = random.standard_normal((2, *shape))
        amplitude = self.amplitude * (real + 1j * imaginary) / np.sqrt(2)
        amplitude[observation.autos] = 0
        return {"amplitude": amplitude, "delay": random.normal(self.delay, self.delay_scatter, shape)}

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the visibilities with the same terms added at every time."""
        turns = observation.frequencies[:, None] * truth["delay"]
        visibilities += truth["amplitude"] * np.exp(-2j * np.pi * turns)
        return visibilities
