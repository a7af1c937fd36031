"""The foreground sky: point sources, from catalogues, source counts or a user's function, and diffuse emission."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import healpy
import numpy as np
from astropy import constants, units
from astropy.coordinates import FK4, SkyCoord
from astropy.io import fits, votable
from pyradiosky import SkyModel
from scipy.interpolate import RectBivariateSpline

from calstudy.base.errors import InputError
from calstudy.base.foreign_files import require_self_contained
from calstudy.base.package_files import G4JY, HASLAM
from calstudy.base.user_code import load_function, user_code
from calstudy.base.visibilities import taken
from calstudy.sky import settings as section
from calstudy.sky.catalogue import (
    GLEAM_SOURCES,
    brightest,
    make_catalogue,
    make_points,
    make_power_law,
    power_law,
    read_csv_catalogue,
    read_gleam_table,
    to_sky_model,
    unpolarized,
    verify_gleam,
    with_errors,
)
from calstudy.sky.counts import BRIGHTEST, COUNTS_FREQUENCY, FREQUENCY, SPECTRAL_INDEX, draw_population
from calstudy.sky.eor import draw_harmonics
from calstudy.sky.spectra import at_frequencies, require_enclosed, span

LONGEST_HEADER = 2**20
"""Bytes of a VOTable in which its columns are described."""
HASLAM_FREQUENCY = 408e6
# The map is in tenths of a kelvin, on a grid of 20 arcmin in B1950 coordinates, its middle at (0, 0).
HASLAM_UNIT, HASLAM_STEP = 0.1, np.deg2rad(1 / 3)
# The cosmic microwave background (Fixsen 2009, K) is in the map, and does not follow the power law of the Galaxy.
MICROWAVE_BACKGROUND = 2.725
# Coarser maps are means of this one, whose pixels (14 arcmin) resolve the 51 arcmin of the survey.
FINEST_NSIDE = 256


def brightness_temperature(settings: section.HaslamMap | section.SyntheticDiffuse) -> np.ndarray:
    """Return the brightness temperature of all pixels at the map's frequency, K, (Npixels,), RING order, ICRS.

    Raises InputError if the Haslam map is missing.
    """
    if isinstance(settings, section.HaslamMap):
        return healpy.ud_grade(_haslam(HASLAM.find()), settings.nside)
    return _synthetic_diffuse(settings)


@lru_cache(maxsize=1)
def _haslam(path: Path) -> np.ndarray:
    """Return the 408 MHz survey without the microwave background, sampled at the centres of fine pixels, K."""
    with fits.open(path) as file:
        grid = HASLAM_UNIT * np.asarray(file[0].data[0], float) - MICROWAVE_BACKGROUND
    # Right ascension decreases with the column, from 180 to -180 degrees, both included.
    offset = HASLAM_STEP * np.arange(grid.shape[1]) - np.pi
    declination = HASLAM_STEP * np.arange(grid.shape[0]) - np.pi / 2
    spline = RectBivariateSpline(declination, offset, grid)
    pixels = np.arange(healpy.nside2npix(FINEST_NSIDE))
    longitude, latitude = healpy.pix2ang(FINEST_NSIDE, pixels, lonlat=True)
    old = SkyCoord(longitude, latitude, unit="deg", frame="icrs").transform_to(FK4(equinox="B1950"))
    found = spline.ev(old.dec.rad, -old.ra.wrap_at(180 * units.deg).rad)
    found.flags.writeable = False
    return found


def _synthetic_diffuse(settings: section.SyntheticDiffuse) -> np.ndarray:
    """Return a Gaussian field with C_l proportional to l^-index about a mean; large scales do not depend on nside."""
    lmax = 3 * settings.nside - 1
    degree = np.arange(1, 3 * FINEST_NSIDE)
    spectrum = degree**-settings.angular_index
    variance = np.sum((2 * degree + 1) * spectrum) / (4 * np.pi)
    harmonics = np.zeros(healpy.Alm.getsize(lmax), dtype=complex)
    for ell in range(1, lmax + 1):
        real, imaginary = draw_harmonics(settings.seed, ell)
        orders = healpy.Alm.getidx(lmax, ell, np.arange(ell + 1))
        harmonics[orders] = np.sqrt(spectrum[ell - 1] / variance) * (real + 1j * imaginary)
    return settings.mean + settings.rms * healpy.alm2map(harmonics, settings.nside, lmax=lmax)


def make_diffuse(settings: section.HaslamMap | section.SyntheticDiffuse) -> SkyModel:
    """Return the map as points at the centres of its pixels, with the flux of the pixels and power-law spectra.

    In the Rayleigh-Jeans limit a pixel of T kelvin and solid angle Ω has S = 2 k T ν² Ω / c², so that T ∝ ν^β is
    S ∝ ν^(β + 2). Errors are those of `brightness_temperature`.
    """
    temperature = brightness_temperature(settings)
    frequency = HASLAM_FREQUENCY if isinstance(settings, section.HaslamMap) else settings.frequency
    solid_angle = healpy.nside2pixarea(settings.nside)
    per_kelvin = 2 * constants.k_B * units.K * (frequency * units.Hz / constants.c) ** 2 * solid_angle
    longitude, latitude = healpy.pix2ang(settings.nside, np.arange(temperature.size), lonlat=True)
    # A Gaussian field may be below zero somewhere.
    return make_points(
        np.char.add("pixel", np.arange(temperature.size).astype(str)),
        SkyCoord(longitude, latitude, unit="deg", frame="icrs"),
        unpolarized(temperature * per_kelvin.to_value("Jy")),
        power_law(np.full(temperature.size, settings.spectral_index + 2.0), frequency),
        may_be_negative=True,
    )


def add_skies(points: SkyModel, diffuse: SkyModel, frequencies: np.ndarray) -> SkyModel:
    """Return a catalogue of points and a diffuse map from `make_diffuse` as one sky.

    The spectra are power laws if those of the catalogue are flat or power laws, or else given at channels in Hz.
    """
    skies = points.copy(), diffuse
    make_power_law(skies[0])
    if skies[0].spectral_type == "spectral_index":
        spectra = {
            name: np.concatenate([getattr(sky, name) for sky in skies])
            for name in ("spectral_index", "reference_frequency")
        }
    else:
        skies = at_frequencies(points, frequencies), at_frequencies(diffuse, frequencies)
        spectra = {"freq_array": frequencies * units.Hz}
    directions = [sky.skycoord.icrs for sky in skies]
    longitude, latitude = (np.concatenate([getattr(one, axis).rad for one in directions]) for axis in ("ra", "dec"))
    return make_points(
        np.concatenate([np.asarray(sky.name).astype(str) for sky in skies]),
        SkyCoord(longitude, latitude, unit="rad", frame="icrs"),
        np.concatenate([sky.stokes.to("Jy") for sky in skies], axis=2),
        {"spectral_type": skies[0].spectral_type, **spectra},
        may_be_negative=True,
    )


LOG = logging.getLogger(__name__)

# G4Jy (White et al. 2020) is complete above about this flux at 200 MHz, south of +30° and away from the Galactic plane.
COMPLETE_FLUX = 4.0
# For any higher flux limit the same sources are drawn, so that G4Jy components replace the same ones.
FAINTEST_DRAWN = 2.0
# Spawn key of the random numbers of spectral indices; bins of flux have others.
INDEX_STREAM = 0
COMPLETE_DECLINATION = np.deg2rad(30.0)
COMPLETE_LATITUDE = np.deg2rad(10.0)
BRIGHTEST_NOW = BRIGHTEST * (FREQUENCY / COUNTS_FREQUENCY) ** SPECTRAL_INDEX
FREQUENCY_TOLERANCE = 1.0
NOTHING = make_catalogue(
    np.array(["none"]), np.zeros(1), np.array([-np.pi / 2]), np.zeros(1), np.array([SPECTRAL_INDEX])
)


@dataclass(frozen=True)
class Foregrounds:
    """The foreground sky as points, brightest first, and a note, or None if it is the paper's GLEAM catalogue.

    Without foregrounds the sky is a single source of 0 Jy, because sky models cannot be empty.
    """

    sky: SkyModel
    stand_in: str | None


def make_foregrounds(
    settings: section.Foregrounds, frequencies: np.ndarray, diffuse: section.Diffuse | None = None
) -> Foregrounds:
    """Return point sources and diffuse emission, as further points, for channels in Hz, (Nfreqs,).

    Raises InputError if a catalogue or a map is missing or cannot be used.
    """
    frequencies = np.asarray(frequencies, dtype=float)
    points = _points(settings, frequencies)
    if diffuse is None or isinstance(diffuse, section.NoDiffuse):
        return points
    name = "the Haslam map" if isinstance(diffuse, section.HaslamMap) else "a synthetic map"
    sky = make_diffuse(diffuse)
    stand_in = f"diffuse emission: {name} at nside {diffuse.nside}, T proportional to nu^{diffuse.spectral_index:g}"
    if isinstance(settings, section.NoSources):
        return Foregrounds(sky, stand_in)
    both = add_skies(points.sky, sky, frequencies)
    return Foregrounds(both, f"{points.stand_in}; {stand_in}" if points.stand_in else stand_in)


def _points(settings: section.Foregrounds, frequencies: np.ndarray) -> Foregrounds:
    made = _make(settings, frequencies)
    if not isinstance(settings, section.PointSources) or settings.errors == section.CatalogueErrors():
        return made
    errors = ", ".join(f"{name} {value}" for name, value in settings.errors.model_dump(mode="json").items())
    stand_in = f"{made.stand_in or 'foregrounds: GLEAM'}; errors: {errors}"
    return Foregrounds(with_errors(made.sky, settings.errors), stand_in)


def _make(settings: section.Foregrounds, frequencies: np.ndarray) -> Foregrounds:
    if isinstance(settings, section.NoSources):
        return Foregrounds(to_sky_model(NOTHING, section.PointSources()), "foregrounds: none")
    if isinstance(settings, section.GleamSources):
        return _gleam(settings)
    if isinstance(settings, section.FileSources):
        return _from_file(settings, frequencies)
    if isinstance(settings, section.CodeSources):
        return _from_code(settings, frequencies)
    return _synthetic(settings)


def _gleam(settings: section.GleamSources) -> Foregrounds:
    path = section.find_gleam() if settings.path is None else settings.path
    if not path.is_file():
        raise InputError(f"sky.foregrounds.path: there is no file {path}; 'calstudy data fetch gleam' downloads it")
    verify_gleam(path)
    catalogue = read_gleam_table(path)
    stand_in = None
    if len(catalogue) < GLEAM_SOURCES:
        stand_in = f"foregrounds: {len(catalogue)} of GLEAM's {GLEAM_SOURCES} sources, from {path.name}"
    return Foregrounds(to_sky_model(catalogue[brightest(catalogue.flux, settings)], settings), stand_in)


def _synthetic(settings: section.SyntheticSources) -> Foregrounds:
    """Combine G4Jy components with synthetic sources drawn from source counts where G4Jy is not complete.

    All G4Jy components are used. Synthetic sources cover the whole sky below 4 Jy (at 200 MHz), and all fluxes north
    of +30° and within 10° of the Galactic plane, where G4Jy has no sources. G4Jy is selected at 151 MHz and so
    extends below 4 Jy at 200 MHz: there each G4Jy component replaces the synthetic source with the nearest flux, so
    that the counts remain as measured. As in GLEAM itself, the brightest few radio sources (Cygnus A, Cassiopeia
    A, Centaurus A, ...) and the Galaxy are missing.
    """
    both, n_components = _components(min(settings.flux_limit, FAINTEST_DRAWN), settings.seed, settings.index_scatter)
    chosen = brightest(both.flux, settings)
    n_real = int((chosen < n_components).sum())
    stand_in = (
        f"foregrounds: {n_real} real G4Jy components and {len(chosen) - n_real} synthetic sources drawn from the "
        "counts of Franzen et al. (2019); GLEAM was not used"
    )
    LOG.info("%s", stand_in)
    return Foregrounds(to_sky_model(both[chosen], settings), stand_in)


# Every chunk of a simulation needs them, and making them takes longer than a small chunk.
@lru_cache(maxsize=1)
def _components(faintest: float, seed: int, index_scatter: float) -> tuple[np.recarray, int]:
    """Return G4Jy components followed by synthetic sources, down to a flux in Jy, and the number of G4Jy components."""
    real = read_gleam_table(G4JY.find())
    synthetic = _population(faintest, seed, index_scatter)
    covered = _in_g4jy_area(synthetic)
    synthetic = synthetic[~covered | (synthetic.flux < COMPLETE_FLUX)]
    covered = np.flatnonzero(_in_g4jy_area(synthetic))
    replaced = covered[_nearest(synthetic.flux[covered], real.flux[real.flux < COMPLETE_FLUX])]
    both = np.concatenate([real, np.delete(synthetic, replaced)]).view(np.recarray)
    return both, len(real)


def _population(faintest: float, seed: int, index_scatter: float) -> np.recarray:
    right_ascension, declination, flux = draw_population(faintest, BRIGHTEST_NOW, seed)
    order = np.argsort(-flux, kind="stable")
    names = np.char.add("synthetic", np.arange(len(flux)).astype(str))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(INDEX_STREAM,)))
    # Brightest first, so that the index of a source does not depend on the flux limit.
    index = SPECTRAL_INDEX + index_scatter * generator.standard_normal(len(flux))
    return make_catalogue(names, right_ascension[order], declination[order], flux[order], index)


def in_complete_area(directions: SkyCoord) -> np.ndarray:
    """Return whether each direction, (N,), is where G4Jy is complete: south of +30° and 10° from the Galactic plane."""
    latitude = np.abs(directions.galactic.b.rad)
    return (directions.icrs.dec.rad < COMPLETE_DECLINATION) & (latitude >= COMPLETE_LATITUDE)


def _in_g4jy_area(catalogue: np.recarray) -> np.ndarray:
    return in_complete_area(SkyCoord(catalogue.right_ascension, catalogue.declination, unit="rad", frame="icrs"))


def _nearest(available: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return indices into `available` of the values nearest to each of `wanted`, none of them twice."""
    logarithm = np.log(available)
    taken = []
    for value in np.log(wanted[wanted >= available.min()]):
        distance = np.abs(logarithm - value)
        taken.append(int(distance.argmin()))
        logarithm[taken[-1]] = np.inf
    return np.array(taken, dtype=int)


