"""Antennas on a line."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from calstudy.base.units import Length
from calstudy.instrument.layouts import ArrayLayout, Layout


class LinearLayout(ArrayLayout):
    """An east-west line of equally spaced antennas (paper Fig. MAXBL_RUNTIME)."""

    count: int = Field(10, ge=2, le=2000)
    spacing: Length = Field(14.0, ge=0.01)

    def make(self) -> Layout:
        """Return the antennas."""
        return self.flat(np.column_stack([self.spacing * np.arange(self.count), np.zeros(self.count)]))
