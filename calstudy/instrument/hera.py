"""The antennas of HERA as designed: a core in three displaced sectors, and outriggers (Dillon & Parsons 2016).

The core is a hexagonal lattice cut into three rhombi, 11 x 10, 10 x 10 and 11 x 10 antennas. The eastern and the
northern rhombus are displaced by vectors that join a lattice point to the centre of a triangle of the lattice, so that
baselines between sectors fill the gaps between those within a sector. The outriggers are on a hexagonal lattice of ten
times the spacing and displaced likewise. Positions here are in units of the spacing in the lattice basis
(1, 0), (1/2, sqrt(3)/2), about the south-western antenna, number 0.
"""

from __future__ import annotations

import numpy as np

SPACING = 14.6
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
    column, row = np.arange(LONG_ROW), np.arange(SHORT_ROW)
    south = [np.column_stack([column - step, np.full(LONG_ROW, step)]) for step in row]
    north = [NORTH_CORNER + np.column_stack([column, np.full(LONG_ROW, step)]) for step in row]
    rhombus = [EAST_CORNER + np.array([-i, i + j]) for i in row for j in row]
    east: dict[float, list[np.ndarray]] = {}
    for position in rhombus:
        east.setdefault(round(position[1], 6), []).append(position)
    eastern = [np.array(sorted(row, key=lambda position: position[0])) for _, row in sorted(east.items())]
    western = south + north
    rows = [western[0]]
    for west_row, east_row in zip(western[1:], eastern, strict=True):
        rows += [west_row, east_row]
    return np.concatenate(rows) @ LATTICE


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
