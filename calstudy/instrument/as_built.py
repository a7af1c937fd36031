"""The antennas as built: differences between the true and the nominal instrument, by antenna.

Simulations use the instrument as built. Data files, calibrators and figures use the nominal one. Draws are scaled
by their scatter or compared with their fraction, so that a seed gives the same pattern of errors at every severity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.errors import InputError
from calstudy.base.schema import REVISED, Section, fault
from calstudy.base.units import Angle, Fraction, Length

DIPOLES = 16
FEEDS = ("x", "y")

Antennas = tuple[Annotated[int, Field(ge=0)], ...]
Dipoles = tuple[Annotated[int, Field(ge=0, lt=DIPOLES)], ...]


class PositionErrors(Section):
    """True less nominal positions of antennas."""

    scatter: Length = Field(
        0.0,
        ge=0,
        description="Standard deviation in each of east, north and up, independent for each antenna; 0, the default, "
        "is as designed.",
    )
    seed: int = Field(7, ge=0, description="Seed of the positions.")


class DeadDipoles(Section):
    """Tiles with the same dead dipoles, counted from 0: along rows from the north-western corner."""

    antennas: Annotated[Antennas, Field(min_length=1)] = Field(
        description="Antennas, counted from 0 in the order of the layout."
    )
    x: Dipoles = Field((), description="Dead dipoles of feed x (east-west).")
    y: Dipoles = Field((), description="Dead dipoles of feed y (north-south).")


class DipoleErrors(Section):
    """Amplitudes of the 16 dipoles of MWA tiles, nominally one, for the beam `mwa-embedded-element`.

    The beam of a tile is computed from its dipoles with their mutual coupling, and is one at the zenith like all beams
    here: a loss at the zenith is a gain error, and gains are effects.
    """

    dead_fraction: Fraction = Field(
        0.0, ge=0, lt=1, description="Probability that a dipole is dead, for each dipole and feed; such as 15 %."
    )
    dead_tiles: Fraction = Field(
        0.0,
        ge=0,
        le=1,
        description="Fraction of tiles with one dead dipole, in either feed (Joseph et al. 2020: 15 to 40 %).",
    )
    amplitude_scatter: Fraction = Field(
        0.0, ge=0, lt=1, description="Standard deviation of the amplitudes of dipoles that are not dead."
    )
    dead: dict[str, DeadDipoles] = Field(
        default_factory=dict, description="Tiles whose dead dipoles are given, in sets with any names."
    )
    seed: int = Field(8, ge=0, description="Seed of dead dipoles and amplitudes.")

    @property
    def differ(self) -> bool:
        """Whether a dipole differs from the nominal one."""
        return bool(self.dead_fraction or self.dead_tiles or self.amplitude_scatter or self.dead)


class BeamErrors(Section):
    """True less nominal orientation and width of the beams of antennas, of any kind of beam.

    An antenna is rotated as a whole, with its polarization.
    """

    pointing_scatter: Angle = Field(
        0.0,
        ge=0,
        lt=45,
        description="Standard deviation of the tilt of an antenna towards east, and towards north; 0, the default, "
        "is as designed.",
    )
    rotation_scatter: Angle = Field(
        0.0,
        ge=0,
        lt=45,
        description="Standard deviation of the rotation of an antenna about the vertical; 0, the default, "
        "is as designed.",
    )
    width_scatter: Fraction = Field(
        0.0,
        ge=0,
        lt=0.3,
        description="Standard deviation of the width over the nominal width, such as 2 %; 0, the default, "
        "is as designed.",
    )
    swapped: Antennas = Field((), description="Antennas whose feeds x and y are connected to each other's place.")
    seed: int = Field(9, ge=0, description="Seed of tilts, rotations and widths.")

    @model_validator(mode="after")
    def _antennas_are_unique(self) -> BeamErrors:
        if len(set(self.swapped)) != len(self.swapped):
            raise fault("swapped", "names an antenna twice")
        return self


class AsBuilt(Section):
    """True less nominal instrument: it is simulated, but calibrators do not know it."""

    positions: PositionErrors = PositionErrors()
    dipoles: DipoleErrors = Field(DipoleErrors(), json_schema_extra={REVISED: 2})
    beams: BeamErrors = Field(BeamErrors(), json_schema_extra={REVISED: 2})

    @property
    def drawn_seeds(self) -> dict[str, int]:
        """The seeds that are used, by block; those of dipoles are left out, because their generators are spawned."""
        beams = self.beams
        drawn = {
            "positions": self.positions.scatter > 0,
            "beams": max(beams.pointing_scatter, beams.rotation_scatter, beams.width_scatter) > 0,
        }
        return {name: getattr(self, name).seed for name, is_drawn in drawn.items() if is_drawn}

    @property
    def note(self) -> str | None:
        """A description of the differences from the nominal instrument, or None."""
        dipoles, beams = self.dipoles, self.beams
        found = (
            ("positions", 100 * self.positions.scatter, " cm"),
            ("dead dipoles", 100 * dipoles.dead_fraction, " %"),
            ("tiles with a dead dipole", 100 * dipoles.dead_tiles, " %"),
            ("tiles with given dead dipoles", sum(len(group.antennas) for group in dipoles.dead.values()), ""),
            ("dipole amplitudes", 100 * dipoles.amplitude_scatter, " %"),
            ("pointing", beams.pointing_scatter, " deg"),
            ("rotation", beams.rotation_scatter, " deg"),
            ("beam widths", 100 * beams.width_scatter, " %"),
            ("swapped feeds", len(beams.swapped), ""),
        )
        words = [f"{name} {value:g}{unit}" for name, value, unit in found if value]
        return f"as built: {', '.join(words)}" if words else None


COLUMNS = (
    *("east_m", "north_m", "up_m", "dipoles_x", "dipoles_y"),
    *("tilt_east_deg", "tilt_north_deg", "rotation_deg", "width", "swapped"),
)
"""Columns of `as_built_rows`."""


@dataclass(frozen=True)
class Misalignment:
    """Orientation and width of the beam of one antenna.

    `east` and `north` are the tilts of the antenna's axis towards east and north, and `rotation` is about the vertical
    from east towards north, rad. `width` is relative to the nominal width.
    """

    east: float = 0.0
    north: float = 0.0
    rotation: float = 0.0
    width: float = 1.0
    swapped: bool = False


def position_offsets(settings: PositionErrors, count: int) -> np.ndarray:
    """Return true less nominal positions of `count` antennas: east, north, up in m, (count, 3)."""
    return settings.scatter * np.random.default_rng(settings.seed).standard_normal((count, 3))


def dipole_amplitudes(settings: DipoleErrors, count: int) -> np.ndarray:
    """Return the amplitudes of the dipoles of `count` tiles, (count, 2 [x, y], 16), zero where dead.

    Raises InputError if all dipoles of a feed are dead.
    """
    draws = np.random.default_rng(settings.seed).spawn(4)
    shape = (count, len(FEEDS), DIPOLES)
    amplitudes = np.maximum(1 + settings.amplitude_scatter * draws[0].standard_normal(shape), 0)
    amplitudes[draws[1].uniform(size=shape) < settings.dead_fraction] = 0
    tiles = np.argsort(draws[2].uniform(size=count))[: round(settings.dead_tiles * count)]
    feeds, dipoles = np.divmod(draws[3].integers(len(FEEDS) * DIPOLES, size=count), DIPOLES)
    amplitudes[tiles, feeds[tiles], dipoles[tiles]] = 0
    for group in settings.dead.values():
        for feed, listed in enumerate((group.x, group.y)):
            amplitudes[np.ix_(group.antennas, [feed], listed)] = 0
    silent = np.argwhere(~amplitudes.any(axis=2))
    if len(silent):
        antenna, feed = silent[0]
        raise InputError(
            f"instrument.as_built.dipoles: all dipoles of feed {FEEDS[feed]} of antenna {antenna} are dead"
        )
    return amplitudes


def misalignments(settings: BeamErrors, count: int) -> list[Misalignment]:
    """Return orientation and width of the beams of `count` antennas."""
    draws = np.random.default_rng(settings.seed).standard_normal((count, 4))
    tilts = np.radians(settings.pointing_scatter) * draws[:, :2]
    rotations = np.radians(settings.rotation_scatter) * draws[:, 2]
    # Widths are at least a tenth of the nominal one for any draw.
    widths = np.maximum(1 + settings.width_scatter * draws[:, 3], 0.1)
    return [
        Misalignment(float(east), float(north), float(rotation), float(width), antenna in settings.swapped)
        for antenna, ((east, north), rotation, width) in enumerate(zip(tilts, rotations, widths, strict=True))
    ]


def as_built_rows(settings: AsBuilt, count: int) -> list[tuple[str, ...]]:
    """Return the differences of `count` antennas from the nominal instrument, as texts in the order of `COLUMNS`.

    Dipoles are 16 amplitudes, nominally one and zero where dead; the width is relative to the nominal one.
    """
    offsets = position_offsets(settings.positions, count)
    amplitudes = dipole_amplitudes(settings.dipoles, count)
    return [
        (
            *(f"{value:.6f}" for value in offset),
            *(" ".join(f"{value:g}" for value in np.round(feed, 6)) for feed in dipoles),
            *(f"{np.degrees(angle):.6f}" for angle in (beam.east, beam.north, beam.rotation)),
            f"{beam.width:.6f}",
            str(beam.swapped).lower(),
        )
        for offset, dipoles, beam in zip(offsets, amplitudes, misalignments(settings.beams, count), strict=True)
    ]
