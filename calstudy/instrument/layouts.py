"""Named antenna layouts in local coordinates, and the redundancy of their baselines."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.package_files import PackageFile
from calstudy.instrument import settings as section
from calstudy.instrument.hera import SPACING, core_positions, outrigger_positions
from calstudy.instrument.sites import SITES, Place, east_north_up, place_of

if TYPE_CHECKING:
    from astropy.coordinates import EarthLocation


def _tiles(receivers: Iterable[int]) -> tuple[str, ...]:
    return tuple(f"Tile{receiver:02d}{tile}" for receiver in receivers for tile in range(1, 9))


CORE_RECEIVERS = (1, 2, 3, 4, 6, 8, 9)
OUTER_RECEIVERS = (5, 7, 10, 11, 12, 13, 14, 15, 16)
CORE_TILES = _tiles(CORE_RECEIVERS)
LONG_BASELINE_TILES = tuple(f"LB{group}{tile}" for group in "ABCDEFG" for tile in range(1, 9))
HEX_EAST_TILES = tuple(f"HexE{tile:02d}" for tile in range(1, 37))
HEX_SOUTH_TILES = tuple(f"HexS{tile:02d}" for tile in range(1, 37))
COMPACT_TILES = CORE_TILES + HEX_EAST_TILES + HEX_SOUTH_TILES
MWA_TILES: dict[str, tuple[str, ...]] = {
    "mwa-compact-minredundant": CORE_TILES[:36],
    "mwa-compact-hex-east": HEX_EAST_TILES,
    "mwa-compact-hex-south": HEX_SOUTH_TILES,
    "mwa-compact": COMPACT_TILES,
    "mwa-extended": _tiles(OUTER_RECEIVERS) + LONG_BASELINE_TILES,
    "mwa-phase1": _tiles(range(1, 17)),
}
MWA_POSITIONS = PackageFile("pyuvdata", "data/mwa_ant_pos.csv")
MWA_CONFIGURATIONS = (COMPACT_TILES, MWA_TILES["mwa-extended"], MWA_TILES["mwa-phase1"])

# Optimal Golomb rulers by order (all their differences are distinct; length proved shortest).
GOLOMB_MARKS = {
    2: (0, 1),
    3: (0, 1, 3),
    4: (0, 1, 4, 6),
    5: (0, 1, 4, 9, 11),
    6: (0, 1, 4, 10, 12, 17),
    7: (0, 1, 4, 10, 18, 23, 25),
    8: (0, 1, 4, 9, 15, 22, 32, 34),
    9: (0, 1, 5, 12, 25, 27, 35, 41, 44),
    10: (0, 1, 6, 10, 23, 26, 34, 41, 53, 55),
    11: (0, 1, 4, 13, 28, 33, 47, 54, 64, 70, 72),
    12: (0, 2, 6, 24, 29, 40, 43, 55, 68, 75, 76, 85),
    13: (0, 2, 5, 25, 37, 43, 59, 70, 85, 89, 98, 99, 106),
    14: (0, 4, 6, 20, 35, 52, 59, 77, 78, 86, 89, 99, 122, 127),
    15: (0, 4, 20, 30, 57, 59, 62, 76, 100, 111, 123, 136, 144, 145, 151),
    16: (0, 1, 4, 11, 26, 32, 56, 68, 76, 115, 117, 134, 150, 163, 168, 177),
}
ROW_LENGTH = 8
HERA_SIDES = {"hera-19": 3, "hera-37": 4}


@dataclass(frozen=True)
class Layout:
    """Positions of the antennas of an array.

    Attributes
    ----------
    name
        Name of the layout.
    numbers
        Antenna numbers, unique, int array of shape (Nants,). The number of an MWA tile is its place in the 128-tile
        configuration, also in layouts that use a part of it.
    names
        Antenna names, unique.
    enu
        East, north, up in metres about the array centre, float64, shape (Nants, 3).
    place
        Where the array is: its centre, for arrays at their own site.
    """

    name: str
    numbers: np.ndarray
    names: tuple[str, ...]
    enu: np.ndarray
    place: Place

    @property
    def location(self) -> EarthLocation:
        """Where the array is, as astropy has it."""
        return self.place.location


@dataclass(frozen=True)
class RedundantGroups:
    """Redundant groups of baselines.

    Attributes
    ----------
    index
        Group of each baseline, int array of shape (Nbls,); groups are numbered by their first baseline.
    conjugated
        Whether a baseline has the opposite direction of the first baseline of its group, so that its visibility is the
        complex conjugate of that of the group, bool array of shape (Nbls,).
    """

    index: np.ndarray
    conjugated: np.ndarray


def make_layout(settings: section.Layout) -> Layout:
    """Return the antennas of the `instrument.layout` section.

    Parameters
    ----------
    settings
        Any kind of layout section.

    Raises
    ------
    InputError
        If a CSV file is missing or does not hold antenna positions.
    """
    if isinstance(settings, section.MwaLayout):
        return _mwa(settings)
    if isinstance(settings, section.CsvLayout):
        return _from_csv(settings.path)
    if isinstance(settings, section.HeraLayout):
        return _synthetic(settings, _hera(settings), "HH")
    return _synthetic(settings, SYNTHETIC[settings.kind](settings))


def make_array(settings: section.InstrumentSettings) -> Layout:
    """Return the antennas of an instrument, where `instrument.location` says or at the layout's own site.

    Parameters
    ----------
    settings
        The `instrument` section.

    Raises
    ------
    InputError
        If a CSV file is missing or does not hold antenna positions.
    """
    return replace(make_layout(settings.layout), place=place_of(settings.site))


def redundant_groups(vectors: np.ndarray, tolerance: float) -> RedundantGroups:
    """Sort baselines into redundant groups. A baseline and its reverse are in the same group.

    Parameters
    ----------
    vectors
        Baseline vectors in metres, shape (Nbls, 3).
    tolerance
        Baselines that differ by less than this, in metres, are redundant.
    """
    from pyuvdata.utils import redundancy

    groups, _, _, _ = redundancy.get_baseline_redundancies(
        np.arange(len(vectors)), np.asarray(vectors, dtype=float), tol=tolerance, include_conjugates=True
    )
    index = np.empty(len(vectors), dtype=int)
    conjugated = np.zeros(len(vectors), dtype=bool)
    for number, members in enumerate(sorted((np.sort(group) for group in groups), key=lambda group: group[0])):
        index[members] = number
        conjugated[members] = vectors[members] @ vectors[members[0]] < 0
    return RedundantGroups(index, conjugated)


def _mwa(settings: section.MwaLayout) -> Layout:
    """Tiles from the observatory positions that pyuvdata carries (ECEF relative to the array centre)."""
    with MWA_POSITIONS.path.open() as table:
        relative = {row["names"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(table)}
    whole = next(tiles for tiles in MWA_CONFIGURATIONS if set(tiles) >= set(MWA_TILES[settings.kind]))
    tiles = MWA_TILES[settings.kind][: settings.count]
    place = SITES["mwa"]
    enu = east_north_up(np.array([relative[tile] for tile in whole]), place)
    # The table's heights are above the ellipsoid, not the array centre (+377.83 m in all of them).
    enu[:, 2] -= enu[:, 2].mean()
    numbers = np.array([whole.index(tile) for tile in tiles])
    return Layout(settings.kind, numbers, tiles, enu[numbers], place)


def _synthetic(settings: section.ArrayLayout, positions: np.ndarray, prefix: str | None = None) -> Layout:
    """Flat array of (east, north) positions about their mean, at the site of the layout."""
    enu = np.column_stack([positions - positions.mean(axis=0), np.zeros(len(positions))])
    numbers = np.arange(len(enu))
    kind = settings.kind
    names = tuple(f"{kind if prefix is None else prefix}{number:03d}" for number in numbers)
    return Layout(kind, numbers, names, enu, SITES[settings.site])


def _hera(settings: section.HeraLayout) -> np.ndarray:
    """Positions of HERA's antennas, in the order of their numbers."""
    if settings.kind in HERA_SIDES:
        positions = _hex(section.HexLayout(kind="hex", side=HERA_SIDES[settings.kind], spacing=f"{SPACING} m"))
    else:
        positions = np.concatenate([core_positions(), outrigger_positions()])[: settings.sizes[settings.kind]]
    return positions[: settings.count]