def _from_file(settings: section.FileSources, frequencies: np.ndarray) -> Foregrounds:
    sky = _read(settings)
    if sky.component_type != "point":
        raise InputError(f"sky.foregrounds.path: {settings.path} holds a HEALPix map; a catalogue of points is needed")
    if sky.spectral_type == "spectral_index" and (lacking := ~np.isfinite(sky.spectral_index)).any():
        raise InputError(
            f"sky.foregrounds.path: {lacking.sum()} sources of {settings.path} have no spectral index, such as "
            f"{sky.name[lacking][0]}; give all of them one, or leave out the column"
        )
    flat = settings.spectrum == "flat"
    wanted = f"{'the middle of ' if flat else ''}the channels of {span(frequencies)}"
    needed = np.mean(frequencies, keepdims=True) if flat else frequencies
    require_enclosed(sky, needed, f"sky.foregrounds.path: {settings.path}", wanted)
    if flat and sky.spectral_type == "full":
        _require_in_band(sky, frequencies, settings.path)
    at_centre = _at_frequency(sky, float(np.mean(frequencies)))
    flux = at_centre.stokes[0, 0].to_value("Jy")
    known = np.isfinite([flux, sky.skycoord.spherical.lon.deg, sky.skycoord.spherical.lat.deg]).all(axis=0)
    flux = np.where(known, flux, -np.inf)
    if flat:
        # All channels have the flux of the catalogue at the middle of the band.
        sky = make_points(sky.name, sky.skycoord, at_centre.stokes, {"spectral_type": "flat"})
    else:
        _require_channels(sky, frequencies, f"sky.foregrounds.path: {settings.path}", "; use spectrum: flat")
    chosen = brightest(flux, settings)
    stand_in = f"foregrounds: {len(chosen)} sources of {settings.path.name}"
    return Foregrounds(taken(sky, "Ncomponents", chosen), stand_in)


