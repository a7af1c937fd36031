"""Layouts of arrays: sites, the interface of a layout, the positions that it makes, redundancy of baselines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self, cast

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.errors import InputError
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.plugins import Plugin, guarded
from calstudy.base.schema import fault
from calstudy.instrument.settings import LAYOUTS, Coordinates, InstrumentSettings, Site, Size

if TYPE_CHECKING:
    from astropy.coordinates import EarthLocation


FARTHEST, SMALLEST = 3e6, 1.0
"""Largest coordinate of an antenna, which geocentric ones exceed, and smallest width of three antennas or more, m."""
RESOLVED = 1e-3
"""Grid, m, on which no two antennas are at the same place."""
NEARBY = 1.0
"""deg, by which a site may differ from the mean of the positions of its antennas."""


class Place(NamedTuple):
    """A place on the WGS84 ellipsoid: latitude and longitude in deg, north and east positive, and height in m."""

    latitude: float
    longitude: float
    height: float

    @property
    def location(self) -> EarthLocation:
        """The place as an astropy `EarthLocation`."""
        from astropy.coordinates import EarthLocation

        return EarthLocation.from_geodetic(lon=self.longitude, lat=self.latitude, height=self.height)


# Listed here because astropy looks up sites online. The MWA's is the array centre in the observatory's metafits files,
# HERA's that of the project's own database (hera_mc); these and the others are also in pyuvdata's table of telescopes.
SITES = {
    "mwa": Place(-26.70331941, 116.67081524, 377.827),
    "hera": Place(-30.72152612068925, 21.42830382686301, 1051.69),
    "paper": Place(-30.721527777777778, 21.428305555555557, 1073.0),
    "ovro-lwa": Place(37.239777271, -118.281666695, 1183.48),
}


def place_of(site: Site | Coordinates) -> Place:
    """Return the place of a known site, or of coordinates in an experiment file."""
    if isinstance(site, Site):
        return SITES[site.kind]
    # The same place, whether its longitude counts to 180 or to 360 degrees.
    longitude = round(site.longitude - 360, 9) if site.longitude >= 180 else site.longitude
    return Place(site.latitude, longitude, site.height)


def east_north_up(vectors: np.ndarray, place: Place) -> np.ndarray:
    """Return the components of geocentric vectors (N, 3) to the east, to the north and up at a place.

    `pyuvdata.utils.ENU_from_ECEF` does the same, but importing it is slow compared with a plan.
    """
    longitude, latitude = np.radians(place.longitude), np.radians(place.latitude)
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    return vectors @ np.array([east, np.cross(up, east), up]).T


def describe(site: Site | Coordinates) -> str:
    """Describe a site: its name if it has one, latitude, longitude and height."""
    place = place_of(site)
    name = "" if isinstance(site, Coordinates) else f"{site.kind}, "
    return f"{name}latitude {place.latitude:.4f} deg, longitude {place.longitude:.4f} deg, {place.height:.0f} m"


@dataclass(frozen=True)
class Layout:
    """Positions of the antennas of an array: east, north, up in metres about the array centre, (Nants, 3).

    Antenna numbers, (Nants,), and names are unique. The number of an MWA tile is its index in the 128-tile
    configuration, also in layouts that use a part of it. `place` is the site: the centre of the array, for arrays at
    their own site. `surveyed` is true if it is that of positions in latitude and longitude.
    """

    name: str
    numbers: np.ndarray
    names: tuple[str, ...]
    enu: np.ndarray
    place: Place
    surveyed: bool = False

    @property
    def location(self) -> EarthLocation:
        """The site of the array as an astropy `EarthLocation`."""
        return self.place.location


class ArrayLayout(Plugin, ABC):
    """The settings of a layout, from which positions are made. Fields of a subclass are its settings.

    `site` is the name of the site of the array unless `instrument.location` gives another; None if it must. `regular`
    is whether antennas are on a flat lattice, which fast simulations use.
    """

    registry: ClassVar = LAYOUTS
    site: ClassVar[str | None] = "mwa"
    regular: ClassVar[bool] = False

    kind: str = Field("", description="Name of a layout, or a file.py.")

    @property
    def origin(self) -> str:
        """The field and name of the layout in messages."""
        return f"instrument.layout: {self.label}"

    @abstractmethod
    def make(self) -> Layout:
        """Return the antennas; raises InputError if an input file is missing or does not hold positions."""

    def flat(self, positions: np.ndarray, prefix: str | None = None) -> Layout:
        """Return a flat array about the mean of positions, east and north in m, (Nants, 2).

        Antennas are numbered from 0. Their names are a prefix, by default the label of the layout, and the number.
        """
        enu = np.column_stack([positions - positions.mean(axis=0), np.zeros(len(positions))])
        numbers = np.arange(len(enu))
        names = tuple(f"{prefix or self.label}{number:03d}" for number in numbers)
        return Layout(self.label, numbers, names, enu, SITES[self.site or "mwa"])


class NamedLayout(ArrayLayout):
    """Antennas of an array that exists, or the first of them. `sizes` has the number of antennas of each kind."""

    sizes: ClassVar[Mapping[str, int]]

    count: int | None = Field(None, ge=2, description="Keep only the first `count` antennas (all by default).")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the kinds."""
        return tuple(cls.sizes)

    @model_validator(mode="after")
    def _enough_antennas(self) -> Self:
        size = self.sizes[self.kind]
        if self.count is not None and self.count > size:
            raise fault("count", f"{self.count} is more than the {size} antennas of {self.kind}")
        return self


