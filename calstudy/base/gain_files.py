"""Files of gains: those of pyuvdata, DP3 (H5Parm), hyperdrive (FITS) and calibrate of mwa-reduce (`.bin`).

A file of the last three has antennas by name or only by order, no positions, and perhaps neither channels nor times. It
is read as a `GainTable`: only with the data that it is for does it become a UVCal.

All three describe visibilities as they are in measurement sets and UVFITS files, which are the complex conjugates of
pyuvdata's. H5Parm holds gains, as here; hyperdrive and calibrate hold Jones matrices J that calibrate data, by
J_a V_ab J_b^H. So g is the complex conjugate of the gain of an H5Parm file, and of 1 / J of the others.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.feeds import X_IN_FILE, renamed, with_feeds_of, x_in_file
from calstudy.base.foreign_files import reason_of, require_self_contained
from calstudy.base.gains import known_gains

if TYPE_CHECKING:
    import h5py
    from pyuvdata import Telescope, UVCal, UVData

PARALLEL_HANDS = {"XX": -5, "YY": -6, "RR": -1, "LL": -2}
"""AIPS numbers of parallel hands by name; pyuvdata numbers the gains of feeds alike."""


@dataclass(frozen=True, eq=False)
class GainTable:
    """Gains with what a file says of their axes, of the convention V_ab = g_a g_b* m_ab of pyuvdata's visibilities.

    They are complex, (Nants, Nfreqs, Ntimes, Nfeeds), NaN where there is no solution; a single channel or time holds
    for all of the data. Without names, antennas are all of the telescope, in the order of their numbers; without
    frequencies, Hz, channels are those of the data; without AIPS numbers of feeds, one gain is for all. `times` are
    Julian dates of the start and the end of each solution, (Ntimes, 2), `widened` by so many integrations on either
    side, so that the centres of all of its integrations are within, and of no other.
    """

    gains: np.ndarray
    antennas: list[str] | None = None
    frequencies: np.ndarray | None = None
    times: np.ndarray | None = None
    feeds: np.ndarray | None = None
    widened: float = 0.0

    @classmethod
    def of(cls, cal: UVCal) -> GainTable:
        """Return gains by channel as a table of all antennas of the telescope, by ascending number."""
        order = np.argsort(cal.telescope.antenna_numbers)
        numbers = cal.telescope.antenna_numbers[order]
        values, known = known_gains(cal)
        gains = np.full((len(numbers), *values.shape[1:]), np.nan, complex)
        gains[np.searchsorted(numbers, cal.ant_array)] = np.where(known, values, np.nan)
        single = cal.time_range is None
        return cls(
            gains,
            [str(cal.telescope.antenna_names[row]) for row in order],
            np.array(cal.freq_array),
            np.stack([cal.time_array] * 2, axis=1) if single else cal.time_range,
            np.array(cal.jones_array),
            widened=0.25 if single else 0.0,
        )

    def require_channels(self, count: int) -> None:
        """Raise InputError if the file has gains in order of the channels, and not as many as the data."""
        if self.frequencies is None and self.gains.shape[1] not in (1, count):
            raise InputError(
                f"has {self.gains.shape[1]} channels without frequencies, and the data have {count}; calibrate the "
                "same channels"
            )

    def uvcal(self, template: UVData | UVCal) -> UVCal:
        """Return the gains as UVCal, with telescope, channels and times of data, or of gains for them, where needed.

        Raises InputError if antennas, channels or solutions in time are not known.
        """
        from pyuvdata import UVCal

        self.require_channels(template.Nfreqs)
        feeds = self.feeds
        if feeds is None:
            given = template.jones_array if hasattr(template, "jones_array") else template.polarization_array
            feeds = np.array([feed for feed in given if feed in PARALLEL_HANDS.values()])
        elif X_IN_FILE in template.extra_keywords:
            feeds = renamed(feeds)
        own = self.frequencies is not None and self.gains.shape[1] > 1
        n_antennas, n_channels, n_times, _ = self.gains.shape
        shape = (n_antennas, n_channels if own else template.Nfreqs, n_times, len(feeds))
        ranges, known = self._ranges(template), np.isfinite(self.gains)
        return UVCal.new(
            telescope=template.telescope,
            ant_array=self._numbers(template.telescope),
            freq_array=self.frequencies if own else template.freq_array,
            channel_width=float(np.min(template.channel_width)) if own else template.channel_width,
            jones_array=feeds,
            time_range=ranges,
            integration_time=np.ptp(ranges, axis=1) * SECONDS_PER_DAY,
            gain_convention="divide",
            cal_style="redundant",
            cal_type="gain",
            update_telescope_from_known=False,
            data={
                "gain_array": np.broadcast_to(np.where(known, self.gains, 1), shape).copy(),
                "flag_array": np.broadcast_to(~known, shape).copy(),
            },
            history="calstudy",
        )

    def _numbers(self, telescope: Telescope) -> np.ndarray:
        """Return the number of each antenna; raises InputError if they are not in the file."""
        if self.antennas is None:
            numbers = np.sort(telescope.antenna_numbers)
            if len(numbers) != len(self.gains):
                raise InputError(
                    f"has gains of {len(self.gains)} antennas without names, and the telescope of the data has "
                    f"{len(numbers)}; both must have the same antennas"
                )
            return numbers
        known = dict(zip(telescope.antenna_names, telescope.antenna_numbers.tolist(), strict=True))
        if unknown := [name for name in self.antennas if name not in known]:
            raise InputError(
                f"the data have no antenna {unknown[0]!r}; their names are {', '.join(list(known)[:3])}, ...; "
                "antennas must have the same names"
            )
        return np.array([known[name] for name in self.antennas])

    def _ranges(self, template: UVData | UVCal) -> np.ndarray:
        """Return the start and end of each solution, Julian dates, (Ntimes, 2); of one solution those of the data."""
        centres = np.unique(template.time_array if template.time_array is not None else template.time_range)
        integration = float(np.min(template.integration_time)) / SECONDS_PER_DAY
        count = self.gains.shape[2]
        if count == 1:
            ranges, widened = centres[None, [0, -1]], 0.25
        elif self.times is not None:
            ranges, widened = self.times, self.widened
        else:
            # Equal parts of the data would be a guess: long runs are calibrated in pieces.
            raise InputError(
                f"has {count} solutions in time and not their times; calibrate all integrations together, or use a "
                "format with times"
            )
        margin = np.maximum(widened * integration, -0.49 * np.ptp(ranges, axis=1, keepdims=True))
        return ranges + margin * np.array([-1, 1])


CASACORE = "python-casacore, which is not installed: pip install 'calstudy[ms]'"
"""Package that reads and writes CASA tables and measurement sets."""
MJD_ZERO = 2400000.5
"""Julian date of the modified Julian date zero."""
FEEDS = {**PARALLEL_HANDS, "X": PARALLEL_HANDS["XX"], "Y": PARALLEL_HANDS["YY"]}
"""Names in H5Parm files, as AIPS numbers."""
LINEAR = np.array([FEEDS["XX"], FEEDS["YY"]])
JONES_DIAGONAL = [0, 3]
"""Places of XX and YY in a Jones matrix XX, XY, YX, YY."""
MAGIC = b"MWAOCAL\0"
HEADER = struct.Struct("<8s6I2d")
"""Magic, type, structure, numbers of intervals, antennas, channels and polarizations, start and end."""
H5PARM_AXES = ("ant", "freq", "time", "pol")
NEUTRAL = {"amplitude000": 1.0, "phase000": 0.0}
"""Solution tables of H5Parm files, and what stands for one that is missing."""

Reader = Callable[["Path"], GainTable]


def read_gains(path: Path, where: str, template: UVData | UVCal | None = None) -> UVCal:
    """Read gains in any format; `where` names the source of the path in errors.

    `template` are the data that the gains are for, or gains for such data; a `GainTable` needs them. Feeds are named
    as there. Raises InputError if the file cannot be read or does not fit the template.
    """
    found = read_gain_file(path, where, None if template is None else x_in_file(template))
    if not isinstance(found, GainTable):
        return found if template is None else with_feeds_of(found, template)
    try:
        if template is None:
            raise InputError("needs the data that it is for; give a CalH5 file")
        return found.uvcal(template)
    # pyuvdata refuses axes that disagree, such as times that overlap.
    except ValueError as error:
        raise InputError(f"{where} = {str(path)!r}: {error}") from None


def read_gain_file(path: Path, where: str, x: str | None = None) -> UVCal | GainTable:
    """Read gains without the data that they are for; see `read_gains`.

    `x` is the direction of feeds x in CASA tables, which need not tell it: "east" by default, or "north".
    """
    from pyuvdata import UVCal

    missing = f"reading a CASA table takes {CASACORE}" if path.is_dir() else "no such file or folder"
    if not path.exists() or (path.is_dir() and find_spec("casacore") is None):
        raise InputError(f"{where} = {str(path)!r}: {missing}")
    require_self_contained(path)
    kind = "CASA table of gains" if path.is_dir() else "file of CalH5, calfits, H5Parm, hyperdrive or calibrate"
    try:
        if (reader := find_reader(path)) is None:
            return UVCal.from_file(str(path), default_x_orientation=x)
        kind, read = reader
        return read(path)
    # The readers raise the errors of their libraries; the user must correct a file that cannot be read.
    except (OSError, ValueError, LookupError, RuntimeError, TypeError, AttributeError) as error:
        raise InputError(f"{where} = {str(path)!r}: not a readable {kind} ({reason_of(error)})") from None


def read_gain_pair(first: Path, second: Path) -> tuple[UVCal, UVCal]:
    """Read two files of gains to be compared, where axes missing in one are taken from the other; see `read_gains`."""
    files = ((first, "the first file"), (second, "the second file"))
    whole = next((cal for cal in (read_gain_file(*file) for file in files) if not isinstance(cal, GainTable)), None)
    one, other = (read_gains(path, name, whole) for path, name in files)
    return one, other


def find_reader(path: Path) -> tuple[str, Reader] | None:
    """Return the kind of a file, in words, and what reads it, or None if it is none of those here; may raise OSError.

    The readers raise ValueError with a sentence if the file is not as its format demands.
    """
    import h5py
    from astropy.io import fits

    if path.is_dir():
        return None
    with path.open("rb") as file:
        start = file.read(len(MAGIC))
    if start == MAGIC or path.suffix == ".bin":
        return "file of calibrate", read_mwaocal
    if start.startswith(b"SIMPLE"):
        with fits.open(path) as hdus:
            return ("file of hyperdrive", read_hyperdrive) if "SOLUTIONS" in hdus else None
    if h5py.is_hdf5(path):
        with h5py.File(path) as opened:
            if _solution_sets(opened):
                return "H5Parm file", read_h5parm
    return None


def read_mwaocal(path: Path) -> GainTable:
    """Read the binary file of calibrate, which hyperdrive also writes; its times, often zero, are ignored."""
    content = path.read_bytes()
    if len(content) < HEADER.size or not content.startswith(MAGIC):
        raise ValueError("it does not start with MWAOCAL")
    _, kind, structure, *shape, _, _ = HEADER.unpack_from(content)
    if kind or structure or shape[-1] != len(LINEAR) ** 2:
        raise ValueError(f"its type, structure and polarizations are {kind}, {structure}, {shape[-1]}, and not 0, 0, 4")
    expected = HEADER.size + 16 * int(np.prod(shape, dtype=object))
    if len(content) != expected or 0 in shape:
        sizes = f"{shape[0]} intervals, {shape[1]} antennas and {shape[2]} channels"
        raise ValueError(f"it has {len(content)} bytes, and its header promises {expected}, of {sizes}")
    jones = np.frombuffer(content, "<c16", offset=HEADER.size).reshape(shape)
    return GainTable(_of_jones(jones), feeds=LINEAR)


def read_hyperdrive(path: Path) -> GainTable:
    """Read a FITS file of hyperdrive; only the solutions themselves must be there."""
    from astropy.io import fits
    from astropy.time import Time

    with fits.open(path) as hdus:
        values = np.asarray(hdus["SOLUTIONS"].data, float)
        if values.ndim != 4 or values.shape[-1] != 8:
            raise ValueError(f"SOLUTIONS has shape {values.shape}, and not (times, tiles, channels, 8)")
        n_times, n_tiles, n_channels, _ = values.shape
        names = _column(hdus, "TILES", "TileName", n_tiles)
        frequencies = _column(hdus, "CHANBLOCKS", "Freq", n_channels)
        start, end = (_column(hdus, "TIMEBLOCKS", name, n_times) for name in ("Start", "End"))
    # Columns that hyperdrive does not know are zero or NaN.
    if frequencies is not None and not (np.isfinite(frequencies).all() and (frequencies > 0).all()):
        frequencies = None
    times = None if start is None or end is None else np.stack([start, end], axis=1)
    if times is not None:
        times = Time(times, format="gps").utc.jd if np.isfinite(times).all() and times.all() else None
    return GainTable(
        _of_jones(values[..., ::2] + 1j * values[..., 1::2]),
        None if names is None else [str(name).strip() for name in names],
        frequencies,
        times,
        LINEAR,
        widened=0.25,  # They are the centres of the first and the last integration.
    )


def read_h5parm(path: Path) -> GainTable:
    """Read amplitudes and phases of an H5Parm file; either may be missing, and every axis but that of antennas."""
    import h5py

    with h5py.File(path) as file:
        sets = _solution_sets(file)
        if len(sets) != 1:
            raise ValueError(f"it has the solution sets {', '.join(sets)}; one is needed")
        group = file[sets[0]]
        names = [name for name in NEUTRAL if name in group]
        if not names:
            raise ValueError(f"it has {', '.join(group)}, and neither amplitude000 nor phase000")
        tables = {name: _soltab(group[name]) for name in names}
    axes: dict[str, np.ndarray] = {}
    for name, (_, found) in tables.items():
        for axis, labels in found.items():
            if axis not in axes or len(axes[axis]) == 1:
                axes[axis] = labels
            elif len(labels) > 1 and not np.array_equal(axes[axis], labels):
                raise ValueError(f"amplitude000 and {name} have different axes {axis}")
    amplitude, phase = (tables[name][0] if name in tables else fill for name, fill in NEUTRAL.items())
    gains: Any = amplitude * np.exp(-1j * phase)
    feeds = None
    if "pol" in axes:
        kept = [place for place, name in enumerate(axes["pol"]) if name in FEEDS]
        if not kept:
            raise ValueError(f"its polarizations are {', '.join(axes['pol'])}; XX and YY are needed")
        feeds, gains = np.array([FEEDS[axes["pol"][place]] for place in kept]), gains[..., kept]
    return GainTable(
        np.asarray(gains, complex), list(axes["ant"]), axes.get("freq"), _intervals(axes.get("time")), feeds, -0.25
    )


def _intervals(seconds: np.ndarray | None) -> np.ndarray | None:
    """Return start and end, Julian dates, (Ntimes, 2), of solutions, taken to follow each other, with centres in s."""
    if seconds is None or len(seconds) == 1:
        return None
    half = np.min(np.diff(seconds)) / 2
    return (seconds[:, None] + half * np.array([-1, 1])) / SECONDS_PER_DAY + MJD_ZERO


def _soltab(group: h5py.Group) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the values of a solution table, (ant, freq, time, pol), NaN where their weight is zero, and its axes."""
    names = _text(group["val"].attrs["AXES"]).split(",")
    values = group["val"][()]
    if "weight" in group:
        values = np.where(group["weight"][()] > 0, values, np.nan)
    for axis in set(names) - set(H5PARM_AXES):
        place = names.index(axis)
        if values.shape[place] != 1:
            raise ValueError(f"it has {values.shape[place]} solutions along {axis!r}, and one is needed")
        values = values.take(0, place)
        names.remove(axis)
    if "ant" not in names:
        raise ValueError("it has no axis of antennas")
    axes = {axis: group[axis][()] for axis in names}
    for axis in {"ant", "pol"} & set(names):
        axes[axis] = np.array([_text(label) for label in axes[axis]])
    values = values.transpose([names.index(axis) for axis in H5PARM_AXES if axis in names])
    return np.expand_dims(values, [i for i, axis in enumerate(H5PARM_AXES) if axis not in names]), axes


