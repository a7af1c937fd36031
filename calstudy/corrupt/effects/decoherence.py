"""Packets that are lost between the boards of a correlator."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.units import Fraction, Frequency
from calstudy.base.visibilities import channels_per_block
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Frame, Observation
    from calstudy.instrument.settings import Size


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
        3, ge=1, description="How many consecutive antennas of the layout share a board; the default is HERA's."
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
