"""The `instrument` section of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.plugins import Plugin, Registry
from calstudy.base.schema import Section, choice, fault
from calstudy.base.units import Angle, Frequency, HourAngle, Length, Time
from calstudy.instrument.as_built import AsBuilt

# Longest observation, s.
LONGEST = 86_400.0


class Site(Section):
    """A known site. By default HERA's own arrays are at its site, and all other layouts but CSV files at the MWA's."""

    kind: Literal["mwa", "hera", "paper", "ovro-lwa"]


class Coordinates(Section):
    """A site by its coordinates on the WGS84 ellipsoid."""

    kind: Literal["coordinates"]
    latitude: Angle = Field(ge=-90, le=90, description="North is positive.")
    longitude: Angle = Field(ge=-180, le=360, description="East is positive.")
    height: Length = Field(0.0, gt=-1e4, lt=1e5, description="Above the ellipsoid.")


Location = Annotated[Site | Coordinates, Field(discriminator="kind"), choice("kind", "coordinates")]


class ArrayLayout(Section):
    """Positions of antennas; `site` is the site of the array unless `instrument.location` is given."""

    site: ClassVar[Literal["mwa", "hera"]] = "mwa"
    kind: str


class NamedLayout(ArrayLayout):
    """Antennas of an existing array, or a part of it."""

    sizes: ClassVar[Mapping[str, int]]
    """Number of antennas of each kind."""

    count: int | None = Field(None, ge=2, description="Keep only the first `count` antennas (all by default).")

    @property
    def antennas(self) -> int:
        """Number of antennas."""
        return self.count or self.sizes[self.kind]

    @model_validator(mode="after")
    def _enough_antennas(self) -> Self:
        size = self.sizes[self.kind]
        if self.count is not None and self.count > size:
            raise fault("count", f"{self.count} is more than the {size} antennas of {self.kind}")
        return self


class MwaLayout(NamedLayout):
    """Tiles of the MWA: Phase II compact (paper §Simulations), Phase II extended, or Phase I (Wayth et al. 2018)."""

    sizes: ClassVar[Mapping[str, int]] = {
        "mwa-compact-minredundant": 36,
        "mwa-compact-hex-east": 36,
        "mwa-compact-hex-south": 36,
        "mwa-compact": 128,
        "mwa-extended": 128,
        "mwa-phase1": 128,
    }
    kind: Literal[
        "mwa-compact-minredundant",
        "mwa-compact-hex-east",
        "mwa-compact-hex-south",
        "mwa-compact",
        "mwa-extended",
        "mwa-phase1",
    ] = Field(
        "mwa-compact-minredundant",
        description="The first 36 tiles of the core, one of the two 36-tile hexagons, or all 128 tiles of a "
        "configuration.",
    )


class HeraLayout(NamedLayout):
    """HERA at its own site: antennas 14.6 m apart, flat, as designed (DeBoer et al. 2017; Dillon & Parsons 2016).

    `hera-19` and `hera-37` are filled hexagons. `hera-320` is the core, a hexagon in three sectors that are displaced
    relative to each other by a third of the unit cell; `hera-350` has the 30 outriggers as well. `hera-128` is the
    first 128 antennas of the core. Antennas of the last three have HERA's numbers, from the south.
    """

    site: ClassVar[Literal["mwa", "hera"]] = "hera"
    sizes: ClassVar[Mapping[str, int]] = {
        "hera-19": 19,
        "hera-37": 37,
        "hera-128": 128,
        "hera-320": 320,
        "hera-350": 350,
    }
    kind: Literal["hera-19", "hera-37", "hera-128", "hera-320", "hera-350"]


class HexLayout(ArrayLayout):
    """A filled regular hexagon, flat."""

    kind: Literal["hex"]
    side: int = Field(4, ge=2, le=26, description="Antennas along one side; 4 gives 37 antennas.")
    spacing: Length = Field(14.0, ge=0.01, description="Distance between neighbours.")


class LinearLayout(ArrayLayout):
    """An east-west line of equally spaced antennas (paper Fig. MAXBL_RUNTIME)."""

    kind: Literal["linear"]
    count: int = Field(10, ge=2, le=2000)
    spacing: Length = Field(14.0, ge=0.01)


class RectangularLayout(ArrayLayout):
    """Rows of eight antennas, spread so that the longest baseline is `max_baseline` (paper Fig. ANTPOS_RUNTIME)."""

    kind: Literal["rectangular"]
    count: int = Field(16, ge=9, le=2000, description="Number of antennas; at least nine, so that there are two rows.")
    spacing: Length = Field(2.0, ge=0.01, description="Distance between neighbours in a row.")
    max_baseline: Length = Field(100.0, gt=0)

    @model_validator(mode="after")
    def _rows_fit(self) -> RectangularLayout:
        if self.max_baseline <= 7 * self.spacing:
            raise fault(
                "max_baseline",
                f"{self.max_baseline:g} m must exceed the length of a row, 7 x spacing = {7 * self.spacing:g} m",
            )
        return self


class GolombLayout(ArrayLayout):
    """An east-west line at the marks of an optimal Golomb ruler: every baseline is unique."""

    kind: Literal["golomb"]
    count: int = Field(8, ge=2, le=16, description="Number of antennas (marks of the ruler).")
    spacing: Length = Field(4.0, ge=0.01, description="Length of one unit of the ruler.")


class CsvLayout(ArrayLayout):
    """Positions from a CSV file with columns east_m, north_m, up_m and, optionally, name and number.

    It requires `instrument.location`, because the file does not contain the position of the array.
    """

    kind: Literal["csv"]
    path: Path = Field(strict=False, description="CSV file, relative to the experiment file or absolute.")


Layout = Annotated[
    MwaLayout | HeraLayout | HexLayout | LinearLayout | RectangularLayout | GolombLayout | CsvLayout,
    Field(discriminator="kind"),
    choice("kind", "mwa-compact-minredundant"),
]


BEAMS: Registry[Any] = Registry("beam", "calstudy.instrument.beam_models", "calstudy.instrument.interface:BeamModel")
DEFAULT_BEAM = "mwa-embedded-element"
Beam = Annotated[SerializeAsAny[Plugin], BEAMS.field(DEFAULT_BEAM)]


class AntennaBeam(Section):
    """Antennas with a beam other than `instrument.beam`."""

    antennas: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)] = Field(
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
        if duration > LONGEST:
            raise fault(
                "",
                f"{self.count} integrations of {self.integration:g} s are {duration / 3600:.4g} h; a day is the most",
            )
        return self


class InstrumentSettings(Section):
    """Positions and beams of the antennas, and times and frequencies of the observation."""

    layout: Layout = MwaLayout()
    location: Location | None = Field(
        None,
        description="Where the array is: the name of a site, or coordinates; null: the site of the layout, HERA's for "
        "its arrays and the MWA's for all others. Required for positions from a CSV file.",
    )
    beam: Beam = Field(default_factory=lambda: BEAMS.make(DEFAULT_BEAM))
    antenna_beams: dict[str, AntennaBeam] = Field(
        default_factory=dict,
        description="Sets of antennas with another beam, with any names. Power spectra are normalized with `beam`.",
    )
    channels: Channels = Channels()
    times: Times = Times()
    polarizations: Annotated[tuple[Literal["xx", "yy"], ...], Field(strict=False, min_length=1, max_length=2)] = Field(
        ("xx",), description="Linear polarizations, calibrated independently: xx (east-west dipoles), yy, or both."
    )

    as_built: AsBuilt = AsBuilt()

    @property
    def site(self) -> Site | Coordinates:
        """The site of the array."""
        return Site(kind=self.layout.site) if self.location is None else self.location

    def nominal(self) -> InstrumentSettings:
        """Return the instrument as designed, which calibrators and figures assume."""
        return self.reset("as_built")

    def without_beams(self) -> InstrumentSettings:
        """Return the nominal instrument with the default beam, for code that reads antennas, channels and times."""
        return self.reset("beam", "antenna_beams", "as_built")

    @model_validator(mode="after")
    def _positions_of_a_file_have_a_place(self) -> InstrumentSettings:
        if isinstance(self.layout, CsvLayout) and self.location is None:
            sites = ", ".join(get_args(Site.model_fields["kind"].annotation))
            raise fault(
                "location",
                "is required where instrument.layout is a CSV file: the name of a site "
                f"({sites}), or coordinates (latitude and longitude)",
            )
        return self

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
