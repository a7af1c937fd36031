"""Directions of the components of a sky model against time, and which of them rise or set."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from pyradiosky import SkyModel

from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.simulate.nodes import (
    EARTH_ROTATION_RATE,
    SECONDS_PER_DAY,
    chebyshev_count,
    chebyshev_nodes,
    interpolation_matrix,
)

# A direction is a unit vector turning with the Earth: this error is its rounding.
DIRECTION_TOLERANCE = 1e-15

# A source this near the horizon may rise or set between two of the times looked at (rad).
HORIZON_MARGIN = 1e-6


class SourceTracks:
    """Direction of every component at any time within a span.

    The transformation is astropy's, the one pyuvsim uses, at a few Chebyshev times; directions in between are the
    interpolating polynomial, equal to rounding.

    Parameters
    ----------
    sky
        Components in any celestial frame; not changed.
    location
        Of the array.
    times_jd : (Ntimes,) float
        Julian dates (UTC) at which directions will be asked for.
    """

    def __init__(self, sky: SkyModel, location: EarthLocation, times_jd: np.ndarray) -> None:
        use_bundled_earth_orientation()
        bandwidth = EARTH_ROTATION_RATE * SECONDS_PER_DAY * np.ptp(times_jd) / 2
        count = chebyshev_count(bandwidth, DIRECTION_TOLERANCE)
        distinct = np.unique(times_jd)
        nodes = distinct if count >= len(distinct) else chebyshev_nodes(distinct[0], distinct[-1], count)
        self._nodes = nodes
        coordinates = sky_coordinates(sky)
        self._vectors = np.stack([_enu(coordinates, location, time) for time in nodes])

    def at(self, time_jd: float, components: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return unit vectors towards the components in east, north, up, (3, Ncomponents)."""
        weights = interpolation_matrix(self._nodes, np.array([time_jd]))[0]
        return np.tensordot(weights, self._vectors[:, :, components], axes=1)


def sky_coordinates(sky: SkyModel) -> SkyCoord:
    """Return where the components are, (Ncomponents,): points, or centres of HEALPix pixels, in the sky's own frame."""
    if sky.component_type == "point":
        return sky.skycoord
    return SkyCoord(*sky.get_lon_lat(), frame=sky.hpx_frame)


def _enu(coordinates: SkyCoord, location: EarthLocation, time_jd: float) -> np.ndarray:
    time = Time(time_jd, format="jd", scale="utc", location=location)
    local = coordinates.transform_to(AltAz(obstime=time, location=location))
    altitude, azimuth = local.alt.rad, local.az.rad
    return np.stack([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def split_by_horizon(sky: SkyModel, location: EarthLocation, times_jd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the components that stay above the horizon, and of those that rise or set.

    Parameters
    ----------
    sky
        Not changed.
    location
        Of the array.
    times_jd : (Ntimes,) float
        All times that will be simulated or interpolated to.

    Returns
    -------
    always_up : (N,) int
        Above the horizon at every time.
    crossing : (M,) int
        Above it at some times only, or so close to it that they might be.
    """
    tracks = SourceTracks(sky, location, times_jd)
    lowest = np.full(sky.Ncomponents, np.inf)
    highest = -lowest
    for time in np.unique(times_jd):
        height = tracks.at(time)[2]
        np.minimum(lowest, height, out=lowest)
        np.maximum(highest, height, out=highest)
    always_up = lowest > HORIZON_MARGIN
    crossing = (highest > -HORIZON_MARGIN) & ~always_up
    return np.flatnonzero(always_up), np.flatnonzero(crossing)
