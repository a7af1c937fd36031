"""Antennas in a hexagon."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.units import Length
from calstudy.instrument.layouts import ArrayLayout, Layout


class HexLayout(ArrayLayout):
    """A filled regular hexagon, flat."""

    regular: ClassVar[bool] = True

    side: int = Field(4, ge=2, le=26, description="Antennas along one side; 4 gives 37 antennas.")
    spacing: Length = Field(14.0, ge=0.01, description="Distance between neighbours.")

    def make(self) -> Layout:
        """Return the antennas, row by row from the south."""
        return self.flat(self.spacing * hexagon(self.side))


def hexagon(side: int) -> np.ndarray:
    """Return east and north of a filled hexagon in units of the spacing, row by row from the south, (Nants, 2)."""
    rows = []
    for row in range(1 - side, side):
        count = 2 * side - 1 - abs(row)
        east = np.arange(count) - (count - 1) / 2
        rows.append(np.column_stack([east, np.full(count, row * math.sqrt(3) / 2)]))
    return np.concatenate(rows)
