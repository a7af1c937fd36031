"""Catalogues of point sources: reading, selection, and conversion to sky models."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.table import Table
from pyradiosky import SkyModel

from calstudy.base.errors import InputError
from calstudy.sky.counts import FREQUENCY, SPECTRAL_INDEX
from calstudy.sky.settings import CatalogueErrors, PointSources

LOG = logging.getLogger(__name__)

# Column names of the GLEAM catalogue in the files of VizieR and of the collaboration.
GLEAM_COLUMNS = {
    "name": ("GLEAM", "Name"),
    "right_ascension": ("RAJ2000",),
    "declination": ("DEJ2000",),
    "flux": ("Fintwide", "int_flux_wide"),
    "spectral_index": ("alpha", "GLEAM_alpha"),
}


@dataclass(frozen=True)
class Catalogue:
    """Point sources with power-law spectra, S(ν) = flux (ν / 200 MHz)^spectral_index; all arrays are (Nsources,).

    Positions are ICRS in radians, and fluxes are Stokes I at 200 MHz in Jy.
    """

    names: np.ndarray
    right_ascension: np.ndarray
    declination: np.ndarray
    flux: np.ndarray
    spectral_index: np.ndarray

    def __len__(self) -> int:
        return len(self.flux)

    def select(self, chosen: np.ndarray) -> Catalogue:
        """Return the sources selected by a boolean or index array."""
        return Catalogue(
            self.names[chosen],
            self.right_ascension[chosen],
            self.declination[chosen],
            self.flux[chosen],
            self.spectral_index[chosen],
        )


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


def concatenate(*catalogues: Catalogue) -> Catalogue:
    """Join several catalogues."""
    fields = ("names", "right_ascension", "declination", "flux", "spectral_index")
    return Catalogue(*(np.concatenate([getattr(part, field) for part in catalogues]) for field in fields))


def read_gleam_table(path: Path) -> Catalogue:
    """Read a table with the columns of the GLEAM catalogue (VOTable or FITS).

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
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"sky.foregrounds.path: {path} cannot be read as a VOTable or FITS table ({error})") from error
    found = {
        key: next((name for name in names if name in table.colnames), None) for key, names in GLEAM_COLUMNS.items()
    }
    missing = ["/".join(GLEAM_COLUMNS[key]) for key, name in found.items() if name is None]
    if missing:
        raise InputError(f"sky.foregrounds.path: {path} is not a GLEAM catalogue, it lacks {', '.join(missing)}")
    columns: dict[str, np.ndarray] = {
        key: np.ma.filled(np.ma.asarray(table[found[key]], dtype=float), np.nan) for key in list(found)[1:]
    }
    catalogue = Catalogue(
        np.asarray(table[found["name"]]).astype(str),
        np.deg2rad(columns["right_ascension"]),
        np.deg2rad(columns["declination"]),
        columns["flux"],
        np.where(np.isfinite(columns["spectral_index"]), columns["spectral_index"], SPECTRAL_INDEX),
    )
    measured = np.isfinite(catalogue.flux)
    LOG.info("%s: %d sources, %d of them with a wide-band flux", path, len(catalogue), measured.sum())
    return catalogue.select(measured)


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
    if sky.spectral_type == "flat":
        sky.spectral_type, sky.spectral_index = "spectral_index", np.zeros(sky.Ncomponents)
        sky.reference_frequency = np.full(sky.Ncomponents, FREQUENCY) * units.Hz
    sky.stokes = sky.stokes * (sky.reference_frequency.to_value("Hz") / FREQUENCY) ** change
    sky.spectral_index = sky.spectral_index + change


def to_sky_model(catalogue: Catalogue, settings: PointSources) -> SkyModel:
    """Return the sources as point components, with spectra according to the settings."""
    stokes = np.zeros((4, 1, len(catalogue))) * units.Jy
    stokes[0, 0] = catalogue.flux * units.Jy
    spectrum: dict[str, Any] = {"spectral_type": "flat"}
    if settings.spectrum == "catalogue":
        spectrum = {
            "spectral_type": "spectral_index",
            "spectral_index": catalogue.spectral_index,
            "reference_frequency": np.full(len(catalogue), FREQUENCY) * units.Hz,
        }
    return SkyModel(
        name=catalogue.names.astype(str),
        skycoord=SkyCoord(catalogue.right_ascension, catalogue.declination, unit="rad", frame="icrs"),
        stokes=stokes,
        component_type="point",
        history="calstudy foregrounds",
        **spectrum,
    )
