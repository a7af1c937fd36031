"""Where a solve starts: unity, or gains from a file."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.gains import gains_for


def starting_gains(data: UVData, numbers: np.ndarray, gains: UVCal | None) -> np.ndarray:
    """Return the gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols).

    Parameters
    ----------
    data
        The visibilities.
    numbers
        Antenna numbers of the rows.
    gains
        Unity if None. Of several integrations the closest in time is taken; flagged, zero and infinite gains count as
        unity.

    Raises
    ------
    InputError
        If an antenna, channel or polarization of the data has no gain, or the gains are delays.
    """
    times = np.unique(data.time_array)
    if gains is None:
        return np.ones((len(numbers), data.Nfreqs, times.size, data.Npols), complex)
    values = gains_for(gains, data)
    rows = {int(number): row for row, number in enumerate(data.telescope.antenna_numbers)}
    values = values[[rows[int(number)] for number in numbers]]
    centres = gains.time_array if gains.time_array is not None else np.mean(gains.time_range, axis=1)
    closest = np.abs(centres[None] - times[:, None]).argmin(axis=1)
    values = values[:, :, closest]
    return np.where(np.isfinite(values) & (values != 0), values, 1)
