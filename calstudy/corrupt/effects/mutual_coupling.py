"""Signals that antennas receive from each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.base.units import Length
from calstudy.corrupt.interface import Effect, Truth
from calstudy.corrupt.temperature import Autocorrelations

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.size import Size


class MutualCoupling(Effect):
    """First-order coupling: V_ij becomes V_ij + sum_k (e_ik V_kj + e_jk* V_ik) (Josaitis et al. 2022).

    e_ik = e_ki = amplitude (distance / |b_ik|)^falloff exp[i (phi_ik - 2 pi nu |b_ik| / c)], with phi_ik uniform. The
    terms with k = j and k = i have the autocorrelations of the antennas, which simulations do not have.
    """

    amplitude: float = Field(
        1e-3,
        ge=0,
        lt=1,
        description="Modulus of e for two antennas at `distance`, a ratio of voltages; the default is a "
        "choice of this project.",
    )
    distance: Length = Field(
        14.0,
        gt=0,
        description="Distance of two antennas at which the modulus of e is `amplitude`; the default is a "
        "choice of this project.",
    )
    falloff: float = Field(1.0, ge=0, le=4, description="Exponent; 1: a wave that spreads in all directions.")
    autos: Autocorrelations | None = Field(
        Autocorrelations(), description="Autocorrelations of the antennas; null: zero."
    )
    seed: int = Field(6, ge=0, description="Seed of the phases phi.")

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return moduli, delays (s) and phases (rad) of the coefficients, symmetric, (Nants, Nants), zero for itself.

        Raise InputError if two antennas are at the same place.
        """
        separations = observation.positions[:, None] - observation.positions
        distances = np.linalg.norm(separations, axis=-1)
        others = ~np.eye(observation.n_antennas, dtype=bool)
        if (distances[others] == 0).any():
            raise InputError("corruption.effects: mutual-coupling: two antennas are at the same place")
        modulus = np.zeros(distances.shape)
        modulus[others] = self.amplitude * (self.distance / distances[others]) ** self.falloff
        phase = np.triu(random.uniform(0, 2 * np.pi, distances.shape), 1)
        return {"modulus": modulus, "delay": distances / SPEED_OF_LIGHT, "phase": phase + phase.T}

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return V + e V + V e^H for the matrix V of all pairs of antennas, and the matrix e of the coefficients.

        Raise InputError if the data lack baselines.
        """
        first, second = observation.antennas.T
        count = observation.n_antennas
        if (
            len({frozenset(pair) for pair in observation.antennas.tolist() if len(set(pair)) == 2})
            < count * (count - 1) // 2
        ):
            raise InputError("corruption.effects: mutual-coupling: needs the baselines of all pairs of antennas")
        turns = truth["delay"] * observation.frequencies[:, None, None]
        coefficients = truth["modulus"] * np.exp(1j * (truth["phase"] - 2 * np.pi * turns))
        pairs = np.zeros((observation.n_channels, count, count), complex)
        if self.autos is not None:
            pairs[:, range(count), range(count)] = self.autos.jansky(observation.frequencies)[:, None]
        for integration in visibilities:
            for polarization in np.moveaxis(integration, -1, 0):
                pairs[:, first, second], pairs[:, second, first] = polarization.T, polarization.T.conj()
                coupled = coefficients @ pairs
                # e V and V e^H are conjugate transposes of each other, for V is Hermitian.
                polarization += (coupled[:, first, second] + coupled[:, second, first].conj()).T
        return visibilities

    def cost(self, size: Size) -> Cost:
        """Return the cost of a product of matrices for every channel, integration and polarization."""
        slots = size.channels.count * size.times * size.polarizations
        return Cost(1e-9 * slots * size.antennas**3, 64 * size.channels.count * size.antennas**2)
