"""Antenna gains as UVCal: conversion between standard files and arrays.

The convention everywhere is that of the paper, V_ab = g_a g_b* m_ab, which pyuvdata calls "divide": calibrating divides
by g_a g_b*.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, polarization_names, positions

SAME_CHANNEL = 0.1
"""Channels of two files are the same if they differ by less than this, in units of their width."""

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData


def at_common_channels(first: UVCal, second: UVCal) -> tuple[UVCal, UVCal]:
    """Return two sets of gains at the channels that both have, within a tenth of a channel, without changing them.

    Raises InputError if there is no such channel, or one of them has no gains by channel.
    """
    for name, cal in (("first", first), ("second", second)):
        _require_channels(cal, f"the {name} file")
    width = min(np.min(cal.channel_width) for cal in (first, second))
    same = np.abs(first.freq_array[:, None] - second.freq_array) <= SAME_CHANNEL * width
    if not same.any():
        bands = [f"{cal.freq_array.min() / 1e6:.3f} to {cal.freq_array.max() / 1e6:.3f} MHz" for cal in (first, second)]
        raise InputError(f"the two files have no channel in common: {bands[0]}, and {bands[1]}")
    one, other = (
        cal if chosen.all() else cal.select(freq_chans=np.flatnonzero(chosen), inplace=False)
        for cal, chosen in ((first, same.any(axis=1)), (second, same.any(axis=0)))
    )
    return one, other


def _require_channels(cal: UVCal, what: str) -> None:
    if cal.cal_type != "gain" or cal.wide_band:
        kind = f"{cal.cal_type} solutions" if cal.cal_type != "gain" else "gains of whole bands"
        raise InputError(f"{what} holds {kind}; gains by channel are needed")


def make_uvcal(template: UVData, gains: np.ndarray, flags: np.ndarray | None = None) -> UVCal:
    """Return gains as UVCal, for all antennas of the template's telescope and the feeds of its polarizations.

    `gains` are complex, (Nants_telescope, Nfreqs, Ntimes, Npols) in the order of `telescope.antenna_numbers`. Ntimes is
    the template's, or 1 for gains that are constant during the run. `flags` have the same shape; none by default.
    """
    from pyuvdata import UVCal

    times, integration = np.unique(template.time_array), float(template.integration_time[0])
    time: dict[str, Any] = {"time_array": times, "integration_time": integration}
    if gains.shape[2] == 1 and template.Ntimes > 1:
        whole = float(np.ptp(times) * SECONDS_PER_DAY + integration)
        time = {"time_range": times[None, [0, -1]], "integration_time": whole}
    cal = UVCal.new(
        telescope=template.telescope,
        freq_array=template.freq_array,
        channel_width=template.channel_width,
        flex_spw_id_array=template.flex_spw_id_array,
        spw_array=template.spw_array,
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


ERRORS_GROUP = "GainErrors"
"""Group of a CalH5 file, beside those of the format, with the standard deviations `amplitude` and `phase` (rad)."""


class ErrorsOfFile(NamedTuple):
    """Standard deviations of the gains of a file, with their axes; NaN is none.

    Those of |g| and of the phase of g, rad, are (Nants, Nfreqs, Ntimes, Npols). Sequences in frequency up to the
    `smooth_delay`, s, are no part of them; it is zero if there are none, NaN if the file does not say it. They are from
    a number of realizations of the noise, or zero if they are of the fit's own matrix.
    """

    amplitude: np.ndarray
    phase: np.ndarray
    smooth_delay: float
    realizations: int = 0


def write_gain_errors(path: Path, errors: ErrorsOfFile) -> None:
    """Add errors to a CalH5 file of gains."""
    import h5py

    with h5py.File(path, "a") as file:
        group = file.create_group(ERRORS_GROUP)
        group.attrs.update(smooth_delay=errors.smooth_delay, realizations=errors.realizations)
        for name, values in (("amplitude", errors.amplitude), ("phase", errors.phase)):
            group.create_dataset(name, data=values.astype(np.float32), compression="gzip")


def find_gain_errors(path: Path) -> ErrorsOfFile | None:
    """Read what `write_gain_errors` added, or return None if there is none, as in files that are not HDF5."""
    import h5py

    if not h5py.is_hdf5(path):
        return None
    with h5py.File(path) as file:
        if ERRORS_GROUP not in file:
            return None
        group = file[ERRORS_GROUP]
        delay, count = float(group.attrs.get("smooth_delay", np.nan)), int(group.attrs.get("realizations", 0))
        return ErrorsOfFile(group["amplitude"][()], group["phase"][()], delay, count)


def read_gain_errors(path: Path) -> ErrorsOfFile:
    """Read what `write_gain_errors` added; raises InputError if there is none."""
    found = find_gain_errors(path)
    if found is None:
        raise InputError(
            f"{path}: has no errors of gains, because none are known for its calibration, or it is of a version that "
            "wrote none"
        )
    return found


def draw_gains(cal: UVCal, errors: ErrorsOfFile, solves: Sequence[slice], seed: int) -> UVCal:
    """Return gains that deviate by a draw of their errors, if any, independent by antenna and channel.

    Integrations that were solved together, `solves`, have one deviation.
    """
    deviation = np.random.default_rng(seed).standard_normal((2, *cal.gain_array.shape))
    for times in solves:
        deviation[..., times, :] = deviation[..., times.start : times.start + 1, :]
    amplitude, phase = deviation * np.nan_to_num([errors.amplitude / np.abs(cal.gain_array), errors.phase])
    drawn = cal.copy()
    drawn.gain_array = cal.gain_array * np.exp(amplitude + 1j * phase)
    return drawn


def gain_products(cal: UVCal, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return g_a g_b* of baselines (a, b), and where it is flagged, both (Ntimes, len(pairs), Nfreqs, Npols).

    `pairs` are numbers of antennas that are in `cal`, whose convention is "divide".
    """
    first, second = positions(cal.ant_array, pairs).T
    products = cal.gain_array[first] * cal.gain_array[second].conj()
    return np.moveaxis(products, 2, 0), np.moveaxis(cal.flag_array[first] | cal.flag_array[second], 2, 0)