@dataclass(frozen=True)
class RedundantGroups:
    """The redundant group of each baseline, (Nbls,), numbered by first baseline, and whether it is conjugated, (Nbls,).

    A baseline that is opposite to the first one of its group has the complex conjugate of the group's visibility.
    """

    index: np.ndarray
    conjugated: np.ndarray

    @property
    def redundant_fraction(self) -> float:
        """Part of the baselines that have a redundant partner."""
        return float(np.mean(np.bincount(self.index)[self.index] > 1))


def layout_of(section: Plugin) -> ArrayLayout:
    """Return the value of a layout field as an `ArrayLayout`; its registry admits no other plug-ins."""
    return cast(ArrayLayout, section)


def make_layout(settings: Plugin) -> Layout:
    """Return the antennas of the `instrument.layout` section.

    Raises InputError if a file is missing, or a layout does not hold what `Layout` says or differs from call to call.
    """
    layout = layout_of(settings)
    with guarded(layout):
        made = layout.make()
        again = made if layout.is_built_in else layout.make()
    for one in (made, again):
        if not isinstance(one, Layout):
            raise InputError(
                f"{layout.origin}: make returned {one!r}; a Layout is needed, such as self.flat(positions)"
            )
    require_valid(made, layout.origin)
    if not all(np.array_equal(getattr(made, name), getattr(again, name)) for name in ("numbers", "names", "enu")):
        raise InputError(
            f"{layout.origin}: make gives other antennas at every call, and each product would be of another array; "
            "draw them with a seed that is a field"
        )
    return made


def require_valid(made: Layout, origin: str) -> None:
    """Raise InputError, with where the antennas are from, unless they are what `Layout` says."""
    shape, count = np.shape(made.enu), len(made.numbers)
    if shape != (count, 3) or len(made.names) != count or count < 2:
        raise InputError(
            f"{origin} has {count} numbers, {len(made.names)} names and positions of shape {shape}; at least two "
            "antennas are needed, each with a number, a name and east, north, up"
        )
    kinds = [getattr(getattr(values, "dtype", None), "kind", "") for values in (made.numbers, made.enu)]
    if kinds[0] not in ("i", "u") or kinds[1] not in ("i", "u", "f"):
        raise InputError(f"{origin}: numbers must be an array of integers, and enu one of real numbers")
    numbers, names = made.numbers.tolist(), list(made.names)
    twice = [value for found in (numbers, names) for value, times in Counter(found).items() if times > 1]
    if bad := [number for number in numbers if number < 0] + twice:
        raise InputError(f"{origin}: antenna numbers (>= 0) and names must be unique; see '{bad[0]}'")
    if not np.isfinite(made.enu).all():
        raise InputError(f"{origin}: positions must be finite")
    width = np.ptp(made.enu, axis=0).max()
    if np.abs(made.enu).max() > FARTHEST or (count > 2 and 0 < width < SMALLEST):
        raise InputError(
            f"{origin}: antennas are up to {np.abs(made.enu).max():.4g} m from the origin, and the array is "
            f"{width:.4g} m wide; give east, north and up of a place in the array, in metres, "
            "not in kilometres or from the centre of the Earth"
        )
    if "" in names:
        raise InputError(f"{origin}: antenna {numbers[names.index('')]} has an empty name")
    places = np.round(made.enu / RESOLVED)
    order = np.lexsort(places.T)
    same = np.flatnonzero((np.diff(places[order], axis=0) == 0).all(axis=1))
    if same.size:
        first, second = sorted(order[same[0] : same[0] + 2])
        raise InputError(
            f"{origin}: antennas {made.names[first]!r} and {made.names[second]!r} are in the same place: a baseline of "
            "length zero"
        )


