"""Signals that are added to visibilities: crosstalk, mutual coupling, and radio-frequency interference."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.base.units import Delay, FluxDensity, Fraction, Length
from calstudy.corrupt.interface import Effect, Truth
from calstudy.corrupt.noise import Autocorrelations

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.settings import Size


class Crosstalk(Effect):
    """A term in every baseline that is constant in time: c exp(-2 pi i nu tau), with c complex normal, tau normal.

    Kern et al. (2019) found such terms in HERA, at delays of cables. All baselines (a, b), with a before b in the order
    of antennas, have theirs at tau and none at -tau, as if a leaked into b, and b not into a: results depend on that
    order.
    """

    uses_positions: ClassVar[bool] = False

    kind: str = "crosstalk"
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


class MutualCoupling(Effect):
    """First-order coupling: V_ij becomes V_ij + sum_k (e_ik V_kj + e_jk* V_ik) (Josaitis et al. 2022).

    e_ik = e_ki = amplitude (distance / |b_ik|)^falloff exp[i (phi_ik + 2 pi nu |b_ik| / c)], with phi_ik uniform. The
    sign of the delay, which is that of the code of that paper, makes the signal of k late in i: like gains,
    visibilities V_ij turn by exp(2 pi i nu tau) where antenna i is late by tau. The terms with k = j and k = i have the
    autocorrelations of the antennas, which simulations do not have.
    """

    # What antennas receive from each other is late by the way of light since 2; before, it was early.
    version: ClassVar[int] = 2
    kind: str = "mutual-coupling"
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
        """Return moduli, delays (s) and phases (rad) of the coefficients, symmetric, (Nants, Nants)."""
        separations = observation.positions[:, None] - observation.positions
        distances = np.linalg.norm(separations, axis=-1)
        others = ~np.eye(observation.n_antennas, dtype=bool)
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
        if len({frozenset(pair) for pair in observation.antennas[~observation.autos].tolist()}) < math.comb(count, 2):
            raise InputError("corruption.effects: mutual-coupling: needs the baselines of all pairs of antennas")
        turns = truth["delay"] * observation.frequencies[:, None, None]
        coefficients = truth["modulus"] * np.exp(1j * (truth["phase"] + 2 * np.pi * turns))
        pairs = np.zeros((observation.n_channels, count, count), complex)
        if self.autos is not None:
            own = self.autos.autocorrelations(observation.frequencies, self.autos.effective_area)
            pairs[:, range(count), range(count)] = own[:, None]
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


class Rfi(Effect):
    """Transmitters on the horizon: some channels some of the time, and some integrations in all channels.

    Every affected channel, and every affected integration, has a transmitter of its own, in a random direction, with an
    exponentially distributed flux density in every sample. Occupied samples are flagged in all baselines, but for a
    part that the flagging misses.
    """

    kind: str = "rfi"
    channels: Fraction = Field(
        0.03, ge=0, le=1, description="Chance of a channel to be affected; the default is a choice of this project."
    )
    duty_cycle: Fraction = Field(
        0.5,
        ge=0,
        le=1,
        description="Part of the integrations in which it then is occupied; the default is a choice of this project.",
    )
    broadband: Fraction = Field(0.0, ge=0, le=1, description="Chance of an integration to be occupied in all channels.")
    missed: Fraction = Field(0.0, ge=0, le=1, description="Part of the occupied samples that is not flagged.")
    flux: FluxDensity = Field(
        100.0,
        ge=0,
        description="Mean of the flux density times the beam, in a visibility, where a sample is occupied; "
        "the default is a choice of this project.",
    )
    seed: int = Field(10, ge=0, description="Seed of what is occupied, flux densities, directions and missed samples.")

    def refusal(self, size: Size) -> str | None:
        """Refuse to flag all samples for certain."""
        del size
        if self.missed > 0:
            return None
        if self.broadband == 1:
            return (
                "broadband: 100 % with missed 0 % would flag all samples; it must be below 100 %, or missed above 0 %"
            )
        if self.channels == 1 and self.duty_cycle == 1:
            return (
                "channels: 100 % with duty_cycle 100 % and missed 0 % would flag all samples; channels or duty_cycle "
                "must be below 100 %, or missed above 0 %"
            )
        return None

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return flux densities (Jy) and directions (azimuth, east through north, rad), and flags, (Ntimes, Nfreqs)."""
        shape = observation.n_times, observation.n_channels
        affected = random.random(shape[1]) < self.channels
        narrow = affected & (random.random(shape) < self.duty_cycle)
        broad = random.random((shape[0], 1)) < self.broadband
        azimuths = [random.uniform(0, 2 * np.pi, size) for size in (shape[1], (shape[0], 1))]
        occupied = narrow | broad
        return {
            "flux": np.where(occupied, random.exponential(1.0, shape) * self.flux, 0),
            "azimuth": np.where(broad, azimuths[1], azimuths[0]),
            "flagged": occupied & (random.random(shape) >= self.missed),
        }

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return V + S exp(2 pi i nu b.s / c), with the baseline b and the direction s of the transmitter."""
        # Few samples are occupied; adding them one by one needs no array of the size of the data.
        for time, channel in np.argwhere(truth["flux"] > 0):
            azimuth = truth["azimuth"][time, channel]
            path = observation.vectors[:, 0] * np.cos(azimuth) + observation.vectors[:, 1] * np.sin(azimuth)
            turns = observation.frequencies[channel] * path / SPEED_OF_LIGHT
            visibilities[time, :, channel] += (truth["flux"][time, channel] * np.exp(2j * np.pi * turns))[:, None]
        return visibilities

    def cost(self, size: Size) -> Cost:
        """Return the cost of the occupied samples of all baselines."""
        occupied = self.broadband + (1 - self.broadband) * self.channels * self.duty_cycle
        samples = occupied * size.times * size.channels.count
        return Cost(samples * (2e-5 + 6e-8 * size.baselines), memory=0.0)

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the flags, (Ntimes, 1, Nfreqs, 1)."""
        del observation
        return truth["flagged"][:, None, :, None].astype(bool)
