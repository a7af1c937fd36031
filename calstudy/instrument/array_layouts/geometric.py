"""Layouts of regular shapes: lines, rows, hexagons, and the marks of a Golomb ruler."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.schema import fault
from calstudy.base.units import Length
from calstudy.instrument.layouts import ArrayLayout, Layout


class LinearLayout(ArrayLayout):
    """An east-west line of equally spaced antennas (paper Fig. MAXBL_RUNTIME)."""

    kind: str = "linear"
    count: int = Field(10, ge=2, le=2000)
    spacing: Length = Field(14.0, ge=0.01)

    def make(self) -> Layout:
        """Return the antennas."""
        return self.flat(np.column_stack([self.spacing * np.arange(self.count), np.zeros(self.count)]))


ROW_LENGTH = 8


class RectangularLayout(ArrayLayout):
    """Rows of eight antennas, spread so that the longest baseline is `max_baseline` (paper Fig. ANTPOS_RUNTIME)."""

    regular: ClassVar[bool] = True

    kind: str = "rectangular"
    count: int = Field(16, ge=9, le=2000, description="Number of antennas; at least nine, so that there are two rows.")
    spacing: Length = Field(2.0, ge=0.01, description="Distance between neighbours in a row.")
    max_baseline: Length = Field(100.0, gt=0)

    @model_validator(mode="after")
    def _rows_fit(self) -> RectangularLayout:
        if self.max_baseline <= 7 * self.spacing:
            raise fault(
                "max_baseline",
                f"{self.max_baseline:g} m must exceed the length of a row, 7 x spacing = {7 * self.spacing:g} m",
            )
        return self

    def make(self) -> Layout:
        """Return the antennas, row by row."""
        row, column = np.divmod(np.arange(self.count), ROW_LENGTH)
        east = self.spacing * column
        first, second = np.triu_indices(self.count, 1)
        rows_apart = np.abs(row[first] - row[second])
        across = np.abs(east[first] - east[second])[rows_apart > 0]
        # The widest row distance at which no pair of antennas in different rows is farther apart than the limit.
        distance = np.min(np.sqrt(self.max_baseline**2 - across**2) / rows_apart[rows_apart > 0])
        return self.flat(np.column_stack([east, distance * row]))


class HexLayout(ArrayLayout):
    """A filled regular hexagon, flat."""

    regular: ClassVar[bool] = True

    kind: str = "hex"
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


# Optimal Golomb rulers by order (all their differences are distinct; length proved shortest).
GOLOMB_MARKS = {
    2: (0, 1),
    3: (0, 1, 3),
    4: (0, 1, 4, 6),
    5: (0, 1, 4, 9, 11),
    6: (0, 1, 4, 10, 12, 17),
    7: (0, 1, 4, 10, 18, 23, 25),
    8: (0, 1, 4, 9, 15, 22, 32, 34),
    9: (0, 1, 5, 12, 25, 27, 35, 41, 44),
    10: (0, 1, 6, 10, 23, 26, 34, 41, 53, 55),
    11: (0, 1, 4, 13, 28, 33, 47, 54, 64, 70, 72),
    12: (0, 2, 6, 24, 29, 40, 43, 55, 68, 75, 76, 85),
    13: (0, 2, 5, 25, 37, 43, 59, 70, 85, 89, 98, 99, 106),
    14: (0, 4, 6, 20, 35, 52, 59, 77, 78, 86, 89, 99, 122, 127),
    15: (0, 4, 20, 30, 57, 59, 62, 76, 100, 111, 123, 136, 144, 145, 151),
    16: (0, 1, 4, 11, 26, 32, 56, 68, 76, 115, 117, 134, 150, 163, 168, 177),
}


class GolombLayout(ArrayLayout):
    """An east-west line at the marks of an optimal Golomb ruler: every baseline is unique."""

    kind: str = "golomb"
    count: int = Field(8, ge=2, le=16, description="Number of antennas (marks of the ruler).")
    spacing: Length = Field(4.0, ge=0.01, description="Length of one unit of the ruler.")

    def make(self) -> Layout:
        """Return the antennas."""
        marks = np.array(GOLOMB_MARKS[self.count])
        return self.flat(np.column_stack([self.spacing * marks, np.zeros(self.count)]))
