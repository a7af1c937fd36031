"""Sites of arrays on the Earth."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from calstudy.instrument.settings import Coordinates, Site

if TYPE_CHECKING:
    from astropy.coordinates import EarthLocation


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