def _require_in_band(sky: SkyModel, frequencies: np.ndarray, path: Path) -> None:
    """Raise InputError if a catalogue that is given by channel has none in the band: fluxes are not interpolated."""
    tabulated = sky.freq_array.to_value("MHz")
    if not ((tabulated >= frequencies.min() / 1e6) & (tabulated <= frequencies.max() / 1e6)).any():
        raise InputError(
            f"sky.foregrounds.path: {path} has fluxes at {', '.join(f'{value:g}' for value in tabulated[:5])} MHz, and "
            f"at none of {span(frequencies)}; give a table of sub-bands (sky.foregrounds.csv or votable), which is "
            "interpolated, or a flux in the band"
        )


def _from_code(settings: section.CodeSources, frequencies: np.ndarray) -> Foregrounds:
    where = f"{settings.function} of {settings.path.name}"
    with user_code(where):
        function = load_function(settings.path, settings.function)
        sky, again = (function(frequencies.copy(), **settings.options) for _ in range(2))
    if not isinstance(sky, SkyModel) or sky.component_type != "point":
        raise InputError(f"sky.foregrounds: {where} must return a pyradiosky SkyModel of points")
    if sky != again:
        # Each piece of a simulation calls it.
        raise InputError(f"sky.foregrounds: {where} returns another sky at every call; draw it with a fixed seed")
    _require_channels(sky, frequencies, f"sky.foregrounds: {where}")
    try:
        sky.check()
        sky = _in_jansky(sky)
    except ValueError as error:
        raise InputError(f"sky.foregrounds: the sky that {where} returns cannot be used ({error})") from error
    require_enclosed(sky, frequencies, f"sky.foregrounds: {where}", f"the channels of {span(frequencies)}")
    flux = _at_frequency(sky, float(np.mean(frequencies))).stokes[0, 0].to_value("Jy")
    order = np.argsort(-flux, kind="stable")
    stand_in = f"foregrounds: {sky.Ncomponents} sources by {where}"
    return Foregrounds(taken(sky, "Ncomponents", order), stand_in)


