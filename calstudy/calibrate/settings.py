"""Sections of the `calibration` block of an experiment file that calibrators share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from calstudy.base.constants import SAME_LENGTH
from calstudy.base.errors import InputError
from calstudy.base.observation import Frame
from calstudy.base.schema import REVISED, UNKEYED, Section, choice, fault
from calstudy.base.units import Delay, FluxDensity, Length
from calstudy.calibrate.interface import Calibrator

MODELS_AT_ONCE = 1024
# Antennas times vectors, for real and imaginary parts, up to which smooth gains of all antennas are coupled in double
# precision: a matrix of 0.5 GB, and some ten seconds to factorize it.
MOST_COUPLED = 8192
NOISE_UNKNOWN = (
    "calibration.foreground_prior.noise: a finite deviation is weighed against the noise, which is not known; "
    "give the standard deviation of a sample, such as '1 Jy', or use `weights: autos`"
)


class BasisSettings(Section):
    """The DPSS foreground basis of each baseline (paper Eq. FGMODEL)."""

    horizon: float = Field(
        1.0, ge=0, description="Half-width of the modelled delays, in units of the horizon delay |b|/c."
    )
    buffer: Delay = Field(50e-9, ge=0, description="Added to the half-width.")
    min_delay: Delay = Field(100e-9, ge=0, description="The half-width before the buffer is at least this.")
    delay_step: Delay = Field(
        10e-9, gt=0, description="Half-widths are rounded up to a multiple of this, so that baselines share bases."
    )


class GaussNewtonSettings(Section):
    """Variable projection with a Levenberg-damped Gauss-Newton iteration: the default."""

    name: Literal["gauss-newton"] = "gauss-newton"
    tolerance: float = Field(
        1e-3, gt=0, lt=1, description="Stop when the predicted relative decrease of the loss is smaller."
    )
    max_steps: int = Field(100, ge=1)
    precision: Literal["single", "double"] = Field(
        "single",
        description="Of the inner products of the iteration. Where the noise is below about 3e-4 of the data, some "
        "directions are not resolved by single precision: `double` goes on with less damping, and `single` is "
        "`stalled` if more than 1 % of the loss (or `tolerance`, if that is larger) is predicted to go there. Fits "
        "with a finite prior go on in double precision either way.",
    )
    warm_start: bool = Field(True, description="Start each integration from the solution of the one before.")


class AdamaxSettings(Section):
    """Adamax on gains and foregrounds together; a learning rate of 0.01 is the paper's solver."""

    name: Literal["adamax"]
    learning_rate: float = Field(0.01, gt=0)
    stop: Literal["best-loss", "published"] = Field(
        "best-loss",
        description="Stop when the best loss falls by less than `tolerance` over 50 steps; `published`, as the code of "
        "the paper's authors: when the loss changes by less than `tolerance` from one step to the next.",
    )
    tolerance: float = Field(
        1e-14, ge=0, description="In units of the mean square of the data; 0: always make max_steps steps."
    )
    max_steps: int = Field(10_000, ge=1)
    keep: Literal["best", "last"] = Field(
        "best", description="Return the gains with the lowest loss, or those after the last step, as the authors do."
    )
    precision: Literal["single", "double"] = "single"
    warm_start: bool = False


Solver = Annotated[GaussNewtonSettings | AdamaxSettings, choice("name", "gauss-newton")]


UNSETTLED = 10.0
"""Weights from gains that still change by more than this times the tolerance in the last pass have not converged."""
LEAST_TAPER = 1e-4
"""Antennas whose baselines all have less than this part of their weight are left out of a fit."""
RUNAWAY = 1.0
"""Weights that change by more than themselves in the last pass run away; the result is that of equal weights then.

Unlike calibrators of other packages, fits of our own do not go half of the way. Where noise makes weights run away,
half steps settle at gains that are no better than those of equal weights (HERA-19, k of 0.3 to 0.5: T of 0.91 +- 0.23,
with equal weights 0.88 +- 0.04). Where the sky model lacks most they are far better (`calstudy which hera-19`,
sky-based, diffuse emission unknown: bias of 0.5 in place of 8e5 at k of 0.5 to 1). How a fit tells the two apart is
open.
"""


