"""HERA as designed, and tiles of the MWA from the surveyed positions that pyuvdata carries.

HERA has a core in three displaced sectors, and outriggers (Dillon & Parsons 2016). The core is a hexagonal lattice cut
into three rhombi, 11 x 10, 10 x 10 and 11 x 10 antennas. The eastern and the northern rhombus are displaced by vectors
that join a lattice point to the centre of a triangle of the lattice, so that baselines between sectors fill the gaps
between those within a sector. The outriggers are on a hexagonal lattice of ten times the spacing and displaced
likewise. Its positions here are in units of the spacing in the lattice basis (1, 0), (1/2, sqrt(3)/2), about the
south-western antenna, number 0.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import ClassVar

import numpy as np

from calstudy.base.package_files import PackageFile
from calstudy.instrument.array_layouts.geometric import hexagon
from calstudy.instrument.layouts import SITES, Layout, NamedLayout, east_north_up

SPACING = 14.6
SIDES = {"hera-19": 3, "hera-37": 4}
LATTICE = SPACING * np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2]])
"""East and north of the two basis vectors, m."""

LONG_ROW, SHORT_ROW = 11, 10
EAST_CORNER = np.array([32, 2]) / 3
NORTH_CORNER = np.array([-29, 31]) / 3

OUTRIGGER_STEP = 10
OUTRIGGER_SIDE = 4
OUTRIGGER_CENTRE = np.array([2.0, 7.0])
# Displacements of the outriggers in the eastern and the northern third, a third of the unit cell's long diagonal.
EAST_SHIFT = np.array([-1, 2]) / 3
NORTH_SHIFT = np.array([1, -2]) / 3


def core_positions() -> np.ndarray:
    """Return east and north of the 320 antennas of the core in the order of their numbers, (320, 2), m.

    Numbers run from the south: a row of the western sectors, then the adjacent row of the eastern sector.
    """
    column, steps = np.arange(LONG_ROW), range(SHORT_ROW)
    western = [np.column_stack([column - step, np.full(LONG_ROW, step)]) for step in steps]
    western += [NORTH_CORNER + np.column_stack([column, np.full(LONG_ROW, step)]) for step in steps]
    rhombus = EAST_CORNER + np.array([(-i, i + j) for i in steps for j in steps])
    heights = np.round(rhombus[:, 1], 6)
    eastern = [rhombus[heights == height][::-1] for height in np.unique(heights)]
    return np.concatenate([western[0], *chain(*zip(western[1:], eastern, strict=True))]) @ LATTICE


def outrigger_positions() -> np.ndarray:
    """Return east and north of the 30 outriggers in the order of their numbers, from 320, (30, 2), m."""
    found = []
    for row in range(1 - OUTRIGGER_SIDE, OUTRIGGER_SIDE):
        for column in range(2 * OUTRIGGER_SIDE - 1 - abs(row)):
            offset = np.array([column - (OUTRIGGER_SIDE - 1) - min(row, 0), row])
            # The core occupies the innermost seven places.
            if max(abs(offset[0]), abs(offset[1]), abs(offset.sum())) > 1:
                found.append(OUTRIGGER_CENTRE + OUTRIGGER_STEP * offset + _displacement(offset))
    return np.array(found) @ LATTICE


def _displacement(offset: np.ndarray) -> np.ndarray:
    """Return the displacement of the outriggers in the sector of this offset from the centre."""
    east, north = offset @ LATTICE
    angle = round(float(np.degrees(np.arctan2(north, east))), 6)
    if -120 < angle <= 0:
        return EAST_SHIFT
    return NORTH_SHIFT if 0 < angle <= 120 else np.zeros(2)


class HeraLayout(NamedLayout):
    """HERA at its own site: antennas 14.6 m apart, flat, as designed (DeBoer et al. 2017; Dillon & Parsons 2016).

    `hera-19` and `hera-37` are filled hexagons. `hera-320` is the core, a hexagon in three sectors that are displaced
    against each other by a third of the unit cell; `hera-350` has the 30 outriggers as well. `hera-128` is the first
    128 antennas of the core. Antennas of the last three are numbered as HERA numbers them, from the south.
    """

    site: ClassVar[str | None] = "hera"
    regular: ClassVar[bool] = True
    sizes: ClassVar[Mapping[str, int]] = {
        "hera-19": 19,
        "hera-37": 37,
        "hera-128": 128,
        "hera-320": 320,
        "hera-350": 350,
    }

    def make(self) -> Layout:
        """Return the antennas in the order of their numbers."""
        if self.kind in SIDES:
            positions = SPACING * hexagon(SIDES[self.kind])
        else:
            positions = np.concatenate([core_positions(), outrigger_positions()])[: self.sizes[self.kind]]
        return self.flat(positions[: self.count], prefix="HH")


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


@cache
def _mwa_positions() -> Mapping[str, Sequence[float]]:
    """Return the position of each tile by its name (ECEF relative to the array centre, m)."""
    with MWA_POSITIONS.path.open() as table:
        return {row["names"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(table)}


class MwaLayout(NamedLayout):
    """Tiles of the MWA: Phase II compact (paper §Simulations), Phase II extended, or Phase I (Wayth et al. 2018).

    The first 36 tiles of the core, one of the two 36-tile hexagons, or all 128 tiles of a configuration. Tiles are
    numbered by their place in the 128-tile configuration, also in layouts that use a part of it.
    """

    sizes: ClassVar[Mapping[str, int]] = {name: len(tiles) for name, tiles in MWA_TILES.items()}

    def make(self) -> Layout:
        """Return the tiles, at positions (ECEF relative to the array centre) of the observatory."""
        relative = _mwa_positions()
        whole = next(tiles for tiles in MWA_CONFIGURATIONS if set(tiles) >= set(MWA_TILES[self.kind]))
        tiles = MWA_TILES[self.kind][: self.count]
        place = SITES["mwa"]
        enu = east_north_up(np.array([relative[tile] for tile in whole]), place)
        # The table's heights are above the ellipsoid, not the array centre (+377.83 m in all of them).
        enu[:, 2] -= enu[:, 2].mean()
        numbers = np.array([whole.index(tile) for tile in tiles])
        return Layout(self.kind, numbers, tiles, enu[numbers], place)
