"""Calibration products in standard formats: gains as UVCal, models and residuals as UVData."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.visibilities import from_cube

# XX, YY and RR, LL in the AIPS convention, which UVCal's Jones numbers share.
PARALLEL_HANDS = {-5: "xx", -6: "yy", -1: "rr", -2: "ll"}


def parallel_hands(data: UVData) -> np.ndarray:
    """Return the polarization numbers of the data; ValueError unless all are xx, yy, rr or ll."""
    numbers = np.asarray(data.polarization_array)
    if not np.isin(numbers, list(PARALLEL_HANDS)).all():
        raise ValueError(
            f"polarizations: {', '.join(data.get_pols())}; calibration takes {', '.join(PARALLEL_HANDS.values())} only"
        )
    return numbers


def make_uvcal(data: UVData, numbers: np.ndarray, gains: np.ndarray, flags: np.ndarray) -> UVCal:
    """Return gains as a UVCal object with gain convention ``divide``.

    Parameters
    ----------
    data
        The visibilities that the gains belong to.
    numbers
        Antenna number of each row of the gains, ascending, shape (Nants,).
    gains, flags
        Shape (Nants, Nfreqs, Ntimes, Npols), dimensionless complex and bool.
    """
    uvcal = UVCal.initialize_from_uvdata(
        data,
        gain_convention="divide",
        cal_style="redundant",
        cal_type="gain",
        jones_array=parallel_hands(data),
        metadata_only=False,
    )
    # UVCal lists the antennas in its own order.
    row = np.searchsorted(numbers, uvcal.ant_array)
    uvcal.gain_array = gains[row]
    uvcal.flag_array = flags[row]
    uvcal.gain_scale, uvcal.pol_convention = data.vis_units, data.pol_convention
    return uvcal


def make_visibilities(data: UVData, cube: np.ndarray, flags: np.ndarray) -> UVData:
    """Return a copy of `data` that holds other visibilities and flags, both (Ntimes, Nbls, Nfreqs, Npols)."""
    result = from_cube(data, cube)
    result.flag_array = flags.reshape(result.data_array.shape)
    return result
