"""Read visibilities of any format and bring them into the shape that calibration needs.

Samples that the shape needs and the data lack are flagged, and each change is reported in a note.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from importlib.util import find_spec
from io import StringIO
from pathlib import Path

import numpy as np
from astropy import units
from pyuvdata import UVData, utils

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.foreign_files import reason_of, require_self_contained
from calstudy.base.gain_files import CASACORE
from calstudy.base.visibilities import keep_compiled_pyuvdata, polarization_names, positions, taken
from calstudy.calibrate.records import PARALLEL_HANDS
from calstudy.instrument.array_layouts.csv import read_positions
from calstudy.instrument.layouts import require_valid
from calstudy.realdata.selection import Selection, select

logger = logging.getLogger(__name__)

# With a smaller fraction of its samples present, a data set has too few baselines at common times.
MIN_PRESENT = 0.5
# Baselines whose samples last so many times as long as those of others are apart have been averaged more than these.
COPIED = 1.5
# Part of the shortest duration by which times may differ that are one.
SAME_TIME = 0.4
# Range of radio telescopes, Hz; other values have another unit, or the file is damaged.
LOWEST_FREQUENCY, HIGHEST_FREQUENCY = 1e6, 1e12
EVERYTHING = Selection()


# Readers of eight formats raise any error of their libraries; the user must repair a file that cannot be read.
UNREADABLE = (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, ImportError)


def read_visibilities(paths: Sequence[Path], read_data: bool = True) -> UVData:
    """Read one data set from a file or folder, or from several that belong together; or its metadata alone.

    Raises InputError if a path does not exist, pyuvdata cannot read it, or its antennas have no positions.
    """
    _require_readable(paths)
    names = ", ".join(map(str, paths))
    keep_compiled_pyuvdata()
    data = UVData()
    try:
        data.read(str(paths[0]) if len(paths) == 1 else [str(path) for path in paths], read_data=read_data)
    except UNREADABLE as error:
        raise InputError(f"{names}: cannot be read as visibilities ({reason_of(error)})") from None
    if read_data and data.data_array is None:
        raise InputError(f"{names}: holds no visibilities")
    # The times of Miriad folders come with the visibilities.
    if not read_data and data.time_array is None:
        return read_visibilities(paths)
    if not np.isfinite(data.telescope.antenna_positions).all():
        raise InputError(f"{names}: antenna positions are not finite")
    try:
        data.telescope.get_enu_antpos()
    except ValueError as error:
        raise InputError(
            f"{names}: cannot be read as visibilities (antenna positions: {reason_of(error)}); write them in m, from "
            "the location of the telescope"
        ) from None
    _require_plausible(data, names)
    return data


def read_metadata(paths: Sequence[Path]) -> UVData:
    """Read a data set as `read_visibilities` does, but without visibilities where the format allows it."""
    try:
        return read_visibilities(paths, read_data=False)
    except InputError:
        # A file that cannot be read in parts may be readable as a whole.
        return read_visibilities(paths)


def _require_readable(paths: Sequence[Path]) -> None:
    """Raise InputError unless all paths exist, can be read with what is installed, and hold their own data."""
    for path in paths:
        with errors_of_files(f"{path}: cannot be read"):
            found = path.exists()
        if not found:
            raise InputError(f"{path}: no such file or folder")
        # All CASA tables have this file.
        if (path / "table.dat").is_file() and find_spec("casacore") is None:
            raise InputError(f"{path}: reading a measurement set takes {CASACORE}")
        require_self_contained(path)


def _require_plausible(data: UVData, names: str) -> None:
    """Raise InputError unless frequencies, channel widths, times and durations are plausible."""
    frequencies, widths = np.ravel(data.freq_array), np.ravel(data.channel_width)
    if not np.isfinite(frequencies).all():
        count = np.sum(~np.isfinite(frequencies))
        raise InputError(f"{names}: {count} of {frequencies.size} frequencies are not finite (NaN or infinite)")
    if frequencies.min() < LOWEST_FREQUENCY or frequencies.max() > HIGHEST_FREQUENCY:
        hint = " (they look like MHz)" if frequencies.min() > 1 and frequencies.max() < 1e4 else ""
        raise InputError(
            f"{names}: frequencies of {frequencies.min():g} to {frequencies.max():g} Hz{hint}; between "
            f"{LOWEST_FREQUENCY:g} and {HIGHEST_FREQUENCY:g} Hz are allowed"
        )
    values, counts = np.unique(frequencies, return_counts=True)
    if data.flex_spw_id_array is None or data.Nspws == 1:
        for value in values[counts > 1][:1]:
            raise InputError(f"{names}: the frequency {value / 1e6:g} MHz occurs {counts.max()} times; once is allowed")
    if not np.isfinite(widths).all() or (widths == 0).any():
        raise InputError(f"{names}: channel widths of {widths.min():g} to {widths.max():g} Hz; they must not be zero")
    if not np.isfinite(data.time_array).all():
        raise InputError(f"{names}: times are not finite (NaN or infinite); Julian dates are needed")
    durations = np.asarray(data.integration_time)
    if not np.isfinite(durations).all() or durations.min() <= 0:
        raise InputError(
            f"{names}: integration times of {durations.min():g} to {durations.max():g} s; they must be positive"
        )


def prepare(data: UVData, selection: Selection = EVERYTHING, x: str = "east") -> tuple[UVData, list[str]]:
    """Select, unphase, order and fill a data set, and describe each change in one sentence; the given is not changed.

    The result has parallel hands only, is drift-scan, and has every baseline once at every time in time-major order,
    and ascending channels; samples that were missing, of no measurement or not finite are flagged. `x` is the direction
    of feeds x in files that do not tell it. Raises InputError if nothing is left, the polarizations are not of feeds,
    spectral windows overlap, or less than half of the samples are at common times.
    """
    notes: list[str] = []
    data = select(data, replace(selection, times=None)).copy()
    _keep_parallel_hands(data, notes)
    if data.flex_spw_polarization_array is not None:
        raise InputError("data: spectral windows of different polarizations are not supported; convert the file first")
    _name_feeds(data, x, notes)
    if any(entry["cat_type"] != "unprojected" for entry in data.phase_center_catalog.values()):
        data.unproject_phase()
        notes.append("The data were phased to a source; they are calibrated, and written, as a drift scan.")
    share_orientation(data)
    if not data.nsample_array.any():
        data.nsample_array[:] = 1
        notes.append("The file does not count measurements (all nsamples are 0); each sample counts as one.")
    share_times(data, notes)
    data.reorder_freqs(channel_order="freq", spw_order="freq", run_check=False)
    _require_ascending(np.ravel(data.freq_array))
    data.reorder_blts(order="time", minor_order="baseline", run_check=False)
    data = select(_filled(data, notes), Selection(times=selection.times))
    bad = ~np.isfinite(data.data_array) & ~data.flag_array
    if bad.any():
        data.flag_array |= bad
        notes.append(f"{bad.sum()} samples are not finite (NaN or infinite) and were flagged{_all_of(data, bad)}.")
    # Flagged or not, pyuvdata does not write autocorrelations that are not real, and NaN is none.
    autos = data.ant_1_array == data.ant_2_array
    data.data_array[autos[:, None, None] & ~np.isfinite(data.data_array)] = 0
    none = (data.nsample_array == 0) & ~data.flag_array
    if none.any():
        data.flag_array |= none
        notes.append(f"{none.sum()} samples are of no measurement (nsamples of 0) and were flagged.")
    for note in notes:
        logger.info(note)
    return data, notes


def _all_of(data: UVData, bad: np.ndarray) -> str:
    """Return words that name antennas of which nothing is left but for these samples, which are flagged; or nothing."""
    antennas = np.column_stack([data.ant_1_array, data.ant_2_array])
    gone = np.setdiff1d(antennas[bad.any(axis=(1, 2))], antennas[~data.flag_array.all(axis=(1, 2))])
    return f", all that there are of antenna(s) {', '.join(map(str, gone))}" if gone.size else ""


def _keep_parallel_hands(data: UVData, notes: list[str]) -> None:
    numbers = np.asarray(data.polarization_array)
    wanted = np.isin(numbers, list(PARALLEL_HANDS))
    if not wanted.any():
        raise InputError(
            f"data: polarizations {polarization_names(data.polarization_array)} have no parallel hands of feeds "
            f"({', '.join(PARALLEL_HANDS.values())}), which have gains"
        )
    if not wanted.all():
        data.select(polarizations=numbers[wanted], run_check=False)
        notes.append(f"Polarizations {polarization_names(numbers[~wanted])} are not calibrated.")


def _name_feeds(data: UVData, x: str, notes: list[str]) -> None:
    """Name the feeds of old files without names, because gains belong to feeds."""
    if data.telescope.feed_array is None:
        linear = bool(np.all(data.polarization_array <= -5))
        data.telescope.set_feeds_from_x_orientation(
            x, feeds=["x", "y"] if linear else ["r", "l"], polarization_array=data.polarization_array
        )
        notes.append(f"The file does not tell the orientation of its feeds; x is taken to be {x}.")


def _require_ascending(frequencies: np.ndarray) -> None:
    """Raise InputError if spectral windows, in the order of their frequencies, overlap."""
    falls = np.flatnonzero(np.diff(frequencies) <= 0)
    if falls.size:
        end, start = frequencies[falls[0] : falls[0] + 2] / 1e6
        raise InputError(
            f"data: spectral windows overlap: one ends at {end:.3f} MHz, and the next starts at {start:.3f} MHz; "
            "channels must ascend: select those of one window by --select frequencies"
        )


def share_orientation(data: UVData) -> None:
    """Turn baselines that are from a to b in some samples, and from b to a in others, to one direction.

    Files of programs with different conventions have them. `data` may be only metadata.
    """
    first, second = np.asarray(data.ant_1_array), np.asarray(data.ant_2_array)
    _, baseline = np.unique(np.sort(np.column_stack([first, second]), axis=1), axis=0, return_inverse=True)
    baseline = baseline.ravel()
    turned = first > second
    mixed = np.intersect1d(baseline[turned], baseline[~turned])
    if mixed.size:
        data.conjugate_bls(np.flatnonzero(turned & np.isin(baseline, mixed)))


def share_times(data: UVData, notes: list[str]) -> bool:
    """Give all samples one duration, in data or in metadata alone, and return whether samples were copied for that.

    Averaging in time that differs between baselines is undone by copies. Other durations, as of a last integration or
    where samples were flagged before averaging, become numbers of measurements.
    """
    integration = np.asarray(data.integration_time, float)
    shortest, longest = float(integration.min()), float(integration.max())
    if np.allclose(integration, shortest, rtol=0.01):
        return False
    if not _averaged_differently(data):
        usual = float(np.median(integration))
        if data.nsample_array is not None:
            data.nsample_array = data.nsample_array * (integration / usual)[:, None, None]
        data.integration_time = np.full(integration.size, usual)
        notes.append(
            f"Samples last {shortest:.3g} to {longest:.3g} s; they count as {usual:.3g} s, with nsamples in proportion."
        )
        return False
    with redirect_stdout(StringIO()):
        data.upsample_in_time(shortest * 1.001, blt_order="time", minor_order="baseline")
    notes.append(
        f"Baselines were averaged over {shortest:.3g} to {longest:.3g} s; all are copied to the shortest, and chi "
        "squared of copies is too low by their number."
    )
    middle = np.asarray(data.time_array)
    tolerance = SAME_TIME * shortest / SECONDS_PER_DAY
    times = np.unique(middle)
    starts = np.concatenate([[True], np.diff(times) > tolerance])
    data.time_array = times[starts][np.cumsum(starts)[np.searchsorted(times, middle)] - 1]
    data.set_lsts_from_time_array()
    data.Ntimes = np.unique(data.time_array).size
    return True


def _averaged_differently(data: UVData) -> bool:
    """Whether samples of some baselines last longer than those of others are apart in time.

    Baselines with gaps, or with shorter samples than others, have not been averaged more than these.
    """
    baselines, times = np.asarray(data.baseline_array), np.asarray(data.time_array) * SECONDS_PER_DAY
    durations = np.asarray(data.integration_time, float)
    order = np.lexsort((times, baselines))
    rows = np.split(order, np.flatnonzero(np.diff(baselines[order])) + 1)
    apart = [float(np.median(np.diff(times[row]))) for row in rows if row.size > 1]
    if not apart:
        return bool(np.ptp(times) > SAME_TIME * durations.min())
    return max(float(np.median(durations[row])) for row in rows) > COPIED * min(apart)


def _filled(data: UVData, notes: list[str]) -> UVData:
    """Return data with every baseline at every time, missing samples flagged; ordered by time, then baseline."""
    times, time_index = np.unique(data.time_array, return_inverse=True)
    baselines, baseline_index = np.unique(data.baseline_array, return_inverse=True)
    place = time_index * baselines.size + baseline_index
    total = times.size * baselines.size
    if np.unique(place).size != data.Nblts:
        raise InputError("data: some baselines occur twice at the same time")
    if data.Nblts < MIN_PRESENT * total:
        raise InputError(
            f"data: of {baselines.size} baselines at {times.size} times only {100 * data.Nblts / total:.0f} % of the "
            "samples are present; calibration needs baselines at common times"
        )
    if data.Nblts == total:
        return _reindexed(data, np.argsort(place), np.argsort(place))
    source = np.full(total, -1)
    source[place] = np.arange(data.Nblts)
    missing = source < 0
    # A missing sample takes the properties of its time from one sample, and those of its baseline from another.
    of_time, of_baseline = np.empty(times.size, int), np.empty(baselines.size, int)
    of_time[time_index], of_baseline[baseline_index] = np.arange(data.Nblts), np.arange(data.Nblts)
    by_time = np.where(missing, np.repeat(of_time, baselines.size), source)
    by_baseline = np.where(missing, np.tile(of_baseline, times.size), source)
    result = _reindexed(data, by_time, by_baseline)
    result.data_array[missing] = 0
    result.flag_array[missing] = True
    result.nsample_array[missing] = 0
    notes.append(f"{missing.sum()} of {total} samples of a baseline at a time were missing and are flagged.")
    return result


OF_BASELINE = ("ant_1_array", "ant_2_array", "baseline_array", "uvw_array", "integration_time")


def _reindexed(data: UVData, by_time: np.ndarray, by_baseline: np.ndarray) -> UVData:
    """Return data whose sample i is sample by_baseline[i], with the properties of the time from sample by_time[i]."""
    result = taken(data, "Nblts", by_time)
    for name in OF_BASELINE:
        setattr(result, name, getattr(data, name)[by_baseline])
    result.Ntimes = np.unique(result.time_array).size
    result.Nbls = result.Nblts // result.Ntimes
    result.blt_order = ("time", "baseline")
    return result


def place_antennas(data: UVData, path: Path) -> str:
    """Give antennas their positions, and baselines the vectors between these; return a sentence on the changes.

    `data` are drift-scan visibilities, perhaps only metadata, and are changed. `path` is a CSV file with columns
    number, east_m, north_m and up_m, about the location of the telescope. Raise InputError if the file cannot be used,
    or lacks an antenna of the data, or the data are phased to a source.
    """
    if any(entry["cat_type"] != "unprojected" for entry in data.phase_center_catalog.values()):
        raise InputError("observed.positions: the data are phased to a source, by the positions that they have")
    try:
        layout = read_positions(path, numbered=True)
        require_valid(layout, f"instrument.layout.path: {path}")
    except InputError as error:
        raise InputError(str(error).replace("instrument.layout.path", "observed.positions")) from None
    telescope = data.telescope
    present = np.union1d(data.ant_1_array, data.ant_2_array)
    missing = np.setdiff1d(present, layout.numbers)
    if missing.size:
        raise InputError(f"observed.positions: {path} has no antenna {missing[0]}, which is in the data")
    enu = telescope.get_enu_antpos()
    moved = np.isin(telescope.antenna_numbers, layout.numbers)
    before = enu[moved]
    enu[moved] = layout.enu[positions(layout.numbers, telescope.antenna_numbers[moved])]
    centre = np.array([axis.to_value(units.m) for axis in telescope.location.geocentric])
    telescope.antenna_positions = utils.ECEF_from_ENU(enu, center_loc=telescope.location) - centre
    data.set_uvws_from_antenna_positions(update_vis=False)
    distances = [np.linalg.norm(places[:, None] - places, axis=-1) for places in (before, enu[moved])]
    return (
        f"Antenna positions are those of {path.name}; distances between antennas change by up to "
        f"{np.abs(distances[1] - distances[0]).max():.3g} m."
    )
