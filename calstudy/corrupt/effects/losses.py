"""Data that are lost in an instrument: channels that it does not deliver, dead antennas, packets between boards."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.units import Fraction, Frequency
from calstudy.base.visibilities import channels_per_block
from calstudy.corrupt.drift import refusal_of_antennas
from calstudy.corrupt.interface import Effect, Truth
from calstudy.instrument.as_built import Antennas

if TYPE_CHECKING:
    from calstudy.base.observation import Frame, Observation
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
        frequencies = size.channels.frequencies
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

    @property
    def drawn_seeds(self) -> dict[str, int | tuple[int, int]]:
        """What seeds the choice; nothing where antennas are named."""
        return {} if self.antennas else super().drawn_seeds

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


class Decoherence(Effect):
    """Packets lost between boards: V_ab becomes (1 - p_a)(1 - p_b) V_ab if a and b are on different boards.

    The model is that of hera_cal's skycal. The loss p of a board is constant in a block of channels, and in time.
    Autocorrelations and baselines within a board lose nothing.
    """

    uses_positions: ClassVar[bool] = False

    kind: str = "decoherence"
    loss: Fraction = Field(
        0.05,
        ge=0,
        lt=1,
        description="Largest loss p, which is uniform from 0 for every board and block; HERA calls an antenna suspect "
        "above the default.",
    )
    chance: Fraction = Field(1.0, gt=0, le=1, description="Chance of a board to lose anything in a block.")
    per_board: int = Field(
        3, ge=1, description="How many antennas, in the order of their numbers, share a board; the default is HERA's."
    )
    block: Frequency = Field(
        11.71875e6,
        gt=0,
        description="Width of the blocks of channels, from the first on, rounded to whole channels; the default is "
        "HERA's, 96 channels of 122 kHz.",
    )
    drop: bool = Field(False, description="Flag the baselines within a board.")
    seed: int = Field(15, ge=0, description="Seed of the losses.")

    @property
    def can_flag(self) -> bool:
        """True if baselines within a board are dropped."""
        return self.drop

    def refusal(self, size: Size) -> str | None:
        """Refuse fewer than two boards, and to flag all baselines but those between two boards."""
        boards, least = -(-size.antennas // self.per_board), 3 if self.drop else 2
        if boards >= least:
            return None
        reason = ", for baselines between two boards leave open how their gains compare" if self.drop else ""
        return (
            f"per_board: {size.antennas} antennas are on {boards} {'board' if boards == 1 else 'boards'}, and {least} "
            f"are needed{reason}; per_board must be at most {(size.antennas - 1) // (least - 1)}"
        )

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return the loss p of every board and block, (Nboards, Nblocks), and the board of every antenna, (Nants,)."""
        boards = np.arange(observation.n_antennas) // self.per_board
        blocks = -(-observation.n_channels // channels_per_block(observation.frequencies, self.block))
        shape = (boards[-1] + 1, blocks)
        losses = self.loss * random.uniform(size=shape)
        return {"p": np.where(random.uniform(size=shape) < self.chance, losses, 0), "board": boards}

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the visibilities times what is left of them."""
        block = np.arange(observation.n_channels) // channels_per_block(observation.frequencies, self.block)
        kept = (1 - truth["p"])[truth["board"]][:, block]
        first, second = observation.antennas.T
        factors = kept[first] * kept[second]
        factors[_within(observation, truth)] = 1
        visibilities *= factors[:, :, None]
        return visibilities

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray | None:
        """Return the flags of the baselines within a board, (1, Nbls, 1, 1); None if they are kept."""
        if not self.drop:
            return None
        return (_within(observation, truth) & ~observation.autos)[None, :, None, None]


def _within(observation: Frame, truth: Truth) -> np.ndarray:
    """Whether the antennas of each baseline share a board, bool, (Nbls,)."""
    first, second = truth["board"][observation.antennas].T
    return first == second
