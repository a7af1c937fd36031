"""The `instrument` section of an experiment file, and the size of an instrument's data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.observation import Frame
from calstudy.base.plugins import Plugin, Registry
from calstudy.base.schema import REVISED, Section, choice, fault
from calstudy.base.units import Angle, Frequency, HourAngle, Length, Time
from calstudy.instrument.as_built import Antennas, AsBuilt, Misalignment, dipole_amplitudes, misalignments


class Site(Section):
    """A known site. By default HERA's own arrays are at its site, and all other layouts but CSV files at the MWA's."""

    kind: Literal["mwa", "hera", "paper", "ovro-lwa"]


class Coordinates(Section):
    """A site by its coordinates on the WGS84 ellipsoid."""

    kind: Literal["coordinates"]
    latitude: Angle = Field(ge=-90, le=90, description="North is positive.")
    longitude: Angle = Field(ge=-180, le=360, description="East is positive.")
    height: Length = Field(0.0, gt=-1e4, lt=1e5, description="Above the ellipsoid.")


Location = Annotated[Site | Coordinates, choice("kind", "coordinates")]


LAYOUTS: Registry[Any] = Registry(
    "layout", "calstudy.instrument.array_layouts", "calstudy.instrument.layouts:ArrayLayout", families=True
)
DEFAULT_LAYOUT = "mwa-compact-minredundant"
Layout = Annotated[SerializeAsAny[Plugin], LAYOUTS.field(DEFAULT_LAYOUT)]

BEAMS: Registry[Any] = Registry(
    "beam", "calstudy.instrument.beam_models", "calstudy.instrument.interface:BeamModel", families=True
)
DEFAULT_BEAM = "mwa-embedded-element"
Beam = Annotated[SerializeAsAny[Plugin], BEAMS.field(DEFAULT_BEAM)]


class AntennaBeam(Section):
    """Antennas with a beam other than `instrument.beam`."""

    antennas: Annotated[Antennas, Field(min_length=1)] = Field(
        description="Antennas, counted from 0 in the order of the layout."
    )
    beam: Beam = Field(description="Their beam; the kinds are those of `instrument.beam`.")


class Channels(Section):
    """Equally spaced channel centres; the default is the paper's (384 x 80 kHz from 167.075 MHz)."""

    first: Frequency = Field(167.075e6, ge=10e6, description="Centre of the first channel.")
    width: Frequency = Field(80e3, ge=100.0, le=10e6, description="Width of a channel, and distance to the next.")
    count: int = Field(384, ge=8, le=65_536)

    @property
    def band(self) -> tuple[float, float]:
        """Centres of the first and the last channel, Hz."""
        return self.first, self.first + (self.count - 1) * self.width

    @property
    def frequencies(self) -> np.ndarray:
        """Centres of all channels, (Nfreqs,), Hz."""
        return self.first + self.width * np.arange(self.count)

    @property
    def label(self) -> str:
        """Number, width and first of the channels."""
        return f"{self.count} channels of {self.width / 1e3:g} kHz from {self.first / 1e6:g} MHz"


class Times(Section):
    """Equally spaced integrations; the default is the paper's (56 x 2 s from LST 1.8 h)."""

    start_lst: HourAngle = Field(
        1.8, ge=0, lt=24, description="Local sidereal time at the centre of the first integration."
    )
    integration: Time = Field(2.0, ge=1e-3, le=3600.0, description="Duration of one, and distance to the next.")
    count: int = Field(56, ge=1, le=100_000)

    @model_validator(mode="after")
    def _end_within_a_day(self) -> Times:
        duration = self.integration * self.count
        if duration > SECONDS_PER_DAY:
            raise fault(
                "",
                f"{self.count} integrations of {self.integration:g} s are {duration / 3600:.4g} h; a day is the most",
            )
        return self


def _own_site(layout: Plugin) -> Any:
    # `ArrayLayout` has it, which this module cannot import.
    return getattr(layout, "site", None)


