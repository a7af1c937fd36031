"""Antennas at the marks of a Golomb ruler."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from calstudy.base.units import Length
from calstudy.instrument.layouts import ArrayLayout, Layout

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

    count: int = Field(8, ge=2, le=16, description="Number of antennas (marks of the ruler).")
    spacing: Length = Field(4.0, ge=0.01, description="Length of one unit of the ruler.")

    def make(self) -> Layout:
        """Return the antennas."""
        marks = np.array(GOLOMB_MARKS[self.count])
        return self.flat(np.column_stack([self.spacing * marks, np.zeros(self.count)]))
