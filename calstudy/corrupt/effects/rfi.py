"""Radio-frequency interference, and its flags."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.resources import Cost
from calstudy.base.units import FluxDensity, Fraction
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.size import Size


class Rfi(Effect):
    """Transmitters on the horizon: some channels some of the time, and some integrations in all channels.

    Every affected channel, and every affected integration, has a transmitter of its own, in a random direction, with an
    exponentially distributed flux density in every sample. Occupied samples are flagged in all baselines, but for a
    part that the flagging misses.
    """

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