def gains_for(cal: UVCal, template: UVData) -> np.ndarray:
    """Return the gains of the antennas of the template's baselines, by ascending number; NaN where they are flagged.

    As `solutions`, at the channels and polarizations of the template. Raises InputError as `require_solutions` too.
    """
    numbers = np.unique(antenna_pairs(template))
    require_solutions(cal, numbers, template.freq_array, np.min(template.channel_width))
    gains, flags = solutions(cal, numbers, template.freq_array, template.polarization_array)
    return np.where(flags, np.nan, gains)


def known_gains(cal: UVCal) -> tuple[np.ndarray, np.ndarray]:
    """Return gains in the convention "divide", one where there is no solution, and the mask of the solutions."""
    known = ~cal.flag_array & np.isfinite(cal.gain_array) & (cal.gain_array != 0)
    gains = np.where(known, cal.gain_array, 1)
    return 1 / gains if cal.gain_convention == "multiply" else gains, known


def solution_times(cal: UVCal) -> np.ndarray:
    """Return the centres of the solutions in time, Julian dates, (Ntimes,)."""
    return cal.time_array if cal.time_array is not None else cal.time_range.mean(axis=1)


def closest_solutions(cal: UVCal, times: np.ndarray) -> np.ndarray:
    """Return the index of the integration of gains that is closest to each time, Julian dates, (Ntimes,)."""
    return np.abs(solution_times(cal)[None] - times[:, None]).argmin(axis=1)


def require_solutions(cal: UVCal, numbers: np.ndarray, frequencies: np.ndarray, width: float) -> None:
    """Raise InputError if gains are delays, or lack antennas (numbers) or channels (Hz, to a tenth of `width`)."""
    _require_channels(cal, "gains:")
    missing = np.setdiff1d(numbers, cal.ant_array)
    if missing.size:
        raise InputError(f"gains: no solution for antenna(s) {', '.join(map(str, missing))} of the data")
    offset = np.abs(cal.freq_array[None] - frequencies[:, None]).min(axis=1)
    if offset.max() > SAME_CHANNEL * width:
        worst = frequencies[offset.argmax()]
        raise InputError(f"gains: no channel at {worst / 1e6:.4f} MHz, where the data have one")


def solutions(
    cal: UVCal, numbers: np.ndarray, frequencies: np.ndarray, polarizations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return gains of antennas that are in `cal`, at the channels nearest to frequencies (Hz), and their flags.

    The gains should satisfy `require_solutions`. They are complex and in the convention "divide"; both arrays are
    (len(numbers), len(frequencies), Ntimes of `cal`, len(polarizations)). `polarizations` are AIPS numbers; raises
    InputError if `cal` lacks one, or if all gains are zero or not finite.
    """
    if missing := [pol for pol in polarizations if pol not in cal.jones_array]:
        raise InputError(f"gains: no solution for polarization {polarization_names(missing[:1])} of the data")
    rows, feeds = positions(cal.ant_array, numbers), positions(cal.jones_array, polarizations)
    channels = np.abs(cal.freq_array[None] - frequencies[:, None]).argmin(axis=1)
    gains, flags = (array[rows][:, channels][..., feeds] for array in (cal.gain_array, cal.flag_array))
    if not (np.isfinite(gains) & (gains != 0)).any():
        raise InputError("gains: all are zero or not finite")
    if cal.gain_convention == "multiply":
        with np.errstate(divide="ignore", invalid="ignore"):
            gains = 1 / gains
    return gains.astype(complex), flags
