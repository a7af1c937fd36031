"""Antenna gains as UVCal: the bridge between the standard files and arrays.

The convention everywhere is that of the paper, V_ab = g_a g_b* m_ab, which pyuvdata calls "divide": calibrating divides
by g_a g_b*.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs

if TYPE_CHECKING:
    from pathlib import Path

    from pyuvdata import UVCal, UVData


def read_gains(path: Path, where: str) -> UVCal:
    """Read a CalH5 or calfits file.

    Raises
    ------
    InputError
        If it is neither; `where` says who asked for it.
    """
    from pyuvdata import UVCal

    try:
        return UVCal.from_file(path)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise InputError(f"{where} = {str(path)!r}: not a readable CalH5 or calfits file ({error})") from None


def make_uvcal(template: UVData, gains: np.ndarray, flags: np.ndarray | None = None) -> UVCal:
    """Return gains as UVCal, for all antennas of the template's telescope and the feeds of its polarizations.

    Parameters
    ----------
    template
        Gives telescope, channels, polarizations (xx, yy) and times.
    gains
        Complex, shape (Nants_telescope, Nfreqs, Ntimes, Npols) in the order of `telescope.antenna_numbers`. Ntimes is
        the template's, or 1 for gains that hold for the whole run.
    flags
        Boolean of the same shape; none flagged by default.
    """
    from pyuvdata import UVCal

    constant = gains.shape[2] == 1 and template.Ntimes > 1
    times = np.unique(template.time_array)
    time = {"time_range": np.array([[times[0], times[-1]]])} if constant else {"time_array": times}
    cal = UVCal.new(
        telescope=template.telescope,
        freq_array=template.freq_array,
        channel_width=template.channel_width,
        flex_spw_id_array=template.flex_spw_id_array,
        spw_array=template.spw_array,
        integration_time=float(np.ptp(times) * 86400 + template.integration_time[0])
        if constant
        else float(template.integration_time[0]),
        # pyuvdata numbers the Jones element Jxx of a feed like the polarization xx, and Jyy like yy.
        jones_array=template.polarization_array,
        ant_array=template.telescope.antenna_numbers,
        gain_convention="divide",
        cal_style="redundant",
        cal_type="gain",
        gain_scale=template.vis_units,
        pol_convention=template.pol_convention,
        data={
            "gain_array": np.array(gains, dtype=np.complex128),
            "flag_array": np.zeros(gains.shape, dtype=bool) if flags is None else flags.copy(),
        },
        history="calstudy",
        **time,
    )
    cal.check()
    return cal


def gains_for(cal: UVCal, template: UVData) -> np.ndarray:
    """Return the gains of the template's antennas, channels and polarizations.

    Returns
    -------
    ndarray, complex128, shape (Nants_telescope, Nfreqs, Ntimes of `cal`, Npols)
        In the order of `template.telescope.antenna_numbers` and in the convention "divide"; NaN where they are flagged,
        and for antennas that are in no baseline of the template and not in `cal`.

    Raises
    ------
    InputError
        If `cal` holds delays, or lacks an antenna, a channel or a polarization of the template.
    """
    if cal.cal_type != "gain":
        raise InputError(f"gains: holds {cal.cal_type} solutions; gains by channel are needed")
    used = np.unique(antenna_pairs(template))
    missing = np.setdiff1d(used, cal.ant_array)
    if missing.size:
        raise InputError(f"gains: no solution for antenna(s) {', '.join(map(str, missing))} of the data")
    tolerance = 0.1 * np.min(template.channel_width)
    channels = np.abs(cal.freq_array[None] - template.freq_array[:, None]).argmin(axis=1)
    offset = np.abs(cal.freq_array[channels] - template.freq_array)
    if offset.max() > tolerance:
        worst = template.freq_array[offset.argmax()]
        raise InputError(f"gains: no channel at {worst / 1e6:.4f} MHz, where the data have one")
    feeds = []
    for pol in template.polarization_array:
        if pol not in cal.jones_array:
            raise InputError(f"gains: no solution for polarization {int(pol)} (AIPS number) of the data")
        feeds.append(int(np.flatnonzero(cal.jones_array == pol)[0]))
    gains = np.full((template.Nants_telescope, template.Nfreqs, cal.Ntimes, template.Npols), np.nan, dtype=complex)
    for row, number in enumerate(template.telescope.antenna_numbers):
        if number in cal.ant_array:
            antenna = int(np.flatnonzero(cal.ant_array == number)[0])
            flagged = cal.flag_array[antenna][channels][:, :, feeds]
            gains[row] = np.where(flagged, np.nan, cal.gain_array[antenna][channels][:, :, feeds])
    return 1 / gains if cal.gain_convention == "multiply" else gains