class InstrumentSettings(Section):
    """Positions and beams of the antennas, and times and frequencies of the observation."""

    layout: Layout = Field(default_factory=lambda: LAYOUTS.make(DEFAULT_LAYOUT))
    location: Location | None = Field(
        None,
        validate_default=True,
        description="Where the array is: the name of a site, or coordinates; null: the site of the layout, HERA's for "
        "its arrays and the MWA's for all others. Required for positions from a CSV file.",
    )
    beam: Beam = Field(default_factory=lambda: BEAMS.make(DEFAULT_BEAM))
    antenna_beams: dict[str, AntennaBeam] = Field(
        default_factory=dict,
        description="Sets of antennas with another beam, with any names. Power spectra are normalized with `beam`.",
        json_schema_extra={REVISED: 2},
    )
    channels: Channels = Channels()
    times: Times = Times()
    polarizations: Annotated[tuple[Literal["xx", "yy"], ...], Field(min_length=1, max_length=2)] = Field(
        ("xx",), description="Linear polarizations, calibrated independently: xx (east-west dipoles), yy, or both."
    )

    as_built: AsBuilt = AsBuilt()

    @property
    def site(self) -> Site | Coordinates:
        """The site of the array."""
        return Site(kind=_own_site(self.layout)) if self.location is None else self.location

    def nominal(self) -> InstrumentSettings:
        """Return the instrument as designed, which calibrators and figures assume."""
        return self.with_defaults("as_built")

    def without_beams(self) -> InstrumentSettings:
        """Return the nominal instrument with the default beam, for code that reads antennas, channels and times."""
        return self.with_defaults("beam", "antenna_beams", "as_built")

    @field_validator("location")
    @classmethod
    def _positions_of_a_file_have_a_place(cls, value: Location | None, info: ValidationInfo) -> Location | None:
        layout = info.data.get("layout")
        if layout is not None and _own_site(layout) is None and value is None:
            sites = ", ".join(get_args(Site.model_fields["kind"].annotation))
            raise fault(
                "",
                f"is required for instrument.layout {layout.label!r}, which is at no site: the name of a site "
                f"({sites}), or coordinates (latitude and longitude)",
            )
        return value

    @model_validator(mode="after")
    def _polarizations_are_unique(self) -> InstrumentSettings:
        if len(set(self.polarizations)) != len(self.polarizations):
            raise fault("polarizations", f"names a polarization twice: {', '.join(self.polarizations)}")
        return self

    @model_validator(mode="after")
    def _antennas_have_one_beam(self) -> InstrumentSettings:
        seen: set[int] = set()
        for name, group in self.antenna_beams.items():
            twice = seen.intersection(group.antennas)
            if twice or len(set(group.antennas)) != len(group.antennas):
                raise fault(f"antenna_beams.{name}.antennas", "contains an antenna that is already in a set")
            seen.update(group.antennas)
        return self


@dataclass(frozen=True)
class Size:
    """Dimensions of a data set and of its array; `longest` and `mean` are estimates of baseline lengths, m."""

    antennas: int
    times: int
    channels: Channels
    polarizations: int
    longest: float
    mean: float

    @classmethod
    def of_frame(cls, frame: Frame) -> Size:
        """Return the size of data with these antennas, baselines and channels."""
        spacings = np.abs(np.diff(frame.frequencies))
        channels = {"first": frame.frequencies.min(), "width": np.median(spacings) if spacings.size else 0.0}
        lengths = frame.lengths[~frame.autos]
        return cls(
            antennas=frame.n_antennas,
            times=frame.n_times,
            # Measured data may have fewer channels than a simulation may.
            channels=Channels.model_construct(**channels, count=frame.n_channels),
            polarizations=frame.n_polarizations,
            longest=float(lengths.max(initial=0.0)),
            mean=float(lengths.mean()) if lengths.size else 0.0,
        )

    @property
    def baselines(self) -> int:
        """Number of baselines without autocorrelations."""
        return self.antennas * (self.antennas - 1) // 2

    @property
    def samples(self) -> int:
        """Number of visibilities."""
        return self.baselines * self.times * self.channels.count * self.polarizations


class AssignedBeam(NamedTuple):
    """Specification of the beam of an antenna; antennas with equal ones share a beam.

    `model` is the index of the nominal beam in the result of `nominal_beams`. `amplitudes` are those of the dipoles of
    feeds x and y, or None if they are all one.
    """

    model: int
    amplitudes: tuple[tuple[float, ...], ...] | None
    misalignment: Misalignment


def nominal_beams(settings: InstrumentSettings) -> list[Plugin]:
    """Return the distinct nominal beams, `instrument.beam` first."""
    distinct: list[Plugin] = [settings.beam]
    for group in settings.antenna_beams.values():
        if group.beam not in distinct:
            distinct.append(group.beam)
    return distinct


def beam_count(settings: InstrumentSettings, count: int) -> int:
    """Return the number of distinct beams of `count` antennas as built; errors are those of `assigned_beams`."""
    return len(set(assigned_beams(settings, count)))


def assigned_beams(settings: InstrumentSettings, count: int) -> list[AssignedBeam]:
    """Return the beams of `count` antennas as built; raises InputError if all dipoles of a feed are dead."""
    distinct, index = nominal_beams(settings), np.zeros(count, dtype=int)
    for group in settings.antenna_beams.values():
        index[list(group.antennas)] = distinct.index(group.beam)
    built = settings.as_built
    amplitudes, errors = dipole_amplitudes(built.dipoles, count), misalignments(built.beams, count)
    return [
        AssignedBeam(int(model), None if (weights == 1).all() else tuple(map(tuple, weights.tolist())), misalignment)
        for model, weights, misalignment in zip(index, amplitudes, errors, strict=True)
    ]
