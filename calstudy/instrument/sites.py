"""Where arrays are on the Earth."""

from __future__ import annotations

import numpy as np
from astropy import units
from astropy.coordinates import EarthLocation

from calstudy.instrument.settings import Coordinates, Site


def _at(latitude: float, longitude: float, height: float) -> EarthLocation:
    return EarthLocation.from_geodetic(lon=longitude * units.deg, lat=latitude * units.deg, height=height * units.m)


# Given here because astropy looks up sites online. The MWA's is the array centre in the observatory's metafits files,
# HERA's that of the project's own database (hera_mc); these and the others are also in pyuvdata's table of telescopes.
SITES = {
    "mwa": _at(-26.70331941, 116.67081524, 377.827),
    "hera": _at(-30.72152612068925, 21.42830382686301, 1051.69),
    "paper": _at(-30.721527777777778, 21.428305555555557, 1073.0),
    "ovro-lwa": _at(37.239777271, -118.281666695, 1183.48),
}


def earth_location(site: Site | Coordinates) -> EarthLocation:
    """Return a place that an experiment file names or gives by its coordinates.

    Parameters
    ----------
    site
        Name of a known site, or latitude and longitude (deg) and height (m) on the WGS84 ellipsoid.
    """
    if isinstance(site, Site):
        return SITES[site.kind]
    return _at(site.latitude, site.longitude, site.height)


def east_north_up(vectors: np.ndarray, place: EarthLocation) -> np.ndarray:
    """Return geocentric vectors (N, 3) by their components to the east, the north and up at a place.

    `pyuvdata.utils.ENU_from_ECEF` does the same; importing it takes a second, a fifth of the time of a plan.
    """
    longitude, latitude = place.lon.rad, place.lat.rad
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    return vectors @ np.array([east, np.cross(up, east), up]).T


def describe(site: Site | Coordinates) -> str:
    """Return in words where a site is: its name if it has one, latitude, longitude and height."""
    place = earth_location(site).geodetic
    name = "" if isinstance(site, Coordinates) else f"{site.kind}, "
    height = place.height.to_value("m")
    return f"{name}latitude {place.lat.deg:.4f} deg, longitude {place.lon.deg:.4f} deg, {height:.0f} m"
