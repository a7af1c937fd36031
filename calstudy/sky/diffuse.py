"""Diffuse Galactic emission: a HEALPix map of brightness temperature, as points that hold the flux of their pixels."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import healpy
import numpy as np
from astropy import constants, units
from astropy.coordinates import FK4, SkyCoord
from astropy.io import fits
from pyradiosky import SkyModel
from scipy.interpolate import RectBivariateSpline

from calstudy.base.errors import InputError
from calstudy.base.package_files import PackageFile
from calstudy.sky import settings as section

HASLAM_FREQUENCY = 408e6
HASLAM_FILE = PackageFile("mwa_pb", "data/radio408.RaDec.fits")
# The map is in tenths of a kelvin, on a grid of 20 arcmin in B1950 coordinates, its middle at (0, 0).
HASLAM_UNIT, HASLAM_STEP = 0.1, np.deg2rad(1 / 3)
# The cosmic microwave background (Fixsen 2009, K) is in the map, and does not follow the power law of the Galaxy.
MICROWAVE_BACKGROUND = 2.725
# Coarser maps are means of this one, whose pixels (14 arcmin) resolve the 51 arcmin of the survey.
FINEST_NSIDE = 256


def brightness_temperature(settings: section.HaslamMap | section.SyntheticDiffuse) -> np.ndarray:
    """Return the brightness temperature of all pixels at the map's frequency, K, (Npixels,), RING order, ICRS.

    Raises
    ------
    InputError
        If the installed mwa_pb is without its copy of the Haslam map.
    """
    if isinstance(settings, section.HaslamMap):
        return healpy.ud_grade(_haslam(HASLAM_FILE.path), settings.nside)
    return _synthetic(settings)


@lru_cache(maxsize=1)
def _haslam(path: Path) -> np.ndarray:
    """Return the 408 MHz survey without the microwave background, sampled at the centres of fine pixels, K."""
    if not path.is_file():
        raise InputError(
            f"sky.diffuse: the installed mwa_pb is without the Haslam map ({path}); install mwa_pb 1.1, or use kind: "
            "synthetic"
        )
    with fits.open(path) as file:
        grid = HASLAM_UNIT * np.asarray(file[0].data[0], float) - MICROWAVE_BACKGROUND
    # Right ascension falls with the column, from 180 to -180 degrees, both of which are there.
    offset = HASLAM_STEP * np.arange(grid.shape[1]) - np.pi
    declination = HASLAM_STEP * np.arange(grid.shape[0]) - np.pi / 2
    spline = RectBivariateSpline(declination, offset, grid)
    pixels = np.arange(healpy.nside2npix(FINEST_NSIDE))
    longitude, latitude = healpy.pix2ang(FINEST_NSIDE, pixels, lonlat=True)
    old = SkyCoord(longitude, latitude, unit="deg", frame="icrs").transform_to(FK4(equinox="B1950"))
    found = spline.ev(old.dec.rad, -old.ra.wrap_at(180 * units.deg).rad)
    found.flags.writeable = False
    return found


def _synthetic(settings: section.SyntheticDiffuse) -> np.ndarray:
    """Return a Gaussian field with C_l proportional to l^-index about a mean; large scales do not depend on nside."""
    lmax = 3 * settings.nside - 1
    degree = np.arange(1, 3 * FINEST_NSIDE)
    spectrum = degree**-settings.angular_index
    variance = np.sum((2 * degree + 1) * spectrum) / (4 * np.pi)
    harmonics = np.zeros(healpy.Alm.getsize(lmax), dtype=complex)
    for ell in range(1, lmax + 1):
        generator = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(ell,)))
        # Complex of unit variance for m > 0; m = 0 is real.
        normal = generator.standard_normal((2, ell + 1)) / np.sqrt(2)
        normal[0, 0] *= np.sqrt(2)
        normal[1, 0] = 0.0
        orders = healpy.Alm.getidx(lmax, ell, np.arange(ell + 1))
        harmonics[orders] = np.sqrt(spectrum[ell - 1] / variance) * (normal[0] + 1j * normal[1])
    return settings.mean + settings.rms * healpy.alm2map(harmonics, settings.nside, lmax=lmax)


def make_diffuse(settings: section.HaslamMap | section.SyntheticDiffuse) -> SkyModel:
    """Return the map as points at the centres of its pixels, with the flux of the pixels and power-law spectra.

    In the Rayleigh-Jeans limit a pixel of T kelvin and solid angle Ω has S = 2 k T ν² Ω / c², so that T ∝ ν^β is
    S ∝ ν^(β + 2).

    Parameters
    ----------
    settings
        A map of the `sky.diffuse` section.

    Raises
    ------
    InputError
        If the map is not there.
    """
    temperature = brightness_temperature(settings)
    frequency = reference_frequency(settings)
    solid_angle = healpy.nside2pixarea(settings.nside)
    per_kelvin = 2 * constants.k_B * units.K * (frequency * units.Hz / constants.c) ** 2 * solid_angle
    longitude, latitude = healpy.pix2ang(settings.nside, np.arange(temperature.size), lonlat=True)
    stokes = np.zeros((4, 1, temperature.size))
    stokes[0, 0] = temperature * per_kelvin.to_value("Jy")
    return SkyModel(
        name=np.char.add("pixel", np.arange(temperature.size).astype(str)),
        skycoord=SkyCoord(longitude, latitude, unit="deg", frame="icrs"),
        stokes=stokes * units.Jy,
        spectral_type="spectral_index",
        spectral_index=np.full(temperature.size, settings.spectral_index + 2.0),
        reference_frequency=np.full(temperature.size, frequency) * units.Hz,
        component_type="point",
        history="calstudy diffuse emission",
        # A Gaussian field may be below zero somewhere.
        run_check_acceptability=False,
    )


def reference_frequency(settings: section.HaslamMap | section.SyntheticDiffuse) -> float:
    """Return the frequency of the map, Hz."""
    return HASLAM_FREQUENCY if isinstance(settings, section.HaslamMap) else settings.frequency


def describe(settings: section.HaslamMap | section.SyntheticDiffuse) -> str:
    """Return in a few words what the map is."""
    name = "the Haslam map" if isinstance(settings, section.HaslamMap) else "a synthetic map"
    return f"diffuse emission: {name} at nside {settings.nside}, T proportional to nu^{settings.spectral_index:g}"


def add_skies(points: SkyModel, diffuse: SkyModel, frequencies: np.ndarray) -> SkyModel:
    """Return a catalogue of points and a diffuse map as one sky.

    Parameters
    ----------
    points
        Of any spectral type.
    diffuse
        From `make_diffuse`.
    frequencies
        All channels in Hz, (Nfreqs,): a catalogue whose spectra are neither flat nor power laws is given at these.

    Returns
    -------
    SkyModel
        Points with power-law spectra, or else given channel by channel.
    """
    if points.spectral_type in ("flat", "spectral_index"):
        spectra = {
            "spectral_type": "spectral_index",
            "spectral_index": np.concatenate([_spectral_index(points), diffuse.spectral_index]),
            "reference_frequency": np.concatenate([_reference_frequency(points), diffuse.reference_frequency]),
        }
    else:
        points, diffuse = (
            sky.at_frequencies(frequencies * units.Hz, inplace=False, run_check=False) for sky in (points, diffuse)
        )
        spectra = {"spectral_type": "full", "freq_array": frequencies * units.Hz}
    directions = [sky.skycoord.icrs for sky in (points, diffuse)]
    longitude, latitude = (np.concatenate([getattr(one, axis).rad for one in directions]) for axis in ("ra", "dec"))
    return SkyModel(
        name=np.concatenate([np.asarray(sky.name).astype(str) for sky in (points, diffuse)]),
        skycoord=SkyCoord(longitude, latitude, unit="rad", frame="icrs"),
        stokes=np.concatenate([sky.stokes.to("Jy") for sky in (points, diffuse)], axis=2),
        component_type="point",
        history="calstudy foregrounds",
        run_check_acceptability=False,
        **spectra,
    )


def _spectral_index(points: SkyModel) -> np.ndarray:
    return np.zeros(points.Ncomponents) if points.spectral_type == "flat" else points.spectral_index


def _reference_frequency(points: SkyModel) -> units.Quantity:
    """Return the reference frequencies of a catalogue; of a flat spectrum any one will do."""
    if points.reference_frequency is None:
        return np.full(points.Ncomponents, HASLAM_FREQUENCY) * units.Hz
    return points.reference_frequency
