"""Tiles of the MWA, from the surveyed positions that pyuvdata carries."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from calstudy.base.package_files import PackageFile
from calstudy.instrument.layouts import Layout, NamedLayout
from calstudy.instrument.sites import SITES, east_north_up


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


class MwaLayout(NamedLayout):
    """Tiles of the MWA: Phase II compact (paper §Simulations), Phase II extended, or Phase I (Wayth et al. 2018).

    The first 36 tiles of the core, one of the two 36-tile hexagons, or all 128 tiles of a configuration. Tiles are
    numbered by their place in the 128-tile configuration, also in layouts that use a part of it.
    """

    sizes: ClassVar[Mapping[str, int]] = {name: len(tiles) for name, tiles in MWA_TILES.items()}

    def make(self) -> Layout:
        """Return the tiles, at positions (ECEF relative to the array centre) of the observatory."""
        with MWA_POSITIONS.path.open() as table:
            relative = {row["names"]: [float(row[axis]) for axis in "xyz"] for row in csv.DictReader(table)}
        whole = next(tiles for tiles in MWA_CONFIGURATIONS if set(tiles) >= set(MWA_TILES[self.kind]))
        tiles = MWA_TILES[self.kind][: self.count]
        place = SITES["mwa"]
        enu = east_north_up(np.array([relative[tile] for tile in whole]), place)
        # The table's heights are above the ellipsoid, not the array centre (+377.83 m in all of them).
        enu[:, 2] -= enu[:, 2].mean()
        numbers = np.array([whole.index(tile) for tile in tiles])
        return Layout(self.kind, numbers, tiles, enu[numbers], place)