def _hex(settings: section.HexLayout) -> np.ndarray:
    rows = []
    for row in range(1 - settings.side, settings.side):
        count = 2 * settings.side - 1 - abs(row)
        east = np.arange(count) - (count - 1) / 2
        rows.append(np.column_stack([east, np.full(count, row * math.sqrt(3) / 2)]))
    return settings.spacing * np.concatenate(rows)


def _linear(settings: section.LinearLayout) -> np.ndarray:
    return np.column_stack([settings.spacing * np.arange(settings.count), np.zeros(settings.count)])


def _golomb(settings: section.GolombLayout) -> np.ndarray:
    return np.column_stack([settings.spacing * np.array(GOLOMB_MARKS[settings.count]), np.zeros(settings.count)])


def _rectangular(settings: section.RectangularLayout) -> np.ndarray:
    row, column = np.divmod(np.arange(settings.count), ROW_LENGTH)
    east = settings.spacing * column
    first, second = np.triu_indices(settings.count, 1)
    rows_apart = np.abs(row[first] - row[second])
    across = np.abs(east[first] - east[second])[rows_apart > 0]
    # The widest row distance at which no pair of antennas in different rows is farther apart than the limit.
    distance = np.min(np.sqrt(settings.max_baseline**2 - across**2) / rows_apart[rows_apart > 0])
    return np.column_stack([east, distance * row])


