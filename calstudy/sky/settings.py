"""The `sky` section of an experiment file."""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from calstudy.base.errors import InputError
from calstudy.base.package_files import default_directory
from calstudy.base.paths import mapped
from calstudy.base.schema import NAMES_FILES, REVISED, Section, choice, fault, folder_of_files
from calstudy.base.units import Angle, FluxDensity, Fraction, Frequency, PowerDensity, Temperature
from calstudy.base.user_code import load_function

GLEAM_FILE = "gleam_egc.vot"
"""Name of the catalogue in the folder of downloads."""
VOTABLE_SUFFIXES = (".vot", ".votable", ".xml")
BRIGHTEST_SOURCE = 197.0
"""Flux density of the brightest G4Jy component, Jy at 200 MHz, rounded down; a higher flux limit keeps no sources."""


class CatalogueErrors(Section):
    """Errors of the sources of a catalogue, for a calibrator to assume.

    Sources are selected before the errors are applied. The errors of a source do not depend on how many fainter ones
    are kept.
    """

    flux_scale: float = Field(1.0, gt=0, description="All fluxes are multiplied by this.")
    flux_scatter: Fraction = Field(
        0.0, ge=0, description="Standard deviation of the relative error of each flux, constant over the band."
    )
    position_scatter: Angle = Field(
        0.0, ge=0, description="Standard deviation of the error of each position, in each of two directions."
    )
    index_scatter: float = Field(
        0.0, ge=0, description="Standard deviation of the error of each spectral index, about the flux at 200 MHz."
    )
    seed: int = Field(31, ge=0, description="Seed of all these errors.")


class PointSources(Section):
    """Fields of all catalogues of point sources."""

    flux_limit: FluxDensity = Field(0.05, ge=0, le=1e5, description="Keep sources brighter than this.")
    spectrum: Literal["flat", "catalogue"] = Field(
        "flat", description="The same flux in all channels, as in the paper, or the spectral indices of the catalogue."
    )
    # The whole sky has a tenth of so many above 1 mJy.
    count: int | None = Field(None, ge=1, le=10**8, description="Keep the brightest `count` sources (all by default).")
    errors: CatalogueErrors = CatalogueErrors()


def find_gleam() -> Path:
    """Return the path of the downloaded GLEAM catalogue; raises InputError if there is none."""
    path = default_directory() / GLEAM_FILE
    if not path.is_file():
        raise InputError(
            f"GLEAM is not on this machine (looked for {path}); get it with 'calstudy data fetch gleam', give a file "
            "under sky.foregrounds.path, or use 'g4jy-and-counts'"
        )
    return path


class GleamSources(PointSources):
    """The GLEAM extragalactic catalogue (Hurley-Walker et al. 2017, VizieR VIII/100)."""

    kind: Literal["gleam"]
    path: Path | None = Field(
        None, description="Catalogue file; default: the file stored by `calstudy data fetch gleam`."
    )

    @model_validator(mode="after")
    def _catalogue_is_there(self, info: ValidationInfo) -> GleamSources:
        if self.path is not None or folder_of_files(info) is None:
            return self
        try:
            return self.model_copy(update={"path": find_gleam().resolve()})
        except InputError as error:
            raise fault("", str(error)) from None


class SyntheticSources(PointSources):
    """Bright G4Jy components (White et al. 2020), and faint sources drawn from counts (Franzen et al. 2019)."""

    kind: Literal["g4jy-and-counts"] = "g4jy-and-counts"
    flux_limit: FluxDensity = Field(
        0.05,
        ge=0.001,
        le=BRIGHTEST_SOURCE,
        description="Keep sources brighter than this; the counts are measured down to 1 mJy.",
    )
    seed: int = Field(1, ge=0, description="Seed of the positions and fluxes of the synthetic sources.")
    index_scatter: float = Field(
        0.0,
        ge=0,
        description="Standard deviation of the spectral indices of synthetic sources about -0.8, with spectrum: "
        "catalogue; that of the G4Jy components is 0.2.",
    )

    @model_validator(mode="after")
    def _indices_are_used(self) -> SyntheticSources:
        if self.index_scatter and self.spectrum == "flat":
            raise fault("index_scatter", "has no effect with spectrum: flat; use spectrum: catalogue")
        return self


