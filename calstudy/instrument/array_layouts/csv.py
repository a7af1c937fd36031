"""Antennas from a table of positions."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.instrument.layouts import SITES, ArrayLayout, Layout, Place, east_north_up

COLUMNS = {
    "east_m": ("e", "east"),
    "north_m": ("n", "north"),
    "up_m": ("u", "up"),
    "latitude": ("lat", "latitude_deg"),
    "longitude": ("lon", "long", "longitude_deg"),
    "height_m": ("height", "alt", "altitude"),
    "name": (),
    "number": (),
}
"""Columns and their other names, in small letters; those of one letter are pyuvsim's."""
LARGEST_NUMBER = 2**31 - 1
LOCAL, GEODETIC = ("east_m", "north_m", "up_m"), ("latitude", "longitude", "height_m")


class CsvLayout(ArrayLayout):
    """Positions from a table with columns east_m, north_m, up_m, or latitude and longitude in degrees and height_m.

    `name` and `number` are optional columns, others are ignored. Columns are separated by commas, semicolons, tabs or
    spaces, so that pyuvsim's files (Name Number BeamID E N U) can be used. Lines that begin with # are comments; the
    first other line names the columns. With both kinds of positions, east_m, north_m and up_m count.
    It needs `instrument.location`: such a table does not say where the array is, or not exactly.
    """

    site: ClassVar[str | None] = None

    kind: str = "csv"
    path: Path = Field(description="The table, relative to the experiment file or absolute.")

    @property
    def origin(self) -> str:
        """The field and the file."""
        return f"instrument.layout.path: {self.path}"

    def make(self) -> Layout:
        """Return the antennas of the file; raises InputError if it is missing or does not hold antenna positions."""
        return read_positions(self.path)


def read_positions(path: Path, numbered: bool = False) -> Layout:
    """Return the antennas of a table; with `numbered`, raise InputError if it does not number them."""
    if not path.is_file():
        raise InputError(f"instrument.layout.path: there is no file {path}")
    columns, lines, rows = _read_rows(path)
    geodetic = {"latitude", "longitude"} <= set(columns) and not set(LOCAL) <= set(columns)
    missing = set(GEODETIC if geodetic else LOCAL).difference(columns)
    if missing or len(rows) < 2:
        lacking = f"; missing: {', '.join(sorted(missing))}" if columns and missing else ""
        raise InputError(
            f"instrument.layout.path: {path} needs at least two rows with columns east_m, north_m, up_m, or latitude, "
            f"longitude, height_m{lacking}; found: {len(rows)} rows of {', '.join(columns) or 'nothing'}"
        )
    if numbered and "number" not in columns:
        raise InputError(f"instrument.layout.path: {path} needs a column number, by which antennas are found")
    positions, found = np.zeros((len(rows), 3)), []
    for index, (line, row) in enumerate(zip(lines, rows, strict=True)):
        try:
            positions[index] = [float(row[name]) for name in (GEODETIC if geodetic else LOCAL)]
            found.append(_whole(row.get("number", str(index))))
        except ValueError as error:
            raise InputError(
                f"instrument.layout.path: line {line} of {path} holds an entry that is not a number ({error})"
            ) from None
        if not np.isfinite(positions[index]).all():
            raise InputError(f"instrument.layout.path: line {line} of {path} has a position that is not finite")
    numbers = np.array(found)
    if numbers.max() > LARGEST_NUMBER:
        raise InputError(f"instrument.layout.path: antenna number {numbers.max()} in {path} exceeds {LARGEST_NUMBER}")
    place = SITES["mwa"]
    if geodetic:
        positions, place = _about_their_mean(positions, lines, path)
    names = tuple(row["name"] for row in rows) if "name" in columns else tuple(f"ant{n:03d}" for n in numbers)
    return Layout(path.stem, numbers, names, positions, place, surveyed=geodetic)


def _whole(text: str) -> int:
    """Return the number of an antenna, which some programs write as 7.0; raises ValueError if it is not whole."""
    number = float(text)
    if not number.is_integer():
        raise ValueError(f"antenna number {text!r} is not whole")
    return int(number)


def _read_rows(path: Path) -> tuple[list[str], list[int], list[dict[str, str]]]:
    """Return the columns of a table, by the names in `COLUMNS`, and the lines and cells of its rows.

    Raises InputError if the file is no table.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()
        places = [at for at, line in enumerate(text) if line.strip() and not line.lstrip().startswith("#")]
        lines = [text[at] for at in places]
        if lines and not re.search("[,;\t]", lines[0].strip()):
            lines = [re.sub(r"\s+", "\t", line.strip()) for line in lines]
        separator = next((mark for mark in (",", ";", "\t") if lines and mark in lines[0]), ",")
        reader = csv.reader(lines, delimiter=separator, skipinitialspace=True, strict=True)
        cells = [([cell.strip() for cell in row], places[reader.line_num - 1] + 1) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"instrument.layout.path: {path} is not a CSV file in UTF-8 ({error})") from None
    (header, _), *rows = cells or [([], 0)]
    uneven = next((line for row, line in rows if len(row) != len(header)), None)
    if uneven is not None:
        raise InputError(f"instrument.layout.path: line {uneven} of {path} has more or fewer cells than the first")
    known = {other: name for name, others in COLUMNS.items() for other in (name, *others)}
    names = [known.get(cell.lower(), cell) for cell in header]
    twice = next((name for name in COLUMNS if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"instrument.layout.path: {path} has the column {twice} twice")
    return names, [line for _, line in rows], [dict(zip(names, row, strict=True)) for row, _ in rows]


def _about_their_mean(geodetic: np.ndarray, lines: list[int], path: Path) -> tuple[np.ndarray, Place]:
    """Return east, north, up of latitudes and longitudes in degrees and heights in m, (Nants, 3), and their mean."""
    from astropy.coordinates import EarthLocation

    latitudes, longitudes, heights = geodetic.T
    # Neighbours on either side of 180 degrees differ by little.
    longitudes = longitudes[0] + (longitudes - longitudes[0] + 180) % 360 - 180
    if not (np.abs(latitudes) <= 90).all() or np.ptp(longitudes) > 1 or np.ptp(latitudes) > 1:
        away = np.abs([latitudes - np.median(latitudes), longitudes - np.median(longitudes)]).max(axis=0)
        raise InputError(
            f"instrument.layout.path: latitudes in {path} must be from -90 to 90 degrees, and latitudes and longitudes "
            f"within one degree of each other; line {lines[away.argmax()]} is the farthest"
        )
    place = Place(latitudes.mean(), longitudes.mean(), heights.mean())
    found = EarthLocation.from_geodetic(longitudes, latitudes, heights)
    vectors = np.column_stack([axis.to_value("m") for axis in found.geocentric])
    centre = [axis.to_value("m") for axis in place.location.geocentric]
    return east_north_up(vectors - centre, place), place