class GainWeights(Section):
    """Inverse variance of noise that is received with the sky: 1 / |g_a g_b|^2 of the gains that the fit finds itself.

    The first pass has the weights of the gains that it starts from; each other pass those of the gains of the pass
    before. After a pass that ends at the largest number of steps there is no other. Where weights run away, as with a
    signal to noise of one in every sample, the result is that of equal weights, and its status says so.
    """

    kind: Literal["gains"] = "gains"
    passes: int = Field(
        10,
        ge=1,
        description="Passes at most, each with the steps that `solver` allows; 1: the weights of the first gains.",
    )
    tolerance: float = Field(
        1e-4,
        gt=0,
        lt=1,
        description="The last pass is the one whose gains change weights by less: relative, rms of neighbouring "
        "channels against each other. A fit whose weights change by ten times as much in its last pass has not "
        "converged.",
    )

    def unsettled(self, change: float) -> bool:
        """Whether weights with this change in the last pass have not converged."""
        return self.passes > 1 and change > UNSETTLED * self.tolerance


def unsettled_message(change: float, passes: int) -> str:
    """Return the message for a fit whose weights from its gains have not converged."""
    if change > RUNAWAY:
        return (
            f"weights from the gains did not settle in {passes} passes: the result is that of equal weights "
            "('calibration.weights: autos' needs no passes)"
        )
    return f"weights from the gains still changed by {100 * change:.2g} % in pass {passes}"


class FlagWeights(Section):
    """Every unflagged sample counts alike, 1 / (Nbls Nfreqs): the paper's weights."""

    kind: Literal["flags"] = "flags"


class SampleWeights(Section):
    """Unflagged samples count as often as they were measured: the nsamples of the data."""

    kind: Literal["nsamples"]


class AutoWeights(Section):
    """Inverse variance by the radiometer equation: nsamples / (V_aa V_bb), from the autocorrelations of the data."""

    kind: Literal["autos"]


class FileWeights(Section):
    """Weights from a UVFlag file in metric mode, by baseline, with the samples of the data; zero is a flag."""

    kind: Literal["file"]
    path: Path


Weights = Annotated[GainWeights | FlagWeights | SampleWeights | AutoWeights | FileWeights, choice("kind", "gains")]


class BaselineRange(Section):
    """Baselines that gains are fitted to. Gains calibrate all baselines of their antennas."""

    # Baselines that are as long as these but for rounding were left out until 2.
    shortest: Length = Field(0.0, ge=0, description="Shorter baselines have no weight.", json_schema_extra={REVISED: 2})
    longest: Length | None = Field(
        None, gt=0, description="Longer baselines have no weight; null: all have.", json_schema_extra={REVISED: 2}
    )
    taper: Length | None = Field(
        None,
        gt=0,
        description="Weights are multiplied by a Gaussian of the length with this standard deviation. Antennas whose "
        "factors are all below 1e-4 are left out, and flagged.",
        # Such antennas kept the gains that they started from until 2.
        json_schema_extra={REVISED: 2},
    )

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.longest is not None and self.longest <= self.shortest:
            raise fault("longest", f"{self.longest:g} m is not above shortest, {self.shortest:g} m")
        return self

    def factors(self, lengths: np.ndarray, antennas: np.ndarray) -> np.ndarray:
        """Return the factors on the weights of baselines of some lengths, m, between antennas, (Nbls, 2).

        Where all factors of an antenna are below `LEAST_TAPER` they are zero: a fit converges before its gains move.
        """
        longest = math.inf if self.longest is None else self.longest
        chosen = (lengths >= self.shortest - SAME_LENGTH) & (lengths <= longest + SAME_LENGTH)
        factors = chosen * (1.0 if self.taper is None else np.exp(-((lengths / self.taper) ** 2) / 2))
        largest = np.zeros(antennas.max() + 1)
        for column in antennas.T:
            np.maximum.at(largest, column, factors)
        return np.where((largest[antennas] >= LEAST_TAPER).all(axis=1), factors, 0.0)


class UnityStart(Section):
    """Start from perfect gains."""

    kind: Literal["unity"] = "unity"


class FileStart(Section):
    """Start from gains in a file, at the integration closest in time."""

    kind: Literal["file"]
    path: Path


class RedundantStart(Section):
    """Start from redundant calibration of each integration: hera_cal's firstcal and logcal (Liu et al. 2010)."""

    kind: Literal["redundant"]
    delays: bool = Field(
        True, description="First fit a delay and a phase per antenna; false for gains that are noise in frequency."
    )


class DelayStart(Section):
    """Start from one delay per antenna, and with a sky model one complex gain: for long cables on any array."""

    kind: Literal["delays"]
    per_channel: bool = Field(
        False, description="Then fit a gain in every channel to the sky model: for gain errors of order one."
    )