class VotableColumns(Section):
    """Columns of a VOTable. An unambiguous part of a name is sufficient. Units are taken from the file."""

    table: str = Field(description="Name of the table.")
    id: str = Field(description="Column of source names.")
    right_ascension: str
    declination: str
    flux: str = Field(description="Column of flux densities.")
    frequency: Frequency | None = Field(
        None, gt=0, description="Frequency of the fluxes; required for spectral indices."
    )
    spectral_index: str | None = None


class CsvColumns(Section):
    """Columns of a CSV file with a header line."""

    right_ascension: str = Field(description="Column of right ascensions, ICRS, degrees.")
    declination: str = Field(description="Column of declinations, ICRS, degrees.")
    flux: str = Field(description="Column of flux densities, Jy.")
    frequency: Frequency = Field(gt=0, description="Frequency of the fluxes.")
    spectral_index: str | None = Field(None, description="Column of spectral indices; default: flat spectra.")


class FileSources(PointSources):
    """A catalogue in a format that pyradiosky reads: SkyH5, VOTable (`votable`), FHD .sav, text; or a CSV (`csv`)."""

    kind: Literal["file"]
    # Polarized skies are received along the axes of the beams since 2.
    path: Path = Field(json_schema_extra={REVISED: 2})
    votable: VotableColumns | None = Field(None, description="Required for a VOTable (.vot, .votable, .xml), ICRS.")
    csv: CsvColumns | None = Field(None, description="Required for a CSV (.csv).")

    @model_validator(mode="after")
    def _tables_have_columns(self) -> FileSources:
        for field, kind, suffixes in (("csv", "CSV files", (".csv",)), ("votable", "VOTables", VOTABLE_SUFFIXES)):
            if (self.path.suffix.lower() in suffixes) != (getattr(self, field) is not None):
                listed = ", ".join(suffixes)
                raise fault(field, f"is required for {kind} ({listed}), and not allowed for other files")
        return self


def _absolute(value: Any, folder: Path) -> Any:
    """Return the absolute path of a text that names a file in a folder, with a suffix, or else the value."""
    if not isinstance(value, str) or not Path(value).suffix:
        return value
    path = os.path.join(folder, os.path.expanduser(value))  # noqa: PTH111, PTH118
    # Of a name that is too long, Path.is_file raises OSError.
    return os.path.abspath(path) if os.path.isfile(path) else value  # noqa: PTH100, PTH113


