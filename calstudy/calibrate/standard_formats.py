"""Convert gains, models and residuals to standard formats: UVCal and UVData."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.visibilities import from_cube

# The AIPS convention, which UVCal's Jones numbers share.
PARALLEL_HANDS = {-5: "xx", -6: "yy", -1: "rr", -2: "ll"}


def require_parallel_hands(data: UVData) -> None:
    """Raise InputError unless all polarizations are xx, yy, rr or ll."""
    if not np.isin(data.polarization_array, list(PARALLEL_HANDS)).all():
        raise InputError(
            f"polarizations: {', '.join(data.get_pols())}; calibration takes {', '.join(PARALLEL_HANDS.values())} only"
        )


def make_gains(data: UVData, numbers: np.ndarray, gains: np.ndarray, flags: np.ndarray) -> UVCal:
    """Return gains as a UVCal object for the whole telescope; antennas without data are flagged, with unit gains.

    `numbers` are the antenna numbers of the rows, (Nants,). Gains and flags are (Nants, Nfreqs, Ntimes, Npols).
    """
    known = data.telescope.antenna_numbers
    rows = {int(number): row for row, number in enumerate(known)}
    places = [rows[int(number)] for number in numbers]
    everywhere = np.ones((len(known), *gains.shape[1:]), complex)
    nowhere = np.ones(everywhere.shape, bool)
    everywhere[places], nowhere[places] = gains, flags
    return make_uvcal(data, everywhere, nowhere)


def make_visibilities(data: UVData, cube: np.ndarray, flags: np.ndarray) -> UVData:
    """Return a copy of `data` with other visibilities and flags, (Ntimes, Nbls, Nfreqs, Npols)."""
    result = from_cube(data, cube)
    result.flag_array = flags.reshape(result.data_array.shape)
    return result
