"""Visibilities as one rectangular cube: conversion between UVData and arrays, and metadata without data.

Every data set of a study has all its baselines at all its times, ordered time-major (all baselines of the first
integration, then of the second, and so on). The functions here check that and reshape, without unnecessary copies.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from pyuvdata import Telescope, UVData
    from pyuvdata.uvbase import UVBase

Item = TypeVar("Item", bound="UVBase")


@cache
def keep_compiled_pyuvdata() -> None:
    """Cache pyuvdata's compiled conversions of baseline numbers on disk: each process would compile them again."""
    from pyuvdata.utils import antnums_to_baseline, baseline_to_antnums, bls

    names = ("_max_ant", "_min_ant", "_antnums_to_baseline", "_baseline_to_antnums")
    for name in names:
        enable = getattr(getattr(bls, name, None), "enable_caching", None)
        if enable is not None:
            # If no folder can be written, it is compiled in every process.
            with suppress(RuntimeError):
                enable()
    # On a full disk numba fails once for each function, which can then be used in this process.
    for _ in names:
        with suppress(OSError):
            numbers = antnums_to_baseline(np.zeros(1, int), np.ones(1, int), Nants_telescope=2)
            baseline_to_antnums(numbers, Nants_telescope=2)
            return


def taken(item: Item, axis: str, chosen: np.ndarray) -> Item:
    """Return a copy of an object of pyuvdata or pyradiosky with entries along an axis, such as "Nblts", in this order.

    Their `select` leaves the order as it is.
    """
    found = item.copy()
    for name in found:
        parameter = getattr(found, name)
        if isinstance(parameter.form, tuple) and axis in parameter.form and parameter.value is not None:
            values = np.asarray(parameter.value) if isinstance(parameter.value, list) else parameter.value
            # It is the first axis or the last; coordinates of sources have no other.
            setattr(found, parameter.name, values[chosen] if parameter.form[0] == axis else values[..., chosen])
    setattr(found, axis, len(chosen))
    return found


def require_rectangular(uvd: UVData) -> None:
    """Raise InputError unless all baselines are present at all times in time-major order."""
    n_bls, n_times = uvd.Nbls, uvd.Ntimes
    baselines = uvd.baseline_array.reshape(n_times, n_bls) if uvd.Nblts == n_bls * n_times else None
    if baselines is None or (baselines != baselines[0]).any():
        raise InputError(
            f"the visibilities are not rectangular: {uvd.Nblts} samples of {n_bls} baselines at {n_times} times, "
            "expected every baseline once at every time, ordered by time"
        )


def to_cube(uvd: UVData) -> np.ndarray:
    """Return the visibilities as a view of shape (Ntimes, Nbls, Nfreqs, Npols), complex, in the data's own unit."""
    require_rectangular(uvd)
    return uvd.data_array.reshape(uvd.Ntimes, uvd.Nbls, uvd.Nfreqs, uvd.Npols)


def flag_cube(uvd: UVData) -> np.ndarray:
    """Return the flags as a view of shape (Ntimes, Nbls, Nfreqs, Npols), bool, in the order of `to_cube`."""
    require_rectangular(uvd)
    return uvd.flag_array.reshape(uvd.Ntimes, uvd.Nbls, uvd.Nfreqs, uvd.Npols)


def from_cube(template: UVData, cube: np.ndarray) -> UVData:
    """Return a copy of `template` with the visibilities `cube`, of shape (Ntimes, Nbls, Nfreqs, Npols).

    Flags and nsamples are the template's; if it has none, nothing is flagged and nsamples are one.
    """
    require_rectangular(template)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    if cube.shape != shape:
        raise ValueError(f"visibilities have shape {cube.shape}, the template needs {shape}")
    uvd = template.copy(metadata_only=True)
    uvd.data_array = np.ascontiguousarray(cube).reshape(template.Nblts, template.Nfreqs, template.Npols)
    empty = template.flag_array is None
    uvd.flag_array = np.zeros(uvd.data_array.shape, bool) if empty else template.flag_array.copy()
    uvd.nsample_array = np.ones(uvd.data_array.shape, np.float32) if empty else template.nsample_array.copy()
    return uvd


def antenna_pairs(uvd: UVData) -> np.ndarray:
    """Return the antenna numbers (a, b) of each baseline, (Nbls, 2), in the order of `to_cube`."""
    return np.column_stack([uvd.ant_1_array[: uvd.Nbls], uvd.ant_2_array[: uvd.Nbls]])


