"""Components of a sky model: flux densities for all spectral types and units, and directions as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import healpy
import numpy as np
from astropy import units
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy_healpix import nside_to_pixel_area
from pyradiosky import SkyModel
from pyradiosky.utils import jy_to_ksr

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.visibilities import use_bundled_earth_orientation
from calstudy.simulate.nodes import EARTH_ROTATION_RATE, chebyshev_count, chebyshev_nodes, interpolation_matrix
from calstudy.sky.spectra import at_frequencies


def stokes_i(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return Stokes I of a sky in Jy, (Nfreqs, Ncomponents), with the same conventions as pyuvsim.

    The sky has points in Jy or K sr, or HEALPix in Jy/sr or K, of any spectral type. Frequencies are in Hz, (Nfreqs,);
    `components` are indices, all by default. Flux densities that are the same at all frequencies are a read-only view
    that does not repeat them in memory.

    HEALPix pixels count as points that hold the pixel's integral, and brightness temperatures are converted at the
    reference frequency of a spectral-index or flat component, or else at each frequency (Rayleigh-Jeans). Raises
    InputError if a spectral index is not a number, or the sky lacks one of the frequencies.
    """
    if sky.spectral_type == "subband":
        sky = at_frequencies(sky, frequencies)
    spectrum = _stokes_values(sky, frequencies, components) * _jansky_factor(sky, frequencies, components)
    return np.broadcast_to(spectrum, (len(frequencies), spectrum.shape[1]))


def _stokes_values(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice) -> np.ndarray:
    """Return Stokes I in the unit of the sky model, (Nfreqs or 1, Ncomponents)."""
    values = sky.stokes[0].value
    if sky.spectral_type == "flat":
        return values[:, components]
    if sky.spectral_type == "spectral_index":
        if np.isnan(sky.spectral_index).any():
            raise InputError("the spectral index of a component of the sky is not a number, give it a value or drop it")
        reference, index = sky.reference_frequency.to_value("Hz")[components], sky.spectral_index[components]
        return values[:, components] * (frequencies[:, None] / reference) ** index
    available = sky.freq_array.to_value("Hz")
    nearest = np.abs(available - frequencies[:, None]).argmin(axis=1)
    missing = np.abs(available[nearest] - frequencies) > sky.freq_tol.to_value("Hz")
    if missing.any():
        raise InputError(f"the sky is given channel by channel and has none at {frequencies[missing][0]} Hz")
    return np.stack([values[row, components] for row in nearest])


def _jansky_factor(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice) -> np.ndarray | float:
    """Return the factor from the unit of the sky model to Jy, broadcastable to (Nfreqs, Ncomponents)."""
    solid_angle = nside_to_pixel_area(sky.nside) if sky.component_type == "healpix" else 1 * units.sr / units.sr
    unit = sky.stokes.unit * solid_angle.unit
    if unit.is_equivalent("Jy"):
        return float(solid_angle.value * unit.to("Jy"))
    scale = float(solid_angle.value * unit.to("K sr"))
    if sky.spectral_type in ("flat", "spectral_index") and sky.reference_frequency is not None:
        return scale / jy_to_ksr(sky.reference_frequency[components]).value
    return scale / jy_to_ksr(frequencies * units.Hz).value[:, None]


# A direction is a unit vector that turns with the Earth; this is its rounding error.
DIRECTION_TOLERANCE = 1e-15

# A source this close to the horizon may rise or set between two of the sampled times (rad).
HORIZON_MARGIN = 1e-6


