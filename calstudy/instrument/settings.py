"""The `instrument` section of an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.plugins import Plugin, Registry
from calstudy.base.schema import Section, choice, fault
from calstudy.base.units import Frequency, HourAngle, Length, Time


class MwaLayout(Section):
    """Tiles of the MWA Phase II compact configuration (paper §Simulations; Wayth et al. 2018)."""

    kind: Literal["mwa-compact-minredundant", "mwa-compact-hex-east", "mwa-compact-hex-south", "mwa-compact"] = Field(
        "mwa-compact-minredundant",
        description="The first 36 tiles of the core, one of the two 36-tile hexagons, or all 128 tiles.",
    )
    count: int | None = Field(None, ge=2, description="Keep only the first `count` antennas (all by default).")

    @model_validator(mode="after")
    def _enough_antennas(self) -> MwaLayout:
        size = 128 if self.kind == "mwa-compact" else 36
        if self.count is not None and self.count > size:
            raise ValueError(f"count = {self.count} is more than the {size} antennas of {self.kind}")
        return self


class HexLayout(Section):
    """A filled regular hexagon, flat, at the MWA site."""

    kind: Literal["hex"]
    side: int = Field(4, ge=2, description="Antennas along one side; 4 gives 37 antennas.")
    spacing: Length = Field(14.0, gt=0, description="Distance between neighbours.")


class LinearLayout(Section):
    """An east-west line of equally spaced antennas (paper Fig. MAXBL_RUNTIME)."""

    kind: Literal["linear"]
    count: int = Field(10, ge=2)
    spacing: Length = Field(14.0, gt=0)


class RectangularLayout(Section):
    """Rows of eight antennas, spread so that the longest baseline is `max_baseline` (paper Fig. ANTPOS_RUNTIME)."""

    kind: Literal["rectangular"]
    count: int = Field(16, ge=9, description="Number of antennas; at least nine, so that there are two rows.")
    spacing: Length = Field(2.0, gt=0, description="Distance between neighbours in a row.")
    max_baseline: Length = Field(100.0, gt=0)

    @model_validator(mode="after")
    def _rows_fit(self) -> RectangularLayout:
        if self.max_baseline <= 7 * self.spacing:
            raise ValueError(
                f"max_baseline = {self.max_baseline:g} m must exceed the length of a row, 7 x spacing = "
                f"{7 * self.spacing:g} m"
            )
        return self


class GolombLayout(Section):
    """An east-west line at the marks of an optimal Golomb ruler: every baseline is unique."""

    kind: Literal["golomb"]
    count: int = Field(8, ge=2, le=12, description="Number of antennas (marks of the ruler).")
    spacing: Length = Field(4.0, gt=0, description="Length of one unit of the ruler.")


class CsvLayout(Section):
    """Positions from a CSV file with columns east_m, north_m, up_m and, optionally, name and number."""

    kind: Literal["csv"]
    path: Path = Field(strict=False, description="CSV file, relative to the experiment file or absolute.")


Layout = Annotated[
    MwaLayout | HexLayout | LinearLayout | RectangularLayout | GolombLayout | CsvLayout,
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

    first: Frequency = Field(167.075e6, gt=0, description="Centre of the first channel.")
    width: Frequency = Field(80e3, gt=0)
    count: int = Field(384, ge=8)

    @property
    def band(self) -> tuple[float, float]:
        """Centres of the first and the last channel, Hz."""
        return self.first, self.first + (self.count - 1) * self.width


class Times(Section):
    """Equally spaced integrations; the default is the paper's (56 x 2 s from LST 1.8 h)."""

    start_lst: HourAngle = Field(
        1.8, ge=0, lt=24, description="Local sidereal time at the centre of the first integration."
    )
    integration: Time = Field(2.0, gt=0)
    count: int = Field(56, ge=1)


class InstrumentSettings(Section):
    """Positions and beams of the antennas, and times and frequencies of the observation."""

    layout: Layout = MwaLayout()
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

    def without_beams(self) -> InstrumentSettings:
        """Return the instrument with the default beam: for what reads antennas, channels and times only."""
        return self.reset("beam", "antenna_beams")

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
