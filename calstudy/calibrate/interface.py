"""Interface of calibrators: settings, refusals, cost, and the calibration of visibilities.

Built-in calibrators are in the modules of `calstudy.calibrate.calibrators`. Your own is a subclass of `Calibrator` in a
file or an installed package (docs/extending.md). `calstudy.calibrate.execution` calls either.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.observation import Frame, Observation
from calstudy.base.plugins import Plugin, Registry
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.schema import REVISED, Section, choice, fault
from calstudy.base.units import Frequency, Time
from calstudy.calibrate.records import Solve
from calstudy.instrument.settings import Size

if TYPE_CHECKING:
    from pyuvdata import UVCal

Progress = Callable[[int, int], None]
"""Called after each solve with the number done and the total."""


@dataclass(frozen=True, eq=False)
class Assumed:
    """Information that a calibrator takes as given.

    Attributes
    ----------
    sky_model
        Visibilities of the known part of the sky, with the baselines, times, channels and polarizations of the data,
        in the same order; None if there are none.
    gains : gains to start from, None for unity. A calibrator that does not iterate may ignore them.
    noise
        Standard deviation of the complex noise of a sample that was measured once (nsamples of one), in the unit of
        the data; None if it is not known. Requested by `Calibrator.needs_noise`.
    """

    sky_model: Observation | None = None
    gains: UVCal | None = None
    noise: float | None = None


NO_SKY_MODEL = "needs a sky model, and there is none"

Outcome = Solve
"""The former name of `Solve`, for existing plug-ins."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """The result of a calibrator.

    Attributes
    ----------
    gains
        Gains g with V = g_a g_b* F: complex, shape (Nants, Nfreqs, Ntimes, Npols), for the antennas of the calibrated
        baselines in the order of their numbers (`Observation.numbers`, unless `baselines` leaves some out); or a UVCal
        of the convention "divide". In place of Ntimes there may be one for each solve of `integrations_per_solve`
        integrations.
    outcomes
        How the solves ended: one for each polarization and each group of integrations, polarization by polarization,
        each in the order of time; or a single one for all of them.
    gain_flags
        Mask of gains that must not be used, bool, like `gains`; None for none, or for those of the UVCal. Gains of
        antennas without data in a channel of an integration are flagged anyhow.
    model : the foregrounds F, (Ntimes, Nbls, Nfreqs, Npols), in the unit of the data; None for the sky model
    flags : samples that are excluded besides the flagged ones, like `model`; None for none
    baselines : mask of the calibrated baselines, bool, (Nbls,); None for all. Model and flags cover only these.
    closure
        Factors c of baselines that are no product of gains, V = c_ab g_a g_b* F, real or complex, like `model`; None:
        all are 1. They are for simulated data.
    """

    gains: np.ndarray | UVCal
    outcomes: Solve | Sequence[Solve]
    gain_flags: np.ndarray | None = None
    model: np.ndarray | None = None
    flags: np.ndarray | None = None
    baselines: np.ndarray | None = None
    closure: np.ndarray | None = None


@dataclass(frozen=True)
class SolvePlan:
    """Properties of a calibration that are known before it starts: the cost of all its solves, details and notes.

    Details are worth reporting besides the dimensions of the data, such as "640 foreground coefficients each". Notes
    are sentences on settings that will not work well.
    """

    cost: Cost
    details: str = ""
    notes: tuple[str, ...] = ()


class Smoothing(Section):
    """Settings that all ways to smooth gains have in common."""

    reference_antenna: int | None = Field(
        None,
        ge=0,
        description="Number of the antenna whose phase is made zero in every channel before; null: the phase of each "
        "channel, which no data determine, is turned so that neighbouring channels and integrations agree.",
    )
    axes: ClassVar[tuple[str, str]] = ("frequency_scale", "time_scale")
    """The fields of which one at least is given."""

    @model_validator(mode="after")
    def _smooths(self) -> Self:
        if all(getattr(self, name) is None for name in self.axes):
            raise fault("", f"needs a {self.axes[0]}, a {self.axes[1]}, or both")
        return self

    @property
    def over_time(self) -> bool:
        """Whether integrations are smoothed together."""
        return getattr(self, self.axes[1]) is not None


class DpssSmoothing(Smoothing):
    """Least-squares fit of discrete prolate spheroidal sequences in frequency and in time."""

    kind: Literal["dpss"]
    frequency_scale: Frequency | None = Field(
        None, gt=0, description="Delays beyond its inverse are removed; null: channels are left as they are."
    )
    time_scale: Time | None = Field(
        None, gt=0, description="Rates beyond its inverse are removed; null: integrations are left as they are."
    )


class PolynomialSmoothing(Smoothing):
    """Least-squares fit of polynomials in frequency and in time."""

    kind: Literal["polynomial"]
    frequency_degree: int | None = Field(None, ge=0, description="Null: channels are left as they are.")
    time_degree: int | None = Field(None, ge=0, description="Null: integrations are left as they are.")
    axes: ClassVar[tuple[str, str]] = ("frequency_degree", "time_degree")


class SmoothCal(Smoothing):
    """hera_cal's smooth_cal: sequences in time and frequency, with the mean delay of each antenna taken out."""

    kind: Literal["smooth-cal"]
    frequency_scale: Frequency = Field(10e6, gt=0, description="Delays beyond its inverse are removed.")
    time_scale: Time = Field(1800.0, gt=0, description="Rates beyond its inverse are removed.")