def make_array(settings: InstrumentSettings) -> Layout:
    """Return the antennas of an instrument, at `instrument.location` or at the layout's own site.

    Raises InputError as `make_layout`, or if the site is not that of positions in latitude and longitude.
    """
    found, place = make_layout(settings.layout), place_of(settings.site)
    if found.surveyed:
        apart = np.array(found.place[:2]) - place[:2]
        apart[1] = (apart[1] + 180) % 360 - 180
        if np.abs(apart).max() > NEARBY:
            raise InputError(
                f"instrument.location: is at {place.latitude:.2f}, {place.longitude:.2f} deg, and {found.name} at "
                f"{found.place.latitude:.2f}, {found.place.longitude:.2f} deg; give the place of the array, and degrees"
            )
    return replace(found, place=place)


def redundant_groups(vectors: np.ndarray, tolerance: float) -> RedundantGroups:
    """Sort baseline vectors, (Nbls, 3), m, into groups that agree to a tolerance in m.

    A baseline and its reverse are in the same group. The arrays of the result cannot be changed.
    """
    return _redundant_groups(np.asarray(vectors, dtype=float).tobytes(), tolerance)


# All members of a comparison, and all passes of a calibration, have the same baselines.
@lru_cache(maxsize=32)
def _redundant_groups(content: bytes, tolerance: float) -> RedundantGroups:
    from pyuvdata.utils import redundancy

    vectors = np.frombuffer(content).reshape(-1, 3)
    groups, _, _, _ = redundancy.get_baseline_redundancies(
        np.arange(len(vectors)), vectors, tol=tolerance, include_conjugates=True
    )
    index = np.empty(len(vectors), dtype=int)
    conjugated = np.zeros(len(vectors), dtype=bool)
    for number, members in enumerate(sorted((np.sort(group) for group in groups), key=lambda group: group[0])):
        index[members] = number
        conjugated[members] = vectors[members] @ vectors[members[0]] < 0
    for values in (index, conjugated):
        values.flags.writeable = False
    return RedundantGroups(index, conjugated)


def _extent(layout: Plugin) -> tuple[int, float, float]:
    """Return the number of antennas, and the longest and the mean baseline (m)."""
    return _extent_of(layout, digest_json(identity(layout)))


@lru_cache(maxsize=256)
def _extent_of(layout: Plugin, content: str) -> tuple[int, float, float]:
    """Return the extent of a layout; `content` is a digest that changes with its files."""
    del content
    enu = make_layout(layout).enu
    first, second = np.triu_indices(len(enu), 1)
    lengths = np.linalg.norm(enu[first] - enu[second], axis=1)
    return len(enu), float(lengths.max()), float(lengths.mean())


def size_of_instrument(instrument: InstrumentSettings) -> Size:
    """Return the size of an instrument's data."""
    antennas, longest, mean = _extent(instrument.layout)
    return Size(
        antennas=antennas,
        times=instrument.times.count,
        channels=instrument.channels,
        polarizations=len(instrument.polarizations),
        longest=longest,
        mean=mean,
    )


def antenna_count(layout: Plugin) -> int:
    """Return the number of antennas of a layout. Raises InputError as `make_layout`."""
    return _extent(layout)[0]
