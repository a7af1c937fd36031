"""Calibrators that minimize w |V - g_a g_b* F|^2: gains alone, or gains and foregrounds under some prior."""

from __future__ import annotations

from typing import ClassVar, Self

from calstudy.base.errors import InputError
from calstudy.base.observation import Frame, Observation
from calstudy.base.quiet import require_tensorflow
from calstudy.base.resources import Cost
from calstudy.calibrate.basis import require_room
from calstudy.calibrate.cost import LEAST_MODELS, Dimensions, solve_cost, solve_memory
from calstudy.calibrate.interface import NO_SKY_MODEL, Assumed, Calibration, Progress, SolvePlan
from calstudy.calibrate.problem import fitted_baselines, make_structure, repeat_structure
from calstudy.calibrate.settings import ForegroundFit, ForegroundPrior, GainFit, GaussNewtonSettings, ScalePrior, Solver
from calstudy.instrument.settings import Size

CROWDED = 0.9
"""Number of unknowns per sample from which a fit can absorb any data."""


class _LeastSquares(GainFit):
    """A fit of gains, and of foregrounds where there is a basis for them."""

    @property
    def needs_noise(self) -> bool:
        """Whether the foregrounds have a finite prior, and the settings do not give the noise."""
        if not isinstance(self, ForegroundFit) or not self.foreground_prior.finite:
            return False
        return self.foreground_prior.noise is None and self.weights.kind != "autos"

    def cost(self, size: Size) -> Cost:
        """Return the cost of the solves, within a factor of about two, as if no baselines shared a foreground model."""
        return solve_cost(self, size)

    def with_less_memory(self) -> Self | None:
        """Return the calibrator with half as many foreground models at a time."""
        if not isinstance(self, ForegroundFit) or self.models_at_once <= LEAST_MODELS:
            return None
        return self.model_copy(update={"models_at_once": max(self.models_at_once // 2, LEAST_MODELS)})

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if TensorFlow is missing, or these baselines and channels cannot be fitted, else None."""
        if isinstance(self, ForegroundFit) and not has_sky_model:
            for field, value in (("foreground_prior.mean", self.foreground_prior.mean), ("prior", self.prior)):
                if value == "sky-model":
                    return f"{field}: 'sky-model' needs a sky model, and there is none"

        try:
            require_tensorflow()
            frame = self.fitted(frame.baselines(fitted_baselines(frame, self.autos)))
            if isinstance(self, ForegroundFit) and not self.frozen:
                require_room(frame.lengths.max(), frame.frequencies, self.basis)
        except InputError as error:
            return str(error).removeprefix("calibration.")
        return None

    def plan(self, frame: Frame) -> SolvePlan:
        """Return the cost of a solve of these baselines, with a note if it has too many unknowns."""
        frame = frame.baselines(fitted_baselines(frame, self.autos))
        structure = make_structure(frame, self)
        together = min(self.integrations_per_solve, frame.n_times)
        memory = solve_memory(Dimensions.of(repeat_structure(structure, together)), self)
        cost = Cost(solve_cost(self, Size.of_frame(frame)).seconds, memory)
        if self.frozen:
            return SolvePlan(cost)
        coefficients = structure.basis.n_coefficients
        unknowns = coefficients + structure.n_antennas * structure.n_frequencies
        samples = structure.n_baselines * structure.n_frequencies
        note = (
            f"The fit has {unknowns} unknowns for {samples} samples, so that it can absorb anything: expect slow "
            "convergence, and no residual; use a smaller basis.min_delay or --buffer, or --redundant."
        )
        notes = (note,) if unknowns >= CROWDED * samples else ()
        return SolvePlan(cost, f"{coefficients} foreground coefficients each", notes)

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Solve every integration or group of them, and every polarization."""
        from calstudy.calibrate.calamity import fit

        return fit(observation, assumed, self, progress)


class Calamity(_LeastSquares, ForegroundFit):
    """Gains are fitted together with a smooth foreground model of each baseline (paper Eq. LOGLIKELIHOOD)."""

    # Foregrounds are modelled between the flagged edges of the band since 2. Where weights run away, the result is that
    # of equal weights since 3, in every integration.
    version: ClassVar[int] = 3
    calibrator: str = "calamity"


class CalamityRedundant(_LeastSquares, ForegroundFit):
    """Gains are fitted with a smooth foreground model of each redundant group (paper Eq. LOGLIKELIHOODREDUNDANT)."""

    # Foregrounds are modelled between the flagged edges of the band since 2. Where weights run away, the result is that
    # of equal weights since 3, in every integration. Where few baselines are redundant, weights of own gains settle
    # since 4, with another preconditioner.
    version: ClassVar[int] = 4
    calibrator: str = "calamity-redundant"
    foreground_prior: ForegroundPrior = ForegroundPrior(deviation=0.0, shared_deviation="infinite")


class SkyBased(_LeastSquares):
    """Only gains are fitted; the sky model is taken as the true foregrounds."""

    # Where weights run away, the result is that of equal weights since 2, in every integration.
    version: ClassVar[int] = 2
    calibrator: str = "sky-based"

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if there is no sky model, or nothing to fit."""
        return super().refusal(frame, True) if has_sky_model else NO_SKY_MODEL


class _AboutSkyModel(_LeastSquares, ForegroundFit):
    """A fit of gains and of foregrounds that deviate from a sky model."""

    prior: ScalePrior = "sky-model"
    # At the default tolerance the foreground residual exceeds the EoR near the wedge.
    solver: Solver = GaussNewtonSettings(tolerance=1e-5)


class DelayWeighted(_AboutSkyModel):
    """Gains are fitted with a sky model whose errors, of known size, fill the modelled delays of each baseline."""

    # Fits with a finite prior converge since 2; before, they stopped at or ahead of the largest number of steps.
    # Weights are inverse variances since 3 where some samples have no weight and are not flagged.
    # Fits whose preconditioner is singular in single precision converge since 4.
    # Directions that only the prior determines are fitted in double precision since 5.
    # So are fits that need many steps since 6.
    # Where weights run away, the result is that of equal weights since 7, in every integration.
    # The noise is that of the data, after gains and for the number of measurements, since 8.
    version: ClassVar[int] = 8
    calibrator: str = "delay-weighted"
    foreground_prior: ForegroundPrior = ForegroundPrior(mean="sky-model", deviation=0.1)


class Unified(_AboutSkyModel):
    """Gains are fitted with a sky model whose errors are common to redundant baselines, but for a smaller part."""

    # Fits with a finite prior converge since 2; before, they stopped at or ahead of the largest number of steps.
    # Weights are inverse variances since 3 where some samples have no weight and are not flagged.
    # Fits whose preconditioner is singular in single precision converge since 4.
    # Directions that only the prior determines are fitted in double precision since 5.
    # So are fits that need many steps since 6.
    # Where weights run away, the result is that of equal weights since 7, in every integration.
    # The noise is that of the data, after gains and for the number of measurements, since 8.
    version: ClassVar[int] = 8
    calibrator: str = "unified"
    foreground_prior: ForegroundPrior = ForegroundPrior(mean="sky-model", deviation=0.05, shared_deviation=0.1)


class EmpiricalBayes(_AboutSkyModel):
    """Gains are fitted with a sky model whose errors fill the modelled delays; the data tell their size."""

    # Only the last solve has the full tolerance since 2.
    # Fits whose preconditioner is singular in single precision converge since 3.
    # Directions that only the prior determines are fitted in double precision since 4.
    # So are fits that need many steps since 5.
    # Where weights run away, the result is that of equal weights since 6, in every integration, and of the deviation
    # that is estimated with these since 7.
    # The noise is that of the data, after gains and for the number of measurements, since 8.
    version: ClassVar[int] = 8
    calibrator: str = "empirical-bayes"
    foreground_prior: ForegroundPrior = ForegroundPrior(mean="sky-model", deviation="estimated")