@dataclass(frozen=True)
class SourceTracks:
    """Direction of every component at any time within a span.

    The transformation is astropy's, which pyuvsim uses, at a few Chebyshev times. Directions in between are those of
    the interpolating polynomial, equal to rounding. `nodes` are the times, (n,), Julian dates (UTC), and `vectors` are
    unit vectors in east, north, up at these times, (n, 3, Ncomponents).
    """

    nodes: np.ndarray
    vectors: np.ndarray

    @classmethod
    def of(cls, sky: SkyModel, location: EarthLocation, times_jd: np.ndarray) -> SourceTracks:
        """Compute the tracks of the components of a sky, in any celestial frame, for Julian dates (UTC), (Ntimes,)."""
        bandwidth = EARTH_ROTATION_RATE * SECONDS_PER_DAY * np.ptp(times_jd) / 2
        count = chebyshev_count(bandwidth, DIRECTION_TOLERANCE)
        distinct = np.unique(times_jd)
        nodes = distinct if count >= len(distinct) else chebyshev_nodes(distinct[0], distinct[-1], count)
        if _is_whole_map(sky):
            place = tuple(axis.to_value("m") for axis in location.geocentric)
            return cls(nodes, _map_vectors(sky.nside, place, tuple(nodes)))
        return cls(nodes, _vectors(sky_coordinates(sky), location, nodes))

    def at(self, times_jd: float | np.ndarray, components: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return unit vectors towards the components in east, north, up, (3, Ncomponents), or (Nt, 3, Ncomponents)."""
        vectors = self.vectors[:, :, components]
        matrix = interpolation_matrix(self.nodes, np.atleast_1d(times_jd))
        return (matrix @ vectors.reshape(len(vectors), -1)).reshape(*np.shape(times_jd), 3, vectors.shape[2])

    def select(self, components: np.ndarray) -> SourceTracks:
        """Return the tracks of some components, in that order."""
        return SourceTracks(self.nodes, np.ascontiguousarray(self.vectors[:, :, components]))


def _is_whole_map(sky: SkyModel) -> bool:
    """Return whether a sky is a whole HEALPix map in RING order, ICRS: its resolution tells its directions."""
    return (
        sky.component_type == "healpix"
        and (sky.hpx_frame.name, sky.hpx_order) == ("icrs", "ring")
        and np.array_equal(sky.hpx_inds, np.arange(12 * sky.nside**2))
    )


def sky_coordinates(sky: SkyModel) -> SkyCoord:
    """Return the coordinates of points or of the centres of HEALPix pixels, (Ncomponents,), in the sky's own frame."""
    if sky.component_type == "point":
        return sky.skycoord
    return SkyCoord(*sky.get_lon_lat(), frame=sky.hpx_frame)


# All channels of the EoR have the same pixels, whose transformation takes a tenth of the time of a chunk.
@lru_cache(maxsize=1)
def _map_vectors(nside: int, place: tuple[float, float, float], nodes: tuple[float, ...]) -> np.ndarray:
    """Return the directions of all pixels of a map, (Nnodes, 3, Npixels), read-only."""
    longitude, latitude = healpy.pix2ang(nside, np.arange(12 * nside**2), lonlat=True)
    coordinates = SkyCoord(longitude, latitude, unit="deg", frame="icrs")
    vectors = _vectors(coordinates, EarthLocation.from_geocentric(*place, unit="m"), np.array(nodes))
    vectors.flags.writeable = False
    return vectors


def _vectors(coordinates: SkyCoord, location: EarthLocation, nodes: np.ndarray) -> np.ndarray:
    use_bundled_earth_orientation()
    found = []
    for time in Time(nodes, format="jd", scale="utc", location=location):
        local = coordinates.transform_to(AltAz(obstime=time, location=location))
        altitude, azimuth = local.alt.rad, local.az.rad
        found.append([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    return np.array(found)


def split_by_horizon(tracks: SourceTracks, times_jd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of components that are above the horizon at all times, and of those that rise or set.

    The times are all those that will be simulated or interpolated to. Components so close to the horizon that they
    might cross it are among the second. The height of a source is a sinusoid of at most unit amplitude. Between two
    sampled times that are an angle h apart, it exceeds the range of its sampled values by at most h^2 / 8.
    """
    looked_at = np.unique(np.concatenate([tracks.nodes, [times_jd.min(), times_jd.max()]]))
    heights = np.stack([tracks.at(time)[2] for time in looked_at])
    spacing = EARTH_ROTATION_RATE * SECONDS_PER_DAY * np.diff(looked_at).max(initial=0.0)
    margin = HORIZON_MARGIN + spacing**2 / 8
    always_up = heights.min(axis=0) > margin
    crossing = (heights.max(axis=0) > -margin) & ~always_up
    return np.flatnonzero(always_up), np.flatnonzero(crossing)


def sky_cells(sky: SkyModel, nside: int) -> np.ndarray:
    """Return the pixel of each component in a coarse nested HEALPix grid in the frame of the sky."""
    if nside == 0:
        return np.zeros(sky.Ncomponents, dtype=int)
    longitude, latitude = sky.get_lon_lat()
    return healpy.ang2pix(nside, longitude.deg, latitude.deg, nest=True, lonlat=True)
