"""Gains from a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.gains import gains_for, read_gains
from calstudy.base.visibilities import antenna_rows
from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class FileGains(GainEffect):
    """Gains read from a CalH5 or calfits file with the same antennas and channels; flagged ones count as unity."""

    path: Path = Field(strict=False)

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, Ntimes of the file, Npols).

        Raises
        ------
        InputError
            If the file cannot be read, or lacks antennas, channels or polarizations of the observation.
        """
        del random
        template = observation.uvd
        values = gains_for(read_gains(self.path, "corruption.effects: path"), template)[antenna_rows(template)]
        return np.where(np.isfinite(values), values, 1)