SYNTHETIC: dict[str, Callable[[Any], np.ndarray]] = {
    "hex": _hex,
    "linear": _linear,
    "rectangular": _rectangular,
    "golomb": _golomb,
}


def _from_csv(path: Path) -> Layout:
    """Positions, and names and numbers where given, from a CSV file."""
    if not path.is_file():
        raise InputError(f"instrument.layout.path: there is no file {path}")
    try:
        with path.open(newline="", encoding="utf-8-sig") as table:
            rows = list(csv.DictReader(table))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"instrument.layout.path: {path} is not a CSV file in UTF-8 ({error})") from None
    uneven = next((line for line, row in enumerate(rows, 2) if None in row or None in row.values()), None)
    if uneven is not None:
        raise InputError(f"instrument.layout.path: row {uneven} of {path} has more or fewer cells than the first")
    columns = set(rows[0]) if rows else set()
    missing = {"east_m", "north_m", "up_m"} - columns
    if missing or len(rows) < 2:
        raise InputError(
            f"instrument.layout.path: {path} needs at least two rows with columns east_m, north_m, up_m"
            + (f"; missing: {', '.join(sorted(missing))}" if missing else "")
        )
    try:
        enu = np.array([[float(row[f"{axis}_m"]) for axis in ("east", "north", "up")] for row in rows])
        numbers = np.array([int(row["number"]) for row in rows]) if "number" in columns else np.arange(len(rows))
    except (TypeError, ValueError) as error:
        raise InputError(f"instrument.layout.path: {path} holds an entry that is not a number ({error})") from None
    names = tuple(row["name"] for row in rows) if "name" in columns else tuple(f"ant{n:03d}" for n in numbers)
    if len(set(numbers)) < len(rows) or len(set(names)) < len(rows) or numbers.min() < 0:
        raise InputError(f"instrument.layout.path: antenna numbers (>= 0) and names in {path} must be unique")
    if not np.isfinite(enu).all():
        raise InputError(f"instrument.layout.path: positions in {path} must be finite")
    same = np.triu((enu[:, None] == enu).all(axis=2), 1)
    if same.any():
        first, second = np.argwhere(same)[0]
        raise InputError(
            f"instrument.layout.path: antennas {names[first]!r} and {names[second]!r} in {path} are in the same place: "
            "a baseline of length zero"
        )
    return Layout(path.stem, numbers, names, enu, SITES["mwa"])