def _at_frequency(sky: SkyModel, frequency: float) -> SkyModel:
    """Return the catalogue at one frequency in Hz, or at the nearest tabulated one if it is given by channel."""
    if sky.spectral_type == "flat":
        return sky
    if sky.spectral_type == "full":
        tabulated = sky.freq_array.to_value("Hz")
        frequency = tabulated[np.abs(tabulated - frequency).argmin()]
    return at_frequencies(sky, np.array([frequency]))


def _require_channels(sky: SkyModel, frequencies: np.ndarray, where: str, instead: str = "") -> None:
    """Raise InputError if a sky is given by channel, and not at all of the frequencies in Hz."""
    if sky.spectral_type == "full":
        tabulated = sky.freq_array.to_value("Hz")
        if any(np.abs(tabulated - frequency).min() >= FREQUENCY_TOLERANCE for frequency in frequencies):
            raise InputError(f"{where} tabulates fluxes at frequencies other than the channels{instead}")


def _in_jansky(sky: SkyModel) -> SkyModel:
    """Return points with fluxes in Jy, also if they are in K sr or another unit; maps stay as they are."""
    if sky.component_type == "point" and sky.stokes.unit.is_equivalent("K sr"):
        sky.kelvin_to_jansky()
    if sky.component_type == "point" and sky.stokes.unit.is_equivalent("Jy"):
        # pyuvsim takes the numbers without their unit.
        sky.stokes = sky.stokes.to("Jy")
    return sky


