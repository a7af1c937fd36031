"""Antennas without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class DeadAntennas(Effect):
    """Flags of all baselines of some antennas: named ones, or a number of them at random."""

    version: ClassVar[int] = 2

    antennas: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="Counted from 0 in the order of the layout; empty: `count` at random."
    )
    count: int = Field(1, ge=1, description="How many are drawn, where none are named.")
    seed: int = Field(12, ge=0)

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return the antenna numbers, ascending.

        Raises
        ------
        InputError
            If an antenna is not there, or fewer than three would be left.
        """
        numbers = np.asarray(observation.uvd.telescope.antenna_numbers)
        if self.antennas and max(self.antennas) >= len(numbers):
            raise InputError(
                f"corruption.effects: dead-antennas: antennas has {max(self.antennas)}, but there are {len(numbers)}, "
                "counted from 0"
            )
        if len(numbers) - (len(set(self.antennas)) or self.count) < 3:
            raise InputError("corruption.effects: dead-antennas: fewer than three antennas would be left")
        dead = list(self.antennas) or random.choice(len(numbers), self.count, replace=False)
        return {"numbers": np.unique(numbers[dead])}

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the flags of the baselines, (1, Nbls, 1, 1)."""
        dead = np.isin(observation.pairs, truth["numbers"])
        return (dead[:, 0] | dead[:, 1])[None, :, None, None]