def positions(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the index in `values`, unique and in any order, (N,), of each of `wanted`, in the shape of `wanted`."""
    order = np.argsort(values)
    return order[np.searchsorted(values, wanted, sorter=order)]


def polarization_names(numbers: Iterable[int]) -> str:
    """Return polarizations for a message, such as "xx, yy"."""
    from pyuvdata.utils import polnum2str

    return ", ".join(polnum2str(int(number)).lower() for number in numbers)


def rows_of(uvd: UVData, pairs: np.ndarray) -> list[int]:
    """Return the places of baselines (a, b), (n, 2), among `antenna_pairs`; raise KeyError if one is missing."""
    places = {tuple(pair): row for row, pair in enumerate(antenna_pairs(uvd).tolist())}
    return [places[tuple(pair)] for pair in pairs.tolist()]


def antenna_indices(uvd: UVData) -> np.ndarray:
    """Return `antenna_pairs` as indices into `uvd.telescope.antenna_numbers`, (Nbls, 2)."""
    return positions(uvd.telescope.antenna_numbers, antenna_pairs(uvd))


def antenna_rows(uvd: UVData) -> np.ndarray:
    """Return the indices in `uvd.telescope.antenna_numbers` of the antennas of the baselines, by ascending number."""
    return positions(uvd.telescope.antenna_numbers, np.unique(antenna_pairs(uvd)))


def baseline_vectors(uvd: UVData) -> np.ndarray:
    """Return x_b - x_a in east, north, up metres for each baseline (a, b), (Nbls, 3)."""
    return np.diff(uvd.telescope.get_enu_antpos()[antenna_indices(uvd)], axis=1)[:, 0]


def use_bundled_earth_orientation() -> None:
    """Let astropy use the installed tables of the Earth's orientation in this process, without downloads."""
    from astropy.utils import iers

    iers.conf.auto_download = False
    # Predictions of a year ahead err by less than a second, and there is no newer table to ask for.
    iers.conf.auto_max_age = None


def require_earth_orientation(times: np.ndarray, field: str) -> None:
    """Raise InputError if the installed Earth orientation tables end before the last of the times, Julian dates."""
    from astropy.time import Time
    from astropy.utils import iers

    use_bundled_earth_orientation()
    last, known = Time(times.max(), format="jd"), Time(iers.earth_orientation_table.get()["MJD"][-1], format="mjd")
    if last > known:
        raise InputError(
            f"{field}: is of {last.iso[:10]}, and the rotation of the Earth is known up to {known.iso[:10]}: update "
            "the package astropy-iers-data"
        )


def new_observation(
    telescope: Telescope,
    antenna_pairs: np.ndarray,
    times: np.ndarray,
    frequencies: np.ndarray,
    resolution: tuple[float, float],
    polarizations: np.ndarray,
) -> UVData:
    """Return the metadata of an observation; `resolution` is the integration time in s and the channel width in Hz."""
    from pyuvdata import UVData

    use_bundled_earth_orientation()
    integration, width = resolution
    uvd = UVData.new(
        telescope=telescope,
        antpairs=antenna_pairs,
        times=times,
        freq_array=frequencies,
        polarization_array=polarizations,
        integration_time=float(integration),
        channel_width=float(width),
        do_blt_outer=True,
        time_axis_faster_than_bls=False,
        update_telescope_from_known=False,
        vis_units="Jy",
        pol_convention="sum",
    )
    # pyuvdata's own history contains the time of day. Equal settings must give equal templates.
    uvd.history = "calstudy instrument template"
    return uvd


def subset_template(template: UVData, times_jd: np.ndarray, frequencies: np.ndarray) -> UVData:
    """Return the observation of the template at other times (Julian dates) and frequencies (Hz)."""
    return new_observation(
        template.telescope.copy(),
        antenna_pairs(template),
        times=np.asarray(times_jd, dtype=float),
        frequencies=np.asarray(frequencies, dtype=float),
        resolution=(template.integration_time[0], template.channel_width[0]),
        polarizations=template.polarization_array.copy(),
    )


def channels_per_block(frequencies: np.ndarray, width: float) -> int:
    """Return how many channels, at least one, a block has that is `width` Hz wide; frequencies are in Hz."""
    return max(1, round(width / np.abs(np.diff(frequencies)).min(initial=np.inf)))


def crosses_of(data: UVData) -> UVData:
    """Return the cross-correlations of rectangular, time-major data."""
    crosses = np.flatnonzero(data.ant_1_array != data.ant_2_array)
    return data.select(blt_inds=crosses, inplace=False, run_check=False)