def _require_idl(path: Path) -> None:
    """Raise ValueError unless a file starts as IDL save files do; scipy raises a bare Exception for others."""
    with path.open("rb") as stream:
        if stream.read(2) != b"SR":
            raise ValueError("not an IDL save file")


def _require_no_nulls(path: Path, columns: section.VotableColumns) -> None:
    """Raise ValueError if positions or fluxes have the null value of their column, which pyradiosky takes for data."""
    with path.open("rb") as stream:
        if not re.search(rb"<VALUES[^>]*\bnull=", stream.read(LONGEST_HEADER)):
            return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tables = {str(found.ID or found.name): found.to_table() for found in votable.parse(str(path)).iter_tables()}
    used = (columns.right_ascension, columns.declination, columns.flux, columns.spectral_index)
    for found in (tables[name] for name in _matching(columns.table, tables)):
        for name in (name for part in used if part is not None for name in _matching(part, found.colnames)):
            values = np.ma.getdata(found[name])
            if values.dtype.kind in "iuf" and (null := np.ma.getmaskarray(found[name]) & np.isfinite(values)).any():
                has = f"{null.sum()} entries of column {name} have its null value, {values[null][0]}"
                raise ValueError(f"{has}; leave out their rows")


def _matching(part: str, names: Iterable[str]) -> list[str]:
    """Return the names that are equal to a part, or else contain it; case does not count, as in pyradiosky."""
    found = [name for name in names if part.casefold() in name.casefold()]
    return [name for name in found if name.casefold() == part.casefold()] or found


