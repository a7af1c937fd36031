"""Gains from a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.gains import gains_for, read_gains
from calstudy.base.visibilities import antenna_rows
from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class FileGains(GainEffect):
    """Gains read from a CalH5 or calfits file with the same antennas and channels; flagged ones count as unity.

    The file holds gains for one time, which are constant, or for as many as there are integrations, in their order.
    """

    path: Path = Field(strict=False, description="CalH5 or calfits file, relative to the experiment file or absolute.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1 or Ntimes, Npols).

        Raise InputError if the file cannot be read, lacks antennas, channels or polarizations of the observation, or
        has another number of times.
        """
        del random
        template = observation.uvd
        values = gains_for(read_gains(self.path, "corruption.effects: path"), template)[antenna_rows(template)]
        if values.shape[2] not in (1, observation.n_times):
            raise InputError(
                f"corruption.effects: path = {str(self.path)!r}: holds gains for {values.shape[2]} times; it must hold "
                f"them for one, or for each of the {observation.n_times} integrations"
            )
        return np.where(np.isfinite(values), values, 1)
