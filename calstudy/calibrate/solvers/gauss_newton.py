"""The default solver: foregrounds eliminated exactly, damped Gauss-Newton on the gains.

Each step solves the damped normal equations of the reduced problem (`calstudy.calibrate.solvers.reduced`) by
preconditioned conjugate gradients, with the damping tied to the loss, so that it vanishes towards the minimum. The
first two steps of a cold start use the antenna blocks of each channel as preconditioner, all others the channel blocks
of each antenna, which also predict how much the loss can still fall. Where baselines share models without a finite
prior, the couplings between antennas remain the strong ones, and antenna blocks of each channel are used throughout.

With a finite prior, whose damping is smaller, it remembers what it was raised to after a step that did not lower the
loss, and comes down as steps bring what they promise.

Smooth gains that foregrounds can nearly follow have eigenvalues of any size down to rounding, and a damping hides all
that are smaller. They matter where the noise is far below the foregrounds. Once the loss is so small that single
precision does not resolve the damping, convergence is checked in double precision, with a hundredth of the damping and
a solution of the normal equations. If more is predicted to go, the iteration is stalled, or goes on in double precision
if that is asked for. In such directions steps are long and valleys curved: the damping then remembers what it was
raised to, gains change by the exponential of a step, along which a phase is only a phase, and steps have their
geodesic acceleration added (Transtrum & Sethna 2012, arXiv:1201.5885).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.solvers.interface import Estimate, Verdict, WarmStart
from calstudy.calibrate.solvers.preconditioners import AntennaBlocks, CoupledBlocks, Inverse
from calstudy.calibrate.solvers.reduced import (
    ROUNDING_LOSS,
    ROUNDING_LOSS_IN_DOUBLE,
    ReducedKernels,
    compiled,
    newton_decrement_at,
)

# Accepted steps before the antenna blocks are made, far from the minimum.
CHANNEL_STEPS = 2
# With a larger damping, no step is small enough to lower the loss.
MAX_DAMPING = 1e4
# What the damping is multiplied by once eigenvalues below it matter.
CHECK = 1e-2
# In the curved valleys that follow: what the damping is raised and lowered by; the length of an acceleration, relative
# to its step, with which a step is too long; what a step gains of what it promises if the next is to be shorter, or may
# be longer.
RAISE = 3.0
LOWER = 1.5
TOO_CURVED = 0.6
POOR, GOOD = 0.25, 0.75
# What of the loss may be predicted to go in directions that single precision does not resolve: small arrays with little
# noise often stop some parts in a thousand above the minimum.
UNRESOLVED = 1e-2
# Antenna blocks that need more iterations than this are out of date.
CG_REFRESH = 15


class AntennaPreconditioner(NamedTuple):
    """The channel blocks of each antenna, or coupled blocks, and their inverse at one damping."""

    blocks: AntennaBlocks | CoupledBlocks
    damping: float
    inverse: Inverse


@dataclass(frozen=True, eq=False)
class GaussNewtonState:
    """One point of the iteration; losses are relative to the weighted square of the data.

    Attributes
    ----------
    scale
        Unit of the visibilities, their weighted rms.
    data
        Visibilities, weights whose sum is one, and the model if it is frozen.
    channel_steps
        Steps that are still to be accepted before the antenna blocks are made: none near a minimum, where a warm start
        is, and a check of convergence.
    boost
        Factor on the damping; grows whenever a step did not lower the loss.
    relief
        Another factor, of one or of `CHECK`.
    checked
        Whether the prediction comes from a check of convergence.
    preconditioner
        The antenna blocks, once they are in use.
    gained
        Decrease of the loss by the last step that lowered it; infinite before the first. Where the damping remembers
        what it was raised to, multiplied by that: what a step brings along slow directions is about inversely
        proportional to the damping.
    predicted
        Decrease of the loss that is predicted for the next step; infinite while unknown.
    """

    kernels: ReducedKernels
    scale: float
    data: tuple[tf.Tensor, ...]
    loss_unit: float
    gains: tf.Tensor
    projection: Projection
    history: tuple[float, ...]
    channel_steps: int = CHANNEL_STEPS
    boost: float = 1.0
    relief: float = 1.0
    checked: bool = False
    preconditioner: AntennaPreconditioner | None = None
    gained: float = math.inf
    predicted: float = math.inf

    @property
    def damping(self) -> float:
        """Damping of the next step, relative to the diagonal of the Gauss-Newton matrix."""
        tied = self.relief * self.kernels.damping(self.history[-1])
        return max(tied, self.kernels.dampings.least) * self.boost

    @property
    def beyond_single(self) -> bool:
        """Whether products are made in single precision, which does not resolve the damping that is due."""
        kernels = self.kernels
        return kernels.dtype == tf.float32 and kernels.damping(self.history[-1]) <= kernels.dampings.least

    @property
    def curved(self) -> bool:
        """Whether steps have their geodesic acceleration, and the damping remembers."""
        return self.relief < 1

    @property
    def decrease_to_come(self) -> float:
        """Decrease of the loss by all steps to come, over the loss: a geometric series, from the last step to the next.

        Before the first step it is that of the next step alone.
        """
        shrinking = self.predicted / self.gained if math.isfinite(self.gained) else 0.0
        return self.predicted / (1 - shrinking) / self.history[-1] if shrinking < 1 else math.inf


@dataclass(frozen=True)
class GaussNewton:
    """Variable projection with a damped Gauss-Newton iteration.

    Parameters
    ----------
    tolerance
        Converged when the next step is predicted to lower the loss by less than this of itself, and either the last
        step did no more, or all steps to come together will not, if they go on shrinking at the same rate. A fit that
        crawls by less than this at each step counts as converged.
    max_steps
        Gauss-Newton steps at most.
    precision
        Of the inner products; ``double`` goes on where single precision does not resolve the damping that is due, and
        ``single`` is stalled if there is more to be gained.
    """

    tolerance: float = 1e-3
    max_steps: int = 100
    precision: Literal["single", "double"] = "single"

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> GaussNewtonState:
        """Project at the first gains, and take over the preconditioner of the warm start."""
        memory: AntennaPreconditioner | None = None if warm is None else warm.memory
        kernels = compiled(problem.structure, problem.frozen)
        reduced = kernels.reduce(problem, problem.initial_gains if warm is None else warm.gains)
        projection = kernels.project(reduced.gains, *reduced.data)
        state = GaussNewtonState(
            kernels,
            reduced.scale,
            reduced.data,
            reduced.loss_unit,
            reduced.gains,
            projection,
            (float(projection.loss),),
            CHANNEL_STEPS if warm is None else 0,
            preconditioner=memory,
        )
        return self._prepared(state)

    def step(self, state: GaussNewtonState) -> GaussNewtonState:
        """Try one damped step, and keep it if it lowers the loss; or check whether there is need of one."""
        settled = self._settled(state)
        if self._goes_on(state) and (settled or (state.gained < state.history[-1] and not state.curved)):
            return self._checked(state)
        if settled and state.beyond_single:
            return replace(state, predicted=self._checked(state).predicted, checked=True)
        kernels = state.kernels
        state, step = self._curved_step(state) if state.curved else (state, self._plain_step(state))
        relative = tf.cast(step.eta, tf.float64)
        gains = pairs.multiply(state.gains, pairs.exponential(relative) if state.curved else _one_plus(relative))
        trial = kernels.project(gains, *state.data)
        loss = float(trial.loss)
        # Refused as well: a loss that is not a number, and no step at all, from blocks that are singular to float32.
        if not loss < state.history[-1]:
            return self._refused(state, step.promised)
        boosted, remembered = state.boost > 1, kernels.dampings.remembered
        gained = state.history[-1] - loss
        state = replace(
            state,
            gains=gains,
            projection=trial,
            history=(*state.history, loss),
            channel_steps=max(state.channel_steps - 1, 0),
            boost=_next_boost(state.boost, gained / step.promised) if state.curved or remembered else 1.0,
            checked=False,
            preconditioner=None if step.outdated or kernels.coupled else state.preconditioner,
            gained=gained * state.boost if remembered and not state.curved else gained,
            predicted=math.inf,
        )
        if not kernels.by_channel:
            return self._prepared(state)
        # Without slow directions, the next step will bring less than this one did. One that a boosted damping kept
        # small says nothing of the next.
        return state if boosted else replace(state, predicted=step.promised)

    def terminate(self, state: GaussNewtonState) -> Verdict | None:
        """Judge convergence by the decrease of the loss that the next step is predicted to bring."""
        loss, n_steps = state.history[-1], len(state.history) - 1
        if not math.isfinite(loss):
            return Verdict("failed", "the loss at the first gains is not finite")
        if loss < self._rounding:
            return Verdict("converged", f"the residual is rounding: its loss relative to the data is {loss:.1e}")
        fall = state.predicted / loss
        if self._settled(state) and (state.checked or not (state.beyond_single or state.curved)):
            return Verdict("converged", f"the next step would lower the loss by {fall:.1e} of itself")
        if state.checked and self.precision == "single":
            return Verdict(
                "stalled",
                f"{fall:.1e} of the loss is predicted to go, in directions that single precision does not resolve "
                "(a solver with 'precision: double' goes on)",
            )
        hint = f"{fall:.1e} of {{}} is predicted to go" if math.isfinite(fall) else ""
        if state.damping > MAX_DAMPING:
            return Verdict("stalled", f"no step lowers the loss{', though ' + hint.format('it') if hint else ''}")
        if n_steps >= self.max_steps:
            return Verdict(
                "max-steps", f"not converged after {n_steps} steps{': ' + hint.format('the loss') if hint else ''}"
            )
        return None

    @property
    def _rounding(self) -> float:
        """Loss relative to the data below which a residual is left as it is."""
        return ROUNDING_LOSS_IN_DOUBLE if self.precision == "double" else ROUNDING_LOSS

    def _settled(self, state: GaussNewtonState) -> bool:
        """Whether the loss will hardly fall, as far as the damping lets be seen."""
        loss = state.history[-1]
        if state.checked:
            most = self.tolerance if self.precision == "double" else max(self.tolerance, UNRESOLVED)
            return state.predicted / loss < most
        falling = min(state.decrease_to_come, state.gained / loss)
        return state.predicted / loss < self.tolerance and falling < self.tolerance

    def _goes_on(self, state: GaussNewtonState) -> bool:
        """Whether the iteration is, or is to be, in double precision."""
        return self.precision == "double" and (state.beyond_single or state.curved)

    def _checked(self, state: GaussNewtonState) -> GaussNewtonState:
        """Predict the decrease of the loss with a hundredth of the damping, from a solution of the normal equations."""
        if state.kernels.dtype == tf.float32:
            state = _in_double(state, self.precision == "double")
        state = self._prepared(replace(state, relief=CHECK, boost=1.0))
        promised = self._plain_step(state).promised
        # A preconditioner that rounding has spoiled promises nothing, and says nothing.
        return replace(state, predicted=promised if promised > 0 else math.inf, checked=True)

    def _plain_step(self, state: GaussNewtonState) -> _Step:
        """Solve the damped normal equations."""
        kernels, preconditioner = state.kernels, state.preconditioner
        damping = kernels.scalar(state.damping)
        if preconditioner is None:
            eta, promised = kernels.channel_step(state.projection, state.gains, damping)
            return _Step(eta, float(promised), False)
        eta, promised, iterations = kernels.antenna_step(state.projection, state.gains, preconditioner.inverse, damping)
        return _Step(eta, float(promised), bool(iterations > CG_REFRESH))

    def _curved_step(self, state: GaussNewtonState) -> tuple[GaussNewtonState, _Step]:
        """Return the state with the damping that keeps a step about straight, and the step with its acceleration."""
        while True:
            step = self._plain_step(state)
            inverse = None if state.preconditioner is None else state.preconditioner.inverse
            arguments = state.projection, state.gains, inverse, state.kernels.scalar(state.damping), step.eta
            acceleration = state.kernels.accelerate(*arguments)
            relative = float(tf.norm(acceleration) / tf.norm(step.eta))
            # Written so that what is no number counts as curved.
            if relative < TOO_CURVED or state.damping > MAX_DAMPING:
                return state, step._replace(eta=step.eta + 0.5 * acceleration)
            state = self._prepared(replace(state, boost=RAISE * state.boost))

    def _refused(self, state: GaussNewtonState, promised: float) -> GaussNewtonState:
        # At the minimum itself no step brings anything.
        if state.kernels.by_channel and state.boost == 1 and promised > 0:
            state = replace(state, predicted=promised)
        history = (*state.history, state.history[-1])
        return self._prepared(replace(state, history=history, boost=(RAISE if state.curved else 10) * state.boost))

    def losses(self, state: GaussNewtonState) -> Sequence[float]:
        """Return the loss history in the unit of the data squared."""
        return [loss * state.loss_unit for loss in state.history]

    def estimate(self, state: GaussNewtonState) -> Estimate:
        """Return the current gains, and the foregrounds that fit best with them."""
        model = state.kernels.tensors.unload(state.projection.model, state.scale)
        return Estimate(pairs.to_complex(state.gains), model)

    def newton_decrement(self, state: GaussNewtonState, problem: CalibrationProblem) -> float:
        """Return the predicted decrease that convergence is judged by; looked up anew if the iteration has none yet."""
        loss = state.history[-1]
        if loss < self._rounding:
            return 0.0
        if math.isfinite(state.predicted):
            return state.predicted / loss
        if state.curved and loss < ROUNDING_LOSS:
            # Below what single precision resolves, in which it is looked up.
            return self._checked(state).predicted / loss
        return newton_decrement_at(problem, pairs.to_complex(state.gains))

    def memory(self, state: GaussNewtonState) -> AntennaPreconditioner | None:
        """Return the antenna blocks, which hardly change from one integration to the next.

        Those of double precision are not kept: each integration finds out by itself whether it goes on there.
        """
        return state.preconditioner if state.kernels.dtype == tf.float32 else None

    def _prepared(self, state: GaussNewtonState) -> GaussNewtonState:
        """Bring the antenna blocks to the damping of the state, or make them, and let them predict the next step."""
        preconditioner = state.preconditioner
        kernels = state.kernels
        # Smooth gains couple all channels from the start.
        early = state.channel_steps > 0 and kernels.space.vectors is None
        if kernels.by_channel or (preconditioner is None and early):
            return state
        damping = max(state.damping, kernels.dampings.preconditioner)
        if preconditioner is None or preconditioner.damping != damping:
            blocks = kernels.blocks(state.projection) if preconditioner is None else preconditioner.blocks
            inverse = kernels.inverse(blocks, kernels.scalar(damping), state.gains)
            preconditioner = AntennaPreconditioner(blocks, damping, inverse)
        state = replace(state, preconditioner=preconditioner)
        inverse = preconditioner.inverse
        if state.boost > 1:
            if state.curved or math.isfinite(state.predicted):
                return state
            # A boosted damping would shrink the prediction without bringing the minimum any closer.
            due = max(state.damping / state.boost, kernels.dampings.preconditioner)
            inverse = kernels.inverse(preconditioner.blocks, kernels.scalar(due), state.gains)
        return replace(state, predicted=float(kernels.predicted_decrease(state.projection, state.gains, inverse)))


class _Step(NamedTuple):
    """A step eta, the decrease of the loss that it promises, and whether its preconditioner is out of date."""

    eta: tf.Tensor
    promised: float
    outdated: bool


def _one_plus(values: tf.Tensor) -> tf.Tensor:
    return tf.stack([1 + values[0], values[1]])


def _next_boost(boost: float, gain: float) -> float:
    """Return the factor on the damping after a step that lowered the loss by `gain` times what it promised."""
    if gain < POOR:
        return RAISE * boost
    return max(1.0, boost / LOWER) if gain > GOOD else boost


def _in_double(state: GaussNewtonState, thorough: bool) -> GaussNewtonState:
    """Return a state whose products are made in double precision."""
    kernels = state.kernels.in_double(thorough)
    projection = kernels.project(state.gains, *state.data)
    return replace(state, kernels=kernels, projection=projection, channel_steps=0, preconditioner=None)
