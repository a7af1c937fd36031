"""What a run-time file says: arrays of growing size on which the solvers' steps are timed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator
from scipy.constants import speed_of_light

from calstudy.calibrate.settings import BasisSettings
from calstudy.errors import ExperimentError
from calstudy.experiment.files import apply_scale, override, parse_override
from calstudy.experiment.messages import sentences
from calstudy.instrument.settings import Channels
from calstudy.schema import Section, fault
from calstudy.units import Length

KEY = "runtime"
"""The key that makes a file a run-time study."""


def _require_increasing(sizes: Sequence[float]) -> None:
    if list(sizes) != sorted(set(sizes)):
        raise fault("", f"must increase, and name no size twice: {', '.join(f'{size:g}' for size in sizes)}")


class RowsOfEight(Section):
    """Rows of eight antennas, as far apart as the longest baseline allows (paper Fig. ANTPOS_RUNTIME)."""

    antennas: Annotated[
        tuple[Annotated[int, Field(ge=9)], ...], Field(strict=False, min_length=3, description="Sizes, increasing.")
    ] = (16, 24, 32, 48, 64, 96, 128)
    spacing: Length = Field(2.0, gt=0, description="Distance between neighbours in a row.")
    max_baseline: Length = Field(100.0, gt=0)

    @field_validator("antennas")
    @classmethod
    def _increasing(cls, sizes: tuple[int, ...]) -> tuple[int, ...]:
        _require_increasing(sizes)
        return sizes

    @model_validator(mode="after")
    def _rows_fit(self) -> RowsOfEight:
        if self.max_baseline <= 7 * self.spacing:
            raise fault(
                "max_baseline", f"{self.max_baseline:g} m must exceed the length of a row, {7 * self.spacing:g} m"
            )
        return self


class Line(Section):
    """Lines of equally spaced antennas of growing length (paper Fig. MAXBL_RUNTIME)."""

    lengths: Annotated[
        tuple[Annotated[Length, Field(gt=0)], ...],
        Field(strict=False, min_length=3, description="Longest baselines, increasing."),
    ] = (20.0, 35.0, 50.0, 75.0, 100.0, 150.0, 200.0)
    count: int = Field(10, ge=3, description="Antennas of each.")

    @field_validator("lengths")
    @classmethod
    def _increasing(cls, sizes: tuple[float, ...]) -> tuple[float, ...]:
        _require_increasing(sizes)
        return sizes


class SampleCounts(Section):
    """How often each thing is timed, for every array."""

    steps: int = Field(200, ge=10, description="Single steps of the paper's solver.")
    calls: int = Field(20, ge=3, description="Calls of our Adamax, of 50 compiled steps each; their means are samples.")
    solves: int = Field(10, ge=2, description="Whole solves of the default solver, from unity gains.")


class DescentSettings(Section):
    """A run of the paper's solver, Adamax at 0.01, to count the steps it needs."""

    antennas: int = Field(32, ge=9, description="Of a rectangular array like the others.")
    max_steps: int = Field(20_000, ge=50)


class RuntimeSettings(Section):
    """Run time of one step against the number of antennas and the longest baseline (paper §Computational Runtime).

    The channels are by default 200 of 300 kHz from 120.15 MHz.
    """

    rows: RowsOfEight = RowsOfEight()
    line: Line = Line()
    channels: Channels = Channels(first="120.15 MHz", width="300 kHz", count=200)
    basis: BasisSettings = BasisSettings()
    samples: SampleCounts = SampleCounts()
    descent: DescentSettings = DescentSettings()
    devices: Annotated[tuple[Literal["cpu", "gpu"], ...], Field(strict=False, min_length=1)] = Field(
        ("cpu",), description="One core of the processor, in processor seconds; the first GPU, in elapsed seconds."
    )

    @model_validator(mode="after")
    def _channels_hold_the_basis(self) -> RuntimeSettings:
        longest = max(self.rows.max_baseline, *self.line.lengths)
        delay = max(self.basis.horizon * longest / speed_of_light, self.basis.min_delay) + self.basis.buffer
        nyquist = 0.5 / self.channels.width
        if delay + self.basis.delay_step >= nyquist:
            raise fault(
                "channels.width",
                f"{self.channels.width / 1e3:g} kHz resolves {1e9 * nyquist:.0f} ns, and the foregrounds of a baseline "
                f"of {longest:g} m reach {1e9 * delay:.0f} ns",
            )
        return self


class RuntimeOutputs(Section):
    """Where products and run folders go."""

    store: Path = Field(Path("store"), strict=False, description="Folder of products, shared by all studies.")
    runs: Path = Field(Path("runs"), strict=False, description="Folder in which each run gets its own folder.")


class RuntimeStudy(Section):
    """Steps of the paper's solver, of our Adamax and of the default solver, timed side by side on this machine."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$", description="Names the run folder.")
    description: str = ""
    runtime: RuntimeSettings
    outputs: RuntimeOutputs = RuntimeOutputs()
    scales: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Named sets of overrides (dotted path: value), chosen with --scale."
    )


def validate_runtime(data: Mapping[str, Any], scale: str | None = None, overrides: Sequence[str] = ()) -> RuntimeStudy:
    """Validate the content of a run-time file; parameters and errors as for `calstudy.experiment.files.load`."""
    plain = apply_scale(data, scale)
    for text in overrides:
        plain = override(plain, *parse_override(text))
    try:
        return RuntimeStudy.model_validate(plain)
    except ValidationError as error:
        raise ExperimentError(sentences(error, RuntimeStudy, plain)) from None