def _text(value: bytes | str) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _solution_sets(file: h5py.File) -> list[str]:
    """Return the names of the solution sets of an H5Parm file; other files have none."""
    return [name for name in file if "h5parm_version" in file[name].attrs or name.startswith("sol")]


def _column(hdus: Any, table: str, name: str, count: int) -> np.ndarray | None:
    """Return a column of a FITS table, or None if there is none; raises ValueError if it has another length."""
    if table not in hdus or name not in hdus[table].columns.names:
        return None
    column = np.asarray(hdus[table].data[name])
    if len(column) != count:
        raise ValueError(f"{table} has {len(column)} rows, and SOLUTIONS {count}")
    return column


def _of_jones(jones: np.ndarray) -> np.ndarray:
    """Return gains, (Nants, Nfreqs, Ntimes, 2), of Jones matrices that calibrate, (Ntimes, Nants, Nfreqs, 4)."""
    diagonal = jones[..., JONES_DIAGONAL]
    known = np.isfinite(jones).all(axis=-1, keepdims=True) & (diagonal != 0)
    return np.moveaxis(np.where(known, 1 / np.where(known, diagonal, 1).conj(), np.nan), 0, 2)


def write_gains(cal: UVCal, path: Path | str) -> None:
    """Write gains by channel, of all antennas by number, in the format of a suffix in `WRITERS`.

    Raises InputError for another suffix, and if a format of Jones matrices lacks a feed.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise InputError(f"{path}: gains are not written as {path.suffix!r}; allowed are {', '.join(WRITERS)}")
    WRITERS[path.suffix](GainTable.of(cal), path)


def _write_mwaocal(table: GainTable, path: Path) -> None:
    jones, gps = _to_jones(table, path), _gps(table)
    header = HEADER.pack(MAGIC, 0, 0, *jones.shape, gps[0, 0], gps[-1, 1])
    path.write_bytes(header + jones.astype("<c16").tobytes())


def _write_hyperdrive(table: GainTable, path: Path) -> None:
    from astropy.io import fits
    from astropy.table import Table

    jones, gps = _to_jones(table, path), _gps(table)
    tables = {
        "TIMEBLOCKS": {"Start": gps[:, 0], "End": gps[:, 1], "Average": gps.mean(axis=1)},
        "TILES": {
            "Antenna": np.arange(jones.shape[1], dtype=np.int32),
            "Flag": np.isnan(jones).all(axis=(0, 2, 3)).astype(np.int32),
            "TileName": np.array(table.antennas),
        },
        "CHANBLOCKS": {
            "Index": np.arange(jones.shape[2], dtype=np.int32),
            "Flag": np.isnan(jones).all(axis=(0, 1, 3)).astype(np.int32),
            "Freq": table.frequencies,
        },
    }
    primary = fits.PrimaryHDU()
    primary.header["SOFTWARE"] = "calstudy"
    hdus = [primary, fits.ImageHDU(jones.view(float), name="SOLUTIONS")]
    hdus += [fits.BinTableHDU(Table(columns), name=name) for name, columns in tables.items()]
    fits.HDUList(hdus).writeto(path, overwrite=True)


def _write_h5parm(table: GainTable, path: Path) -> None:
    import h5py

    hands = {number: name for name, number in PARALLEL_HANDS.items()}
    gains = table.gains.conj().transpose(2, 1, 0, 3)
    axes = {
        "time": (np.asarray(table.times).mean(axis=1) - MJD_ZERO) * SECONDS_PER_DAY,
        "freq": table.frequencies,
        "ant": _terminated(table.antennas or []),
        "pol": _terminated([hands[feed] for feed in np.array(table.feeds).tolist()]),
    }
    with h5py.File(path, "w") as file:
        group = file.create_group("sol000")
        group.attrs["h5parm_version"] = np.bytes_(b"1.0")
        for name, values in (("amplitude", np.abs(gains)), ("phase", np.angle(gains))):
            soltab = group.create_group(f"{name}000")
            soltab.attrs["TITLE"] = np.bytes_(name.encode())
            soltab.attrs["h5parm_version"] = np.bytes_(b"1.0")
            for axis, labels in axes.items():
                soltab[axis] = labels
            for data, array in (("val", values), ("weight", np.isfinite(values).astype(np.float32))):
                soltab[data] = array
                soltab[data].attrs["AXES"] = np.bytes_(",".join(axes).encode())


def _terminated(texts: list[str]) -> np.ndarray:
    """Return texts that end with a zero byte: DP3 finds no antenna whose name lacks it."""
    return np.array(texts, f"S{max(len(text) for text in texts) + 1}")


WRITERS = {".h5": _write_h5parm, ".fits": _write_hyperdrive, ".bin": _write_mwaocal}


def _to_jones(table: GainTable, path: Path) -> np.ndarray:
    """Return Jones matrices that calibrate, complex, (Ntimes, Nants, Nfreqs, 4), or raise without both feeds."""
    feeds = np.array(table.feeds).tolist()
    if sorted(feeds) != sorted(LINEAR):
        raise InputError(f"{path}: a Jones matrix has gains of xx and yy, and these are of {len(feeds)} feed(s)")
    gains = np.moveaxis(table.gains[..., [feeds.index(feed) for feed in LINEAR]], 2, 0)
    jones = np.zeros((*gains.shape[:3], 4), complex)
    known = np.isfinite(gains).all(axis=-1)
    jones[..., JONES_DIAGONAL] = 1 / np.where(known[..., None], gains, 1).conj()
    jones[~known] = complex(np.nan, np.nan)
    return jones


def _gps(table: GainTable) -> np.ndarray:
    """Return the start and end of each solution in s of GPS, (Ntimes, 2)."""
    from astropy.time import Time

    return Time(table.times, format="jd", scale="utc").gps
