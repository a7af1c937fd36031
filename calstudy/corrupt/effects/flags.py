"""Channels that an instrument does not deliver, and antennas without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.units import Frequency
from calstudy.corrupt.drift import Antennas, refusal_of_antennas
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.settings import Size


class ChannelFlags(Effect):
    """Flags of channels, of all baselines and times: the edges of the band, and of coarse channels and their centres.

    The defaults are those of the MWA, whose coarse channels are centred at multiples of 1.28 MHz and lose 80 kHz at
    either edge, and the central channel (Offringa et al. 2015).
    """

    uses_positions: ClassVar[bool] = False

    kind: str = "channel-flags"
    band_edges: Frequency = Field(0.0, ge=0, description="Flagged at either end of the band.")
    coarse_width: Frequency | None = Field(
        1.28e6, gt=0, description="Width of coarse channels, which are centred at its multiples; null: there are none."
    )
    coarse_edges: Frequency = Field(80e3, ge=0, description="Flagged at either edge of a coarse channel.")
    coarse_centres: bool = Field(True, description="Whether the channel at the centre of a coarse channel is flagged.")

    def refusal(self, size: Size) -> str | None:
        """Refuse to flag all channels."""
        frequencies = size.channels.first + size.channels.width * np.arange(size.channels.count)
        if not self._flagged(frequencies).all():
            return None
        flagged = f"all {size.channels.count} channels would be flagged"
        if not self.model_copy(update={"coarse_width": None})._flagged(frequencies).all():
            return (
                f"{flagged} by band_edges, coarse_edges and coarse_centres together; one channel at least must be left"
            )
        # From an end of the band to the centre of the channel that is farthest from both ends.
        most = ((size.channels.count + 1) // 2 - 0.5) * size.channels.width
        return f"band_edges: {self.band_edges / 1e6:g} MHz: {flagged}; {most / 1e6:g} MHz at most do not cover the band"

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return a mask of the flagged channels, (Nfreqs,)."""
        del random
        return {"channels": self._flagged(observation.frequencies)}

    def _flagged(self, frequencies: np.ndarray) -> np.ndarray:
        """Return a mask of the flagged channels, bool, (Nfreqs,), from their centres in Hz."""
        # Half a channel lies between the outermost centres and the ends of the band. Frequencies are good to 1 Hz.
        half = (frequencies[-1] - frequencies[0]) / (len(frequencies) - 1) / 2
        low, high = frequencies[0] - half, frequencies[-1] + half
        flagged = np.minimum(frequencies - low, high - frequencies) < self.band_edges - 1
        if self.coarse_width is not None:
            offset = (frequencies / self.coarse_width + 0.5) % 1 * self.coarse_width - self.coarse_width / 2
            flagged |= self.coarse_width / 2 - np.abs(offset) < self.coarse_edges - 1
            if self.coarse_centres:
                # The upper one of two channels that meet at the centre.
                flagged |= (offset - half <= 1) & (offset + half > 1)
        return flagged

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the flags, (1, 1, Nfreqs, 1)."""
        del observation
        return truth["channels"][None, None, :, None]


LEAST = 3
"""Smallest number of antennas left: fewer do not determine the gain of each."""


class DeadAntennas(Effect):
    """Flags of all baselines of some antennas: named ones, or a number of them at random."""

    version: ClassVar[int] = 2
    uses_positions: ClassVar[bool] = False

    kind: str = "dead-antennas"
    antennas: Antennas = Field((), description="Counted from 0 in the order of the layout; empty: `count` at random.")
    count: int = Field(1, ge=1, description="How many are drawn, where none are named.")
    seed: int = Field(12, ge=0, description="Seed of the choice of `count` antennas.")

    def refusal(self, size: Size) -> str | None:
        """Refuse antennas that do not exist, and to leave fewer than three."""
        return self._refusal(size.antennas)

    def _refusal(self, count: int) -> str | None:
        """Return why the effect cannot be applied to `count` antennas, or None."""
        if (reason := refusal_of_antennas(self.antennas, count)) is not None:
            return f"antennas: {reason}"
        field, dead = ("antennas", len(set(self.antennas))) if self.antennas else ("count", self.count)
        if count - dead < LEAST:
            return (
                f"{field}: {dead} of {count} antennas would be dead; at most {max(count - LEAST, 0)} can be, for "
                f"{LEAST} must be left"
            )
        return None

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return the antenna numbers, ascending; raise InputError with the sentence of `refusal`."""
        numbers = np.asarray(observation.uvd.telescope.antenna_numbers)
        if (reason := self._refusal(len(numbers))) is not None:
            raise InputError(f"corruption.effects: dead-antennas: {reason}")
        dead = list(self.antennas) or random.choice(len(numbers), self.count, replace=False)
        return {"numbers": np.unique(numbers[dead])}

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the flags of the baselines, (1, Nbls, 1, 1)."""
        dead = np.isin(observation.pairs, truth["numbers"])
        return (dead[:, 0] | dead[:, 1])[None, :, None, None]
