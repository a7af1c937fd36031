"""Catalogues of point sources: reading of GLEAM and CSV files, its download, selection, conversion to sky models."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io.registry import IORegistryError
from astropy.table import Table
from pyradiosky import SkyModel

from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.base.package_files import default_directory, download
from calstudy.sky.counts import FREQUENCY, SPECTRAL_INDEX
from calstudy.sky.settings import GLEAM_FILE, CatalogueErrors, CsvColumns, PointSources

LOG = logging.getLogger(__name__)

# Column names of the GLEAM catalogue in the files of VizieR and of the collaboration.
GLEAM_COLUMNS = {
    "name": ("GLEAM", "Name"),
    "right_ascension": ("RAJ2000",),
    "declination": ("DEJ2000",),
    "flux": ("Fintwide", "int_flux_wide"),
    "spectral_index": ("alpha", "GLEAM_alpha"),
}


def make_catalogue(*columns: np.ndarray) -> np.recarray:
    """Return point sources with power-law spectra, S(ν) = flux (ν / 200 MHz)^spectral_index, (Nsources,).

    The columns are names, right_ascension and declination (ICRS, rad), flux (Stokes I at 200 MHz, Jy) and
    spectral_index.
    """
    names = ("names", "right_ascension", "declination", "flux", "spectral_index")
    return np.rec.fromarrays(columns, dtype=[(n, column.dtype) for n, column in zip(names, columns, strict=True)])


def brightest(flux: np.ndarray, settings: PointSources) -> np.ndarray:
    """Return the indices of the sources above the flux limit, brightest first, at most `count` of them.

    Raises InputError if no source is above the limit.
    """
    order = np.argsort(-flux, kind="stable")
    order = order[flux[order] >= settings.flux_limit][: settings.count]
    if not len(order):
        raise InputError(
            f"sky.foregrounds.flux_limit: no source of the catalogue is as bright as {settings.flux_limit:g} Jy"
        )
    return order


def read_gleam_table(path: Path) -> np.recarray:
    """Read a table with the columns of the GLEAM catalogue (VOTable or FITS) into a catalogue.

    Fluxes are the integrated ones of the wide-band image (170 to 231 MHz, effectively 200 MHz). Sources without a
    fitted spectral index get the mean one, -0.8; sources without a flux are left out. Raises InputError if the file is
    missing, cannot be read or lacks a column.
    """
    if not path.is_file():
        raise InputError(f"sky.foregrounds.path: there is no file {path}")
    try:
        with warnings.catch_warnings():
            # Published tables deviate from the standards (units, VOTable versions). The columns read here are numbers.
            warnings.simplefilter("ignore")
            table = Table.read(path)
    except (OSError, ValueError, TypeError, IndexError, IORegistryError) as error:
        raise InputError(f"sky.foregrounds.path: {path} cannot be read as a VOTable or FITS table ({error})") from error
    found = {
        key: next((name for name in names if name in table.colnames), None) for key, names in GLEAM_COLUMNS.items()
    }
    missing = ["/".join(GLEAM_COLUMNS[key]) for key, name in found.items() if name is None]
    if missing:
        raise InputError(f"sky.foregrounds.path: {path} is not a GLEAM catalogue, it lacks {', '.join(missing)}")
    try:
        columns = {key: _numbers(table, str(found[key])) for key in list(found)[1:]}
    except (ValueError, TypeError) as error:
        raise InputError(
            f"sky.foregrounds.path: {path} has text where a GLEAM catalogue has numbers ({error})"
        ) from None
    if (np.abs(columns["declination"]) > 90).any():
        raise InputError(f"sky.foregrounds.path: {path} has declinations beyond 90 deg")
    catalogue = make_catalogue(
        np.asarray(table[found["name"]]).astype(str),
        np.deg2rad(columns["right_ascension"]),
        np.deg2rad(columns["declination"]),
        columns["flux"],
        np.where(np.isfinite(columns["spectral_index"]), columns["spectral_index"], SPECTRAL_INDEX),
    )
    measured = np.isfinite(catalogue.flux)
    LOG.info("%s: %d sources, %d of them with a wide-band flux", path, len(catalogue), measured.sum())
    return catalogue[measured]


def _numbers(table: Table, column: str) -> np.ndarray:
    """Return a column as floats, NaN where it is masked; raises ValueError or TypeError for text."""
    return np.ma.filled(np.ma.asarray(table[column], dtype=float), np.nan)


def with_errors(sky: SkyModel, errors: CatalogueErrors) -> SkyModel:
    """Return a copy of point sources, brightest first, with random errors of flux, position and spectral index.

    Errors are drawn source by source.
    """
    flux, offset, index = (np.random.default_rng(stream) for stream in np.random.SeedSequence(errors.seed).spawn(3))
    found = sky.copy()
    factor = errors.flux_scale * (1 + errors.flux_scatter * flux.standard_normal(sky.Ncomponents))
    found.stokes = sky.stokes * factor
    if errors.position_scatter:
        east, north = errors.position_scatter * offset.standard_normal((sky.Ncomponents, 2)).T * units.deg
        found.skycoord = sky.skycoord.spherical_offsets_by(east, north)
    if errors.index_scatter:
        _tilt(found, errors.index_scatter * index.standard_normal(sky.Ncomponents))
    return found


def _tilt(sky: SkyModel, change: np.ndarray) -> None:
    """Change the spectral indices of flat or power-law sources, in place, about their fluxes at 200 MHz."""
    if sky.spectral_type not in ("flat", "spectral_index"):
        raise InputError(
            f"sky.foregrounds.errors.index_scatter: needs flat or power-law spectra, those here are {sky.spectral_type}"
        )
    make_power_law(sky)
    sky.stokes = sky.stokes * (sky.reference_frequency.to_value("Hz") / FREQUENCY) ** change
    sky.spectral_index = sky.spectral_index + change


def make_power_law(sky: SkyModel) -> None:
    """Give a sky of flat spectra spectral indices of zero, in place."""
    if sky.spectral_type == "flat":
        sky.spectral_type, sky.spectral_index = "spectral_index", np.zeros(sky.Ncomponents)
        sky.reference_frequency = np.full(sky.Ncomponents, FREQUENCY) * units.Hz


def power_law(index: np.ndarray, frequency: float) -> dict[str, Any]:
    """Return the arguments of a sky model for spectral indices about fluxes at one frequency in Hz."""
    reference = np.full(len(index), frequency) * units.Hz
    return {"spectral_type": "spectral_index", "spectral_index": index, "reference_frequency": reference}


def to_sky_model(catalogue: np.recarray, settings: PointSources) -> SkyModel:
    """Return the sources as point components, with spectra according to the settings."""
    flat = settings.spectrum == "flat"
    spectrum = {"spectral_type": "flat"} if flat else power_law(catalogue.spectral_index, FREQUENCY)
    directions = SkyCoord(catalogue.right_ascension, catalogue.declination, unit="rad", frame="icrs")
    return make_points(catalogue.names, directions, unpolarized(catalogue.flux), spectrum)


def unpolarized(flux: np.ndarray) -> units.Quantity:
    """Return the Stokes parameters, (4, 1, Nsources), of flux densities in Jy, (Nsources,)."""
    stokes = np.zeros((4, 1, len(flux)))
    stokes[0, 0] = flux
    return stokes * units.Jy


def make_points(
    names: np.ndarray,
    directions: SkyCoord,
    stokes: units.Quantity,
    spectrum: dict[str, Any],
    may_be_negative: bool = False,
) -> SkyModel:
    """Return points, with other arguments of a sky model for their spectra; negative fluxes may be warned of."""
    return SkyModel(
        name=np.asarray(names).astype(str),
        skycoord=directions,
        stokes=stokes,
        component_type="point",
        history="calstudy foregrounds",
        run_check_acceptability=not may_be_negative,
        **spectrum,
    )


def read_csv_catalogue(path: Path, columns: CsvColumns) -> SkyModel:
    """Read point sources from a CSV file with a header line; rows without a position or flux density are left out.

    Lines that begin with # are comments. The columns are right ascension and declination (ICRS, degrees), flux density
    (Jy) and spectral index. Raises ValueError if a column is missing or not numeric, there is no source, or a source
    has no spectral index.
    """
    table = Table.read(path, format="ascii.csv", comment="#")
    wanted = {key: getattr(columns, key) for key in ("right_ascension", "declination", "flux", "spectral_index")}
    named = {key: name for key, name in wanted.items() if name is not None}
    missing = [name for name in named.values() if name not in table.colnames]
    if missing:
        raise ValueError(f"there is no column {missing[0]}, only {', '.join(table.colnames)}")
    values = {key: _numbers(table, name) for key, name in named.items()}
    usable = np.isfinite([values[key] for key in ("right_ascension", "declination", "flux")]).all(axis=0)
    if not usable.any():
        raise ValueError("it holds no source: no row has a position and a flux density; give at least one such row")
    values = {key: column[usable] for key, column in values.items()}
    spectrum: dict[str, Any] = {"spectral_type": "flat"}
    if "spectral_index" in values:
        if (lacking := ~np.isfinite(values["spectral_index"])).any():
            row = np.flatnonzero(usable)[lacking][0] + 1
            raise ValueError(
                f"{lacking.sum()} sources have no spectral index, such as that of row {row}; give all of them one, or "
                "leave out csv.spectral_index"
            )
        spectrum = power_law(values["spectral_index"], columns.frequency)
    directions = SkyCoord(values["right_ascension"], values["declination"], unit="deg", frame="icrs")
    return make_points(np.flatnonzero(usable), directions, unpolarized(values["flux"]), spectrum)


# Hurley-Walker et al. (2017), second release.
GLEAM_URL = (
    "https://vizier.cds.unistra.fr/viz-bin/votable?-source=VIII/100/gleamegc&-out.max=unlimited"
    "&-out=GLEAM&-out=RAJ2000&-out=DEJ2000&-out=Fintwide&-out=alpha"
)
GLEAM_SOURCES = 307_455


def fetch_gleam(directory: Path | None = None, progress: bool = True) -> Path:
    """Download the GLEAM extragalactic catalogue from VizieR, or verify an existing copy, and return its path.

    VizieR generates the table for every request and publishes no hash of it. The first download is accepted if it has
    the required columns and the published number of sources. Its SHA-256 is then saved next to it, and checked at every
    later use. Raises InputError if the download fails or is not the catalogue, or if the copy has changed.
    """
    directory = default_directory() if directory is None else directory
    path = directory / GLEAM_FILE
    if path.is_file() and hash_file(path).is_file():
        verify_gleam(path)
        return path
    instead = "set sky.foregrounds.path to your own copy, or use 'g4jy-and-counts', which needs no download"
    download(GLEAM_URL, path, instead, progress=progress)
    try:
        found = len(read_gleam_table(path))
    except InputError:
        path.unlink()
        raise
    if found != GLEAM_SOURCES:
        path.unlink()
        raise InputError(f"the download from VizieR holds {found} sources, GLEAM has {GLEAM_SOURCES}: try again")
    hash_file(path).write_text(f"{sha256(path)}  {GLEAM_FILE}\n")
    return path


def verify_gleam(path: Path) -> None:
    """Raise InputError if a downloaded catalogue has changed; a user's own file has no hash and is not checked."""
    if hash_file(path).is_file() and hash_file(path).read_text().split()[:1] != [sha256(path)]:
        raise InputError(
            f"{path} has changed since it was downloaded: remove it and {hash_file(path).name}, "
            "and run `calstudy data fetch gleam`"
        )


def hash_file(path: Path) -> Path:
    """Return the path of the file next to a downloaded catalogue that holds its SHA-256."""
    return path.with_name(path.name + ".sha256")