InitialGains = Annotated[UnityStart | FileStart | RedundantStart | DelayStart, choice("kind", "unity")]


def _deviation(value: Any) -> Any:
    """Refuse an invalid deviation in one sentence, where a union of types would have one for each."""
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf:
        return float(value)
    if value not in ("infinite", "estimated"):
        raise fault("", f"{value!r} is neither a number of at least 0, nor 'infinite', nor 'estimated'")
    return value


Deviation = Annotated[Annotated[float, Field(ge=0)] | Literal["infinite", "estimated"], BeforeValidator(_deviation)]


START_DEVIATION = 0.01
"""Of the first pass where deviations are estimated, over the rms of the sky model."""


class ForegroundPrior(Section):
    """Gaussian prior on deviations of the foregrounds from the assumed ones, flat over the modelled delays."""

    # Finite priors are fitted in double precision since 2, wherever many steps are needed since 3.
    mean: Literal["none", "sky-model"] = Field(
        "none", description="What is assumed of the foregrounds.", json_schema_extra={REVISED: 4}
    )
    deviation: Deviation = Field(
        "infinite",
        description="Standard deviation of what each baseline may have beside the mean, over the rms of the sky model; "
        "`infinite`: foregrounds are free within the modelled delays; 0: none; `estimated`: the most likely one, from "
        "the data of each solve.",
    )
    # Where few baselines are redundant and it is infinite, fits have another preconditioner since 2.
    shared_deviation: Deviation = Field(
        0.0,
        description="The same for what redundant baselines have in common beside the mean.",
        json_schema_extra={REVISED: 2},
    )
    noise: FluxDensity | None = Field(
        None,
        gt=0,
        description="Standard deviation of the noise of one sample, against which finite deviations are weighed, "
        "from the mean of inverse variances where samples differ; null: that of the experiment, or, with `weights: "
        "autos`, of the radiometer equation.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        own, shared = self.deviation, self.shared_deviation
        if own == "infinite" and shared != 0:
            raise fault("shared_deviation", "must be 0 where deviation is infinite, which leaves nothing to share")
        if shared == "infinite" and own != 0:
            raise fault("deviation", "must be 0 where shared_deviation is infinite, or both must be finite")
        if self.estimated and {own, shared} - {"estimated", 0}:
            raise fault("shared_deviation", "must be 'estimated' or 0 where deviation is, and the other way round")
        if self.mean == "sky-model" and "infinite" in (own, shared):
            raise fault("mean", "must be none beside an infinite deviation, which leaves it without meaning")
        if self.mean == "none" and "infinite" not in (own, shared):
            raise fault(
                "mean",
                "finite deviations need `mean: sky-model`; around nothing the best foregrounds are ever smaller, and "
                "the gains ever larger",
            )
        return self

    @property
    def estimated(self) -> bool:
        """Whether any deviation is estimated from the data."""
        return "estimated" in (self.deviation, self.shared_deviation)

    @property
    def finite(self) -> bool:
        """Whether any deviation is neither zero nor infinite, so that the prior is weighed against the noise."""
        return any(value not in (0, "infinite") for value in (self.deviation, self.shared_deviation))


def _unconnected_parts(antennas: np.ndarray) -> int:
    """Count the parts of an array between which there is no baseline, from the antennas of baselines, (Nbls, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    present, places = np.unique(antennas, return_inverse=True)
    first, second = places.reshape(-1, 2).T
    graph = coo_array((np.ones(first.size), (first, second)), shape=(present.size, present.size))
    return int(connected_components(graph, directed=False)[0])


class WeightedFit(Calibrator):
    """Settings that all calibrators have in common that fit gains to weighted visibilities."""

    weights: Weights = GainWeights()
    baselines: BaselineRange | None = Field(
        None, description="Baselines that gains are fitted to, where the foregrounds are the sky model; null: all."
    )

    @property
    def needs_autos(self) -> bool:
        """Whether weights come from autocorrelations."""
        return self.weights.kind == "autos"

    def fitted(self, frame: Frame) -> Frame:
        """Select the baselines of a frame to which gains are fitted.

        Raises InputError if there are none; the message starts with the path of the setting.
        """
        if self.baselines is None:
            return frame
        chosen = self.baselines.factors(frame.lengths, frame.antennas) > 0
        if not chosen.any():
            raise InputError(
                f"baselines: none lies within the range; the data have {frame.lengths.min():.0f} to "
                f"{frame.lengths.max():.0f} m"
            )
        found = frame.baselines(chosen)
        if (parts := _unconnected_parts(found.antennas[~found.autos])) > 1:
            raise InputError(
                f"baselines: those within the range leave {parts} parts of the array unconnected, whose phases against "
                "each other would not be known; give a wider range"
            )
        return found


class GainFit(WeightedFit):
    """Settings of calibrators that fit gains by weighted least squares, w |V - g_a g_b* F|^2.

    Fields of `solver` that a file leaves out are those of the calibrator's own solver, if it has the same name.
    """

    solver: Solver = GaussNewtonSettings()
    # A redundant start has the phase gradients of the sky model since 2.
    initial_gains: InitialGains = Field(UnityStart(), json_schema_extra={REVISED: 2})
    redundancy_tolerance: Length = Field(
        0.5,
        gt=0,
        description="Baselines whose vectors agree within a quarter of this are redundant; those that differ by more "
        "than half of it are not (a grid of pyuvdata).",
    )
    gain_delay: Delay | None = Field(
        None,
        gt=0,
        description="Restrict gains to a DPSS basis up to this delay; null: any gain in any channel.",
        # Sequences are those of the band between flagged edges since 2.
        json_schema_extra={REVISED: 2},
    )
    autos: bool = Field(False, description="Include autocorrelations in the fit.")
    models_at_once: int = Field(
        MODELS_AT_ONCE,
        ge=16,
        description="Foreground models that a solver works on at a time: fewer need less memory, and change results by "
        "rounding only. A run chooses fewer by itself where memory is short.",
        json_schema_extra=UNKEYED,
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_solver(cls, data: Any) -> Any:
        """Fill in missing fields of `solver`."""
        given = data.get("solver") if isinstance(data, dict) else None
        preset = cls.model_fields["solver"].default
        if given == preset.name:
            given = {"name": given}
        if not isinstance(given, dict) or given.get("name", preset.name) != preset.name:
            return data
        return {**data, "solver": {**preset.model_dump(), **given}}

    @property
    def frozen(self) -> bool:
        """Whether the foregrounds are the sky model, so that only gains are fitted."""
        return True

    @property
    def estimates_deviation(self) -> bool:
        """Whether a deviation of the foregrounds' prior is estimated from the data."""
        return False

    @property
    def not_in_expected_loss(self) -> str | None:
        """Field whose effect on the residual the expected loss of the fit lacks; None: there is none."""
        return next((name for name in ("smooth_gains", "baselines") if getattr(self, name) is not None), None)


ScalePrior = Annotated[
    Literal["sum", "post-hoc", "gains", "sky-model", "none"],
    Field(
        description="How the overall scale is fixed: by the paper's prior on the summed model, by the summed model "
        "afterwards, by the geometric mean of the gains afterwards, by regression of the calibrated data on the sky "
        "model afterwards, or not."
    ),
]


class ForegroundFit(GainFit):
    """Settings of calibrators that fit foregrounds with the gains, in a basis of functions of frequency.

    A calibrator of this kind is a `foreground_prior`; fields of it that a file leaves out are the calibrator's own.
    """

    foreground_prior: ForegroundPrior = ForegroundPrior()
    basis: BasisSettings = BasisSettings()
    prior: ScalePrior = "sum"

    @property
    def on_sky_scale(self) -> bool:
        """Whether the sky model fixes the overall scale."""
        return self.prior not in ("gains", "none")

    @model_validator(mode="before")
    @classmethod
    def _complete_prior(cls, data: Any) -> Any:
        """Fill in missing fields of `foreground_prior`."""
        given = data.get("foreground_prior") if isinstance(data, dict) else None
        if not isinstance(given, dict):
            return data
        preset = cls.model_fields["foreground_prior"].default
        return {**data, "foreground_prior": {**preset.model_dump(exclude_none=True), **given}}

    @model_validator(mode="after")
    def _possible(self) -> Self:
        prior = self.foreground_prior
        if prior.finite and isinstance(self.solver, AdamaxSettings):
            raise fault("solver", f"{self.solver.name} cannot fit a finite prior; use gauss-newton")
        if self.baselines is not None and not self.frozen:
            raise fault("baselines", "must be null where foregrounds are fitted, which takes data of every baseline")
        return self

    @property
    def frozen(self) -> bool:
        """Whether the foregrounds are the sky model, because all deviations of the prior are zero."""
        return self.foreground_prior.deviation == 0 and self.foreground_prior.shared_deviation == 0

    @property
    def estimates_deviation(self) -> bool:
        """Whether a deviation of the foregrounds' prior is estimated from the data."""
        return self.foreground_prior.estimated