def _read_votable(path: Path, columns: section.VotableColumns) -> SkyModel:
    frequency = None if columns.frequency is None else columns.frequency * units.Hz
    with warnings.catch_warnings():
        # Published tables stretch the standard (units, versions).
        warnings.simplefilter("ignore")
        try:
            return SkyModel.from_votable_catalog(
                str(path),
                table_name=columns.table,
                id_column=columns.id,
                lon_column=columns.right_ascension,
                lat_column=columns.declination,
                frame="icrs",
                flux_columns=columns.flux,
                reference_frequency=frequency,
                spectral_index_column=columns.spectral_index,
            )
        except AttributeError as error:
            # pyradiosky takes every column to have a unit.
            raise ValueError(f"a column of votable.flux has no unit: {error}") from error


def _read(settings: section.FileSources) -> SkyModel:
    path = settings.path
    if not path.is_file():
        raise InputError(f"sky.foregrounds.path: there is no file {path}")
    require_self_contained(path)
    try:
        if path.suffix == ".sav":
            _require_idl(path)
            with warnings.catch_warnings():
                # Names are not used here; pyradiosky numbers those that occur twice.
                warnings.filterwarnings("ignore", message="Source IDs are not unique")
                return SkyModel.from_fhd_catalog(str(path), expand_extended=False)
        if settings.votable is not None:
            sky = _in_jansky(_read_votable(path, settings.votable))
            _require_no_nulls(path, settings.votable)
            return sky
        if settings.csv is not None:
            return read_csv_catalogue(path, settings.csv)
        _require_known_units(path)
        return _in_jansky(SkyModel.from_file(str(path)))
    except IndexError as error:
        # pyradiosky looks at the first source also where there is none.
        raise InputError(
            f"sky.foregrounds.path: {path} holds no source, or is damaged ({error}); give a catalogue of one or more"
        ) from error
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"sky.foregrounds.path: {path} cannot be read as a catalogue ({error})") from error


def _require_known_units(path: Path) -> None:
    """Raise ValueError if the header of a text file has units that pyradiosky reads over: it takes Jy and Hz."""
    if path.suffix != ".txt":
        return
    with path.open(encoding="utf-8") as stream:
        header = stream.readline()
    for name, unit in re.findall(r"(\S+)\s*\[([^\]]*)\]", header):
        wanted = "Jy" if "flux" in name.lower() else "Hz" if "frequency" in name.lower() else unit
        if unit != wanted:
            raise ValueError(f"{name} is in {unit}, and must be in {wanted}")