SmoothGains = Annotated[DpssSmoothing | PolynomialSmoothing | SmoothCal, choice("kind", "dpss")]


class Calibrator(Plugin):
    """A way to find gains. Fields of a subclass are its settings; `calibrate` finds the gains."""

    registry: ClassVar[Registry[Calibrator]] = Registry(
        "calibrator",
        "calstudy.calibrate.calibrators",
        "calstudy.calibrate.interface:Calibrator",
        tag="calibrator",
        families=True,
    )

    calibrator: str = Field("", description="Its name, or the path of a Python file that defines it.")
    integrations_per_solve: int = Field(
        1,
        ge=1,
        description="Consecutive integrations that are solved together and share their gains.",
        # Their weights have one mean together, and not each the same, since 2.
        json_schema_extra={REVISED: 2},
    )
    chunks: int = Field(
        4,
        ge=1,
        description="Pieces of consecutive integrations; the unit of resuming and of work sharing. In a piece a solve "
        "starts from the one before (`solver.warm_start`), and the first starts anew: where solves converge, results "
        "change by less than the solver's tolerance leaves; where they stall, as much as from another start.",
    )
    assumed: dict[str, Any] = Field(
        default_factory=dict,
        description="What the calibrator takes for granted that is not true: fields of `sky` and `instrument` (dotted "
        "path: value), from which its sky model is simulated; or `sky_model: PATH`, a file of visibilities. Empty: the "
        "sky model is the true foregrounds.",
    )
    smooth_gains: SmoothGains | None = Field(
        None,
        description="Smooth the gains once they are found, and calibrate with those; the model stays as it is.",
        # Without a reference antenna, phases of channels do not jump before they are smoothed since 2.
        json_schema_extra={REVISED: 2},
    )

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return in one sentence why data cannot be calibrated, or None if they can.

        Plans call this before there are data, and it is called again before data are calibrated. `has_sky_model` says
        whether `Assumed.sky_model` will be given. A sentence about a setting starts with its path and a colon, such as
        ``basis.buffer: must be ...``.
        """
        del frame, has_sky_model
        return None

    @property
    def needs_noise(self) -> bool:
        """Whether the calibrator uses `Assumed.noise`."""
        return False

    @property
    def needs_autos(self) -> bool:
        """Whether the data must have autocorrelations."""
        return False

    @property
    def on_sky_scale(self) -> bool:
        """Whether calibrated data have the unit of the sky model, where there is one, and not that of the data."""
        return True

    def cost(self, size: Size) -> Cost:
        """Return the cost of calibrating data of this size; by default little beyond the data themselves."""
        return Cost(5.0 + 1e-6 * size.samples, LIBRARIES_MEMORY + 6 * COMPLEX128 * size.samples)

    def plan(self, frame: Frame) -> SolvePlan:
        """Return the properties of a calibration of data with these baselines; by default the cost of their size."""
        return SolvePlan(self.cost(Size.of_frame(frame)))

    def with_less_memory(self) -> Self | None:
        """Return a calibrator with the same results that needs less memory; None if there is none."""
        return None

    @abstractmethod
    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Calibrate a whole number of groups of `integrations_per_solve` integrations; the last may be shorter.

        Arrays of the data are read-only; `assumed` may be taken as given. `progress`, if there is one, is called after
        each solve with the number done and the total.
        """

    def for_data(self, digest: str, sky_model: str | None = None) -> Self:
        """Return the calibrator of one data set of a run; by default the same for all data sets.

        Plans call this, with digests of all inputs of the data set and of the sky model, None if there is none. A
        calibrator that reads files for each data set overrides it, and may raise InputError.
        """
        del digest, sky_model
        return self

    def solves(self, n_times: int) -> list[slice]:
        """Return the groups of integrations that are solved together."""
        step = self.integrations_per_solve
        return [slice(first, min(first + step, n_times)) for first in range(0, n_times, step)]


CALIBRATORS = Calibrator.registry
