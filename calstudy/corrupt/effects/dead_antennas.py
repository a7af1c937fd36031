"""Antennas without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.corrupt.interface import Effect, Truth

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.size import Size

LEAST = 3
"""Smallest number of antennas left: fewer do not determine the gain of each."""


class DeadAntennas(Effect):
    """Flags of all baselines of some antennas: named ones, or a number of them at random."""

    version: ClassVar[int] = 2
    uses_positions: ClassVar[bool] = False

    antennas: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="Counted from 0 in the order of the layout; empty: `count` at random."
    )
    count: int = Field(1, ge=1, description="How many are drawn, where none are named.")
    seed: int = Field(12, ge=0, description="Seed of the choice of `count` antennas.")

    def refusal(self, size: Size) -> str | None:
        """Refuse antennas that do not exist, and to leave fewer than three."""
        return self._refusal(size.antennas)

    def _refusal(self, count: int) -> str | None:
        """Return why the effect cannot be applied to `count` antennas, or None."""
        if self.antennas and max(self.antennas) >= count:
            return f"antennas: names antenna {max(self.antennas)}, but there are {count} antennas, counted from 0"
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
