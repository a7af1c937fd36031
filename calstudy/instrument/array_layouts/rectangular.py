"""Antennas in rows."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.schema import fault
from calstudy.base.units import Length
from calstudy.instrument.layouts import ArrayLayout, Layout

ROW_LENGTH = 8


class RectangularLayout(ArrayLayout):
    """Rows of eight antennas, spread so that the longest baseline is `max_baseline` (paper Fig. ANTPOS_RUNTIME)."""

    regular: ClassVar[bool] = True

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
