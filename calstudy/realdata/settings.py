"""The sections `observed` and `injection` of a file about measured data."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializeAsAny,
    ValidationInfo,
    field_validator,
    model_validator,
)

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.plugins import Plugin
from calstudy.base.schema import Section, choice, fault
from calstudy.base.units import Decibel, FluxDensity
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.corrupt.noise import SystemTemperature
from calstudy.instrument.settings import BEAMS
from calstudy.realdata.selection import Selection, parse_values
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.settings import Eor

DEFAULT = "calamity"
# Real data of few baselines have directions that converge slowly, at next to no cost.
PATIENT = {"name": "gauss-newton", "max_steps": 500}
IN_PACKAGE = re.compile(r"(?P<package>[A-Za-z_][A-Za-z0-9_.]+):(?P<path>[^/\\].*)")
"""A file of an installed package: ``hera_qm:data/zen.uvh5``."""


def find_data(text: str, folder: Path) -> Path:
    """Return the absolute path of a file or folder from ``package:path``, or from a path relative to `folder`.

    Raise InputError if there is no such package, file or folder.
    """
    if "\0" in text:
        raise InputError(f"{text!r} cannot be the path of a file")
    if (packaged := IN_PACKAGE.fullmatch(text)) is not None:
        path = _folder_of(packaged["package"], text) / packaged["path"]
    else:
        try:
            path = folder / Path(text).expanduser()
        except RuntimeError:
            raise InputError(f"{text!r}: there is no such home folder") from None
    with errors_of_files(f"{text!r}: cannot be read"):
        found = path.exists()
    if not found:
        raise InputError(f"{text!r}: no such file or folder (looked for {path.resolve()})")
    return path.resolve()


def _find(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, str | Path):
        return value
    try:
        return find_data(str(value), (info.context or {}).get("folder") or Path())
    except InputError as error:
        raise fault("", str(error)) from None


def _folder_of(package: str, text: str) -> Path:
    try:
        found = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        found = None
    if found is None or not found.submodule_search_locations:
        raise InputError(f"{text!r}: there is no installed package {package!r}")
    return Path(found.submodule_search_locations[0])


def _as_list(paths: Any) -> Any:
    return [paths] if isinstance(paths, str | Path) else paths


def _require_different(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    for place, path in enumerate(paths):
        if path in paths[:place]:
            raise fault("", f"{path} is given twice; leave one out")
    return paths


DataFile = Annotated[Path, BeforeValidator(_find)]
DataFiles = Annotated[
    tuple[DataFile, ...],
    BeforeValidator(_as_list, json_schema_input_type=str | tuple[str, ...]),
    AfterValidator(_require_different),
]


def _require_selection(key: str, value: str) -> str:
    try:
        parse_values({key: value}, "")
    except InputError as error:
        raise fault("", f"{value!r}: {str(error).partition(': ')[2]}") from None
    return value


FrequencyRange = Annotated[str, AfterValidator(lambda value: _require_selection("frequencies", value))]


class Select(Section):
    """A part of the data, as `--select` of `calstudy calibrate` takes it; ranges include both ends."""

    antennas: str | None = Field(
        None,
        description="Numbers or names: '0,1,12'; 'number:1' or 'name:1' where a name is the number of another antenna.",
    )
    lengths: str | None = Field(None, description="Baseline lengths: '14 m..60 m'.")
    times: str | None = Field(None, description="Integrations, counted from 0: '0..9'.")
    frequencies: str | None = Field(None, description="Channel centres: '120 MHz..180 MHz'.")
    polarizations: str | None = Field(None, description="Such as 'xx,yy'; or 'ee,nn', by the directions of the feeds.")

    @field_validator("*")
    @classmethod
    def _can_be_read(cls, value: str | None, info: ValidationInfo) -> str | None:
        return value if value is None else _require_selection(str(info.field_name), value)

    @property
    def selection(self) -> Selection:
        """The part of the data; a selection of lengths keeps the autocorrelations, from which the noise is known."""
        given = {name: value for name, value in self.model_dump().items() if value is not None}
        return parse_values(given, "observed.select.", autos=True)


class Factor(Section):
    """One unit of the data is a constant number of Jy."""

    kind: Literal["factor"]
    unit: FluxDensity = Field(gt=0, description="What one unit of the data is.")


class FromAutocorrelations(SystemTemperature):
    """The median autocorrelation is that of the system temperature: receiver + sky (nu / sky_frequency)^sky_index.

    In Jy it is k_B T / A_e with A_e = wavelength^2 over the solid angle of `observed.beam`. One number for each half.
    """

    kind: Literal["system-temperature"]


FluxScale = Annotated[Factor | FromAutocorrelations, choice("kind")]


class Interference(Section):
    """Thresholds for flags of data that stand out from their surroundings."""

    significance: float = Field(6.0, ge=2, le=100, description="Standard deviations.")
    adjacent_significance: float = Field(
        2.0, ge=1, le=100, description="For samples beside flagged ones, in time or frequency."
    )


def _as_block(value: Any) -> Any:
    """Take true for the defaults, and false for none."""
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


class DataSettings(Section):
    """Measured visibilities in any format that pyuvdata reads, and what is known of them."""

    holds_input_files: ClassVar[bool] = False  # `find_data` finds files and folders.

    data: DataFiles = Field(min_length=1, description="A file or folder, or several that belong together.")
    select: Select = Select()
    flag: tuple[FrequencyRange, ...] = Field(
        (), description="Channels that are flagged, such as those of known interference: ['149.7 MHz..150.2 MHz']."
    )
    flag_interference: Annotated[
        Interference | None, BeforeValidator(_as_block, json_schema_input_type=Interference | bool | None)
    ] = Field(
        None,
        description="Flag what stands out in time and frequency in several baselines, by hera_qm: true, or a block; "
        "null: nothing.",
    )
    positions: DataFile | None = Field(
        None,
        description="Antenna positions in place of those in the data: a CSV file with columns number, east_m, north_m "
        "and up_m.",
    )
    sky_model: DataFile | None = Field(
        None, description="Visibilities of the sky as far as it is known, in Jy, with the times and channels of `data`."
    )


class ObservedSettings(DataSettings):
    """Measured visibilities in any format that pyuvdata reads; paths start at the file, or are ``package:path``."""

    odd: DataFiles = Field(
        (),
        description="Other data of the same sky, such as another night at the same sidereal time: spectra are data x "
        "odd. Empty: every second integration of `data`.",
    )
    difference: DataFiles = Field(
        (),
        description="Differences of two samples, of a correlator whose sums are `data`, such as HERA's files .diff "
        "beside .sum: the halves are (data + difference) / 2 and (data - difference) / 2, of half the time.",
    )
    beam: Annotated[SerializeAsAny[Plugin], BEAMS.field()] = Field(
        description="The beam of the antennas; it normalizes power spectra, and the injected signal is seen through it."
    )
    flux_scale: FluxScale | None = Field(
        None,
        description="How data become Jy that are in another unit; null: they are in Jy, or become so by the gains, "
        "where there is a sky model.",
    )
    pol_convention: Literal["sum", "avg"] | None = Field(
        None,
        description="Convention of files in Jy that do not tell it: I = XX + YY (sum, as pyuvsim has it), or half of "
        "that (avg, as CASA, LOFAR and the MWA have it). A mistake makes a factor of four in power. null: sum.",
    )

    @model_validator(mode="after")
    def _sky_model_is_of_one_data_set(self) -> ObservedSettings:
        if self.odd and self.sky_model is not None:
            raise fault("sky_model", "cannot have the times of both data and odd; leave out one of sky_model and odd")
        if self.odd and self.difference:
            raise fault("difference", "gives the halves, as odd does; leave out one of difference and odd")
        return self


class InjectionSettings(Section):
    """A simulated EoR that is added to the data under the fitted gains."""

    eor: Eor = Field(Eor(nside=128), description="As `sky.eor` of an experiment.")
    level: Decibel | None = Field(
        -30.0,
        le=0.0,
        description="rms of the EoR over that of the fitted foregrounds, 10 log10 of brightness: -30 dB is 1e-3; null: "
        "as `eor` says.",
    )
    simulation: SimulationSettings = SimulationSettings()


def defaults(has_sky_model: bool) -> dict[str, Any]:
    """Return default fields for measured data, which apply where a calibrator has them and the user does not set them.

    Without a model of the sky the scale is not known; visibilities of any phase may sum to zero.
    """
    return {"solver": PATIENT} if has_sky_model else {"solver": PATIENT, "prior": "gains"}


def with_defaults(content: Mapping[str, Any], chosen: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a file about measured data with the defaults in its section `calibration`.

    `chosen` is the content with the overrides, which tell the calibrator; relative paths start at `folder`. Invalid
    content is returned unchanged, because validation reports the error.
    """
    own, block = (_calibration(found) for found in (content, chosen))
    observed = chosen.get("observed")
    if own is None or block is None or not isinstance(observed, Mapping):
        return dict(content)
    try:
        found, _ = CALIBRATORS.class_of(block, DEFAULT, folder)
    except InputError:
        return dict(content)
    usual = defaults(observed.get("sky_model") is not None)
    return {**content, "calibration": {**{k: v for k, v in usual.items() if k in found.model_fields}, **own}}


def _calibration(content: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the section `calibration` as a block, or None if it is invalid."""
    section = content.get("calibration") or {}
    block = {CALIBRATORS.tag: section} if isinstance(section, str) else section
    return block if isinstance(block, Mapping) else None