class CodeSources(Section):
    """Sources from a user's function.

    It is called with the channel frequencies in Hz, (Nfreqs,), and the options, and returns a pyradiosky SkyModel of
    points.
    """

    kind: Literal["code"]
    # Polarized skies are received along the axes of the beams since 2.
    path: Path = Field(
        description="Python file; a relative path starts at the experiment file.", json_schema_extra={REVISED: 2}
    )
    function: str = Field(description="Name of the function in it.")
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Given to the function as keyword arguments. Names of files start at the experiment file, and "
        "count by their content.",
        json_schema_extra=NAMES_FILES,
    )

    @field_validator("options")
    @classmethod
    def _files_of_options(cls, value: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        folder = folder_of_files(info)
        return value if folder is None else mapped(value, lambda text: _absolute(text, folder))

    @model_validator(mode="after")
    def _function_is_there(self, info: ValidationInfo) -> CodeSources:
        if folder_of_files(info) is not None:
            try:
                inspect.signature(load_function(self.path, self.function)).bind(None, **self.options)
            except InputError as error:
                raise fault("", str(error)) from None
            except TypeError as error:
                called = ", ".join(["frequencies", *(f"{name}=..." for name in self.options)])
                raise fault("function", f"is called as {self.function}({called}): {error}") from None
        return self


class NoSources(Section):
    """No foregrounds."""

    kind: Literal["none"]


Foregrounds = Annotated[
    GleamSources | SyntheticSources | FileSources | CodeSources | NoSources, choice("kind", "g4jy-and-counts")
]


class DiffuseMap(Section):
    """Fields of all maps of diffuse emission."""

    spectral_index: float = Field(
        -2.55,
        ge=-4,
        le=2,
        description="Of the brightness temperature, the same everywhere; flux has 2 more; the default is a "
        "choice of this project.",
    )
    nside: Literal[16, 32, 64, 128, 256] = Field(
        256, description="HEALPix resolution; pixels should be smaller than half a fringe of the longest baseline."
    )


class HaslamMap(DiffuseMap):
    """The 408 MHz all-sky survey (Haslam et al. 1982; 0.85 degrees, with its sources), from the mwa_pb package."""

    kind: Literal["haslam"]


class SyntheticDiffuse(DiffuseMap):
    """A Gaussian field with a power-law angular spectrum about a mean temperature, without a Galactic plane."""

    kind: Literal["synthetic"]
    frequency: Frequency = Field(180e6, gt=0, description="At which the temperatures are meant.")
    mean: Temperature = Field(180.0, description="Mean brightness temperature, which only short baselines see.")
    rms: Temperature = Field(
        40.0, ge=0, description="Of the fluctuations, of all multipoles up to 767 (of fewer, if nside is below 256)."
    )
    angular_index: float = Field(2.5, ge=0, le=4, description="C_l is proportional to l to the minus this.")
    seed: int = Field(21, ge=0, description="Seed of the fluctuations.")


class NoDiffuse(Section):
    """No diffuse emission."""

    kind: Literal["none"] = "none"


Diffuse = Annotated[HaslamMap | SyntheticDiffuse | NoDiffuse, choice("kind")]


class Eor(Section):
    """Gaussian random 21 cm brightness with a known power spectrum, as one HEALPix map per channel."""

    spectrum: Literal["flat", "power-law", "table", "box"] = "flat"
    amplitude: PowerDensity = Field(
        12482.356, gt=0, description="P(k), or P at `pivot_k` for a power law (paper §Simulations)."
    )
    index: float = Field(0.0, ge=-3.5, le=1.0, description="P(k) = amplitude (k / pivot)^index; only for a power law.")
    pivot_k: float = Field(0.1, gt=0, description="Pivot of the power law, in 1/Mpc (no h).")
    path: Path | None = Field(
        None,
        description="For spectrum: table, a text file with k in h/Mpc and P(k) in mK^2 h^-3 Mpc^3 in two columns, for "
        "the redshift of the data. For spectrum: box, a coeval box or a lightcone saved by 21cmFAST 3 or 4, whose P(k) "
        "is used as such a table. P is a power law between two k, and constant beyond the first and the last.",
    )
    nside: Literal[16, 32, 64, 128, 256] = Field(
        256,
        description="HEALPix resolution; unless the spectrum is flat, 3 nside - 1 must be above the multipoles that "
        "the longest baseline sees.",
    )
    seed: int = Field(2, ge=0, description="Seed of the maps.")

    @model_validator(mode="after")
    def _fields_are_used(self) -> Eor:
        if self.index and self.spectrum != "power-law":
            raise fault("index", f"{self.index:g} has no effect with spectrum: {self.spectrum}; use power-law")
        if (self.path is None) == (self.spectrum in ("table", "box")):
            raise fault("path", "is needed with spectrum: table or box, and has no effect with others")
        return self


class SkySettings(Section):
    """The foregrounds and the 21 cm signal."""

    foregrounds: Foregrounds = SyntheticSources()
    diffuse: Diffuse = Field(NoDiffuse(), description="Galactic emission, added to the foregrounds.")
    eor: Eor = Eor()

    @property
    def has_foregrounds(self) -> bool:
        """Whether there are sources or diffuse emission."""
        return self.foregrounds.kind != "none" or self.diffuse.kind != "none"
