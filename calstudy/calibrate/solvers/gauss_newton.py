"""The default solver: foregrounds eliminated exactly, damped Gauss-Newton on the gains.

Each step solves the damped normal equations of the reduced problem (`calstudy.calibrate.solvers.reduced`) by
preconditioned conjugate gradients, with the damping proportional to the loss, so that it vanishes towards the minimum.
The first two steps of a cold start use the antenna blocks of each channel as preconditioner, all others the channel
blocks of each antenna, which also predict the decrease of the loss that is still possible. Where more than a few
baselines share models without a finite prior, the couplings between antennas remain the strong ones, and antenna blocks
of each channel are used throughout.

With a finite prior the damping is smaller. It then stays raised after a step that did not lower the loss, and falls
again as steps achieve their predicted decrease. Directions that foregrounds can nearly follow have a curvature from the
prior alone. Products in single precision miss it by factors, so that steps along these directions are too short, and
some hundred follow each other. Where single precision does not resolve the damping, and the decrease of the loss hardly
shrinks from step to step, such fits continue in double precision.

Smooth gains that foregrounds can nearly follow have eigenvalues of any size down to rounding, and a damping hides all
that are smaller. They matter where the noise is far below the foregrounds. Once the loss is so small that single
precision does not resolve the damping, convergence is checked in double precision, with a hundredth of the damping and
a solution of the normal equations. If a larger decrease is predicted, the iteration is stalled, or continues in double
precision if that is requested. In such directions steps are long and valleys curved: the damping then stays raised,
gains change by the exponential of a step, along which a phase is only a phase, and steps have their geodesic
acceleration added (Transtrum & Sethna 2012, arXiv:1201.5885).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.records import Solve
from calstudy.calibrate.solvers.interface import WarmStart
from calstudy.calibrate.solvers.preconditioners import AntennaBlocks, CoupledBlocks, Inverse
from calstudy.calibrate.solvers.reduced import (
    MOST_DAMPING,
    ROUNDING_LOSS,
    ROUNDING_LOSS_IN_DOUBLE,
    ReducedData,
    ReducedKernels,
    compiled,
    newton_decrement_at,
)

# Accepted steps before the antenna blocks are made, far from the minimum.
CHANNEL_STEPS = 2
# With a larger damping, no step is small enough to lower the loss.
MAX_DAMPING = 1e4
# Factor on the damping once eigenvalues below it matter.
CHECK_DAMPING = 1e-2
# In the curved valleys that follow: factors by which the damping is raised and lowered; the length of an acceleration,
# relative to its step, above which the step is too long; and the decrease of the loss, relative to the predicted one,
# below which the next step is to be shorter, and above which it may be longer.
RAISE_DAMPING = 3.0
LOWER_DAMPING = 1.5
TOO_CURVED = 0.6
POOR_STEP, GOOD_STEP = 0.25, 0.75
# Relative decrease of the loss that may be predicted in directions that single precision does not resolve: small arrays
# with little noise often stop some parts in a thousand above the minimum.
UNRESOLVED_DECREASE = 1e-2
# Decrease of the loss that is predicted for the next step, relative to that of the last, of slow convergence.
SLOW = 0.3
# Antenna blocks that need more iterations than this are out of date.
CG_REFRESH = 15


class AntennaPreconditioner(NamedTuple):
    """The channel blocks of each antenna, or coupled blocks, and their inverse at one damping, at least `least`."""

    blocks: AntennaBlocks | CoupledBlocks
    damping: float
    inverse: Inverse
    least: float


@dataclass(frozen=True, eq=False)
class GaussNewtonState:
    """One point of the iteration; losses are relative to the weighted square of the data.

    Antenna blocks, the preconditioner, are made after `channel_steps` more accepted steps: zero near a minimum, as at a
    warm start or a check of convergence. `boost` is a factor on the damping, which grows whenever a step did not lower
    the loss, and `relief` another one, of one or of `CHECK_DAMPING`.

    `gained` is the decrease of the loss by the last step that lowered it; infinite before the first. Where the damping
    stays raised, it is multiplied by its factor: the decrease along slow directions is about inversely proportional to
    the damping. `predicted` is what is predicted for the next step; infinite while unknown. It comes from a check of
    convergence if that is `checked`.
    """

    kernels: ReducedKernels
    reduced: ReducedData
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
    def equations(self) -> tuple[Projection, tf.Tensor, Inverse | None, tf.Tensor]:
        """The reduced problem, its gains, the preconditioner's inverse if it has antenna blocks, and the damping."""
        inverse = None if self.preconditioner is None else self.preconditioner.inverse
        return self.projection, self.gains, inverse, self.kernels.scalar(self.damping)

    @property
    def beyond_single(self) -> bool:
        """Whether products are in single precision, which does not resolve the damping for this loss."""
        kernels = self.kernels
        return kernels.dtype == tf.float32 and kernels.damping(self.history[-1]) <= kernels.dampings.least

    def decided_by_prior(self, patience: int) -> bool:
        """Whether a finite prior determines directions along which single precision is slow, or finds no lower loss.

        After `patience` steps a fit counts as slow in any case.
        """
        shrinks = not math.isfinite(self.gained) or self.predicted < SLOW * self.gained
        slow = self.boost > 1 or not shrinks or len(self.history) > patience
        return self.kernels.dampings.remembered and self.channel_steps == 0 and self.beyond_single and slow

    @property
    def needs_check(self) -> bool:
        """Whether convergence is checked with less damping, because the damping may hide directions that matter."""
        in_double = self.kernels.dampings.remembered and self.kernels.dtype == tf.float64
        return self.beyond_single or (in_double and not self.curved)

    @property
    def curved(self) -> bool:
        """Whether steps have their geodesic acceleration, and the damping stays raised."""
        return self.relief < 1

    @property
    def decrease_to_come(self) -> float:
        """Relative decrease of the loss by all further steps: a geometric series from the last and predicted decreases.

        Before the first step it is that of the next step alone.
        """
        shrinking = self.predicted / self.gained if math.isfinite(self.gained) else 0.0
        return self.predicted / (1 - shrinking) / self.history[-1] if shrinking < 1 else math.inf


@dataclass(frozen=True)
class GaussNewton:
    """Variable projection with a damped Gauss-Newton iteration.

    It is converged when the next step is predicted to lower the loss by less than the fraction `tolerance`, and either
    the last step did not lower it more, or all further steps together will not, if they shrink at the same rate. A fit
    with a long sequence of smaller decreases counts as converged.

    Where single precision of the inner products does not resolve the damping for the loss, ``double`` continues, and
    ``single`` is stalled if a larger decrease is possible. Fits with a finite prior that are slow there continue in
    double precision either way, with ``single`` down to the damping that is tied to the loss. They count as slow after
    `patience` steps; with zero they are in double precision wherever single precision does not resolve the damping.
    `check` is whether convergence is checked with less damping where the damping may hide directions that matter.
    """

    tolerance: float = 1e-3
    max_steps: int = 100
    precision: Literal["single", "double"] = "single"
    patience: int = 20
    check: bool = True

    @property
    def unchecked(self) -> GaussNewton:
        """The same iteration without the check of convergence, which in double precision is a part of the iteration."""
        return self if self.precision == "double" else replace(self, check=False)

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> GaussNewtonState:
        """Project at the first gains, and reuse the preconditioner of the warm start."""
        structure, memory = (None, None) if warm is None or warm.memory is None else warm.memory
        # Smooth gains of integrations with other flagged edges have other coefficients.
        if structure != problem.structure and problem.structure.gain_vectors is not None:
            memory = None
        kernels = compiled(problem.structure, problem.frozen)
        reduced = kernels.reduce(problem, problem.initial_gains if warm is None else warm.gains)
        projection = kernels.project(reduced.gains, *reduced.data)
        state = GaussNewtonState(
            kernels,
            reduced,
            reduced.gains,
            projection,
            (float(projection.loss),),
            CHANNEL_STEPS if warm is None else 0,
            preconditioner=memory,
        )
        return self._prepared(state)

    def step(self, state: GaussNewtonState) -> GaussNewtonState:
        """Try one damped step, and accept it if it lowers the loss; or check whether another step is needed."""
        settled = self._settled(state)
        if self.precision == "single" and state.decided_by_prior(self.patience) and not settled:
            state = self._prepared(_in_double(state, thorough=False))
        if self._goes_on(state) and (settled or (state.gained < state.history[-1] and not state.curved)):
            return self._checked(state)
        if settled and self._due(state):
            return replace(state, predicted=self._checked(state).predicted, checked=True)
        kernels = state.kernels
        state, step = self._curved_step(state) if state.curved else (state, self._plain_step(state))
        relative = tf.cast(step.eta, tf.float64)
        factor = pairs.exponential(relative) if state.curved else tf.stack([1 + relative[0], relative[1]])
        gains = pairs.multiply(state.gains, factor)
        trial = kernels.project(gains, *state.reduced.data)
        loss = float(trial.loss)
        # This also refuses a loss that is not a number, and a missing step, from blocks that are singular in float32.
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
        # Without slow directions, the next step lowers the loss less than this one. A step that a boosted damping kept
        # small does not predict the next.
        return state if boosted else replace(state, predicted=step.promised)

    def terminate(self, state: GaussNewtonState) -> Solve | None:
        """Decide by the predicted decrease of the loss in the next step."""
        loss, n_steps = state.history[-1], len(state.history) - 1
        if not math.isfinite(loss):
            return Solve("failed", "the loss at the first gains is not finite")
        if loss < self._rounding:
            return Solve("converged", f"the residual is rounding: its loss relative to the data is {loss:.1e}")
        fall = state.predicted / loss
        if self._settled(state) and (state.checked or not (self._due(state) or state.curved)):
            return Solve("converged", f"the next step would lower the loss by {fall:.1e} of itself")
        if state.checked and self.precision == "single":
            return Solve(
                "stalled",
                f"{fall:.1e} of the loss is predicted to go, in directions that single precision does not resolve "
                "(a solver with 'precision: double' goes on)",
            )
        known = math.isfinite(fall)
        if state.damping > MAX_DAMPING:
            hint = f", though {fall:.1e} of it is predicted to go" if known else ""
            return Solve("stalled", f"no step lowers the loss{hint}")
        if n_steps >= self.max_steps:
            hint = f": {fall:.1e} of the loss is predicted to go" if known else ""
            return Solve("max-steps", f"not converged after {n_steps} steps{hint}")
        return None

    @property
    def _rounding(self) -> float:
        """Loss relative to the data below which the residual is rounding."""
        return ROUNDING_LOSS_IN_DOUBLE if self.precision == "double" else ROUNDING_LOSS

    def _settled(self, state: GaussNewtonState) -> bool:
        """Whether the predicted decrease of the loss, at this damping, is below the tolerance."""
        loss = state.history[-1]
        if state.checked:
            most = self.tolerance if self.precision == "double" else max(self.tolerance, UNRESOLVED_DECREASE)
            return state.predicted / loss < most
        falling = min(state.decrease_to_come, state.gained / loss)
        return state.predicted / loss < self.tolerance and falling < self.tolerance

    def _due(self, state: GaussNewtonState) -> bool:
        """Whether convergence at this state is to be checked."""
        return self.check and state.needs_check

    def _goes_on(self, state: GaussNewtonState) -> bool:
        """Whether the iteration is in double precision, or must continue there."""
        return self.precision == "double" and (state.beyond_single or state.curved)

    def _checked(self, state: GaussNewtonState) -> GaussNewtonState:
        """Predict the decrease of the loss with a hundredth of the damping, from a solution of the normal equations."""
        if state.kernels.dtype == tf.float32:
            state = _in_double(state, self.precision == "double")
        state = self._prepared(replace(state, relief=CHECK_DAMPING, boost=1.0))
        promised = self._plain_step(state).promised
        # A preconditioner that rounding has spoiled predicts no decrease, and is not evidence of convergence.
        return replace(state, predicted=promised if promised > 0 else math.inf, checked=True)

    def _plain_step(self, state: GaussNewtonState) -> _Step:
        """Solve the damped normal equations."""
        eta, promised, iterations = state.kernels.step(*state.equations)
        return _Step(eta, float(promised), bool(iterations > CG_REFRESH))

    def _curved_step(self, state: GaussNewtonState) -> tuple[GaussNewtonState, _Step]:
        """Raise the damping until the step is nearly straight; return the state and the step with its acceleration."""
        while True:
            step = self._plain_step(state)
            acceleration = state.kernels.accelerate(*state.equations, step.eta)
            relative = float(tf.norm(acceleration) / tf.norm(step.eta))
            # Written so that NaN counts as curved.
            if relative < TOO_CURVED or state.damping > MAX_DAMPING:
                return state, step._replace(eta=step.eta + 0.5 * acceleration)
            state = self._prepared(replace(state, boost=RAISE_DAMPING * state.boost))

    def _refused(self, state: GaussNewtonState, promised: float) -> GaussNewtonState:
        # At the minimum itself no step lowers the loss.
        if state.kernels.by_channel and state.boost == 1 and promised > 0:
            state = replace(state, predicted=promised)
        history = (*state.history, state.history[-1])
        boost = (RAISE_DAMPING if state.curved else 10) * state.boost
        return self._prepared(replace(state, history=history, boost=boost))

    def losses(self, state: GaussNewtonState) -> Sequence[float]:
        """Return the loss history in the unit of the data squared."""
        return [loss * state.reduced.loss_unit for loss in state.history]

    def estimate(self, state: GaussNewtonState) -> tuple[np.ndarray, np.ndarray]:
        """Return the current gains and their best-fitting foregrounds."""
        model = state.kernels.tensors.unload(state.projection.model, state.reduced.scale)
        return pairs.to_complex(state.gains), model

    def newton_decrement(self, state: GaussNewtonState, problem: CalibrationProblem) -> float:
        """Return the predicted relative decrease of the loss; computed anew if the iteration has no prediction."""
        loss = state.history[-1]
        if loss < self._rounding:
            return 0.0
        if math.isfinite(state.predicted):
            return state.predicted / loss
        if state.curved and loss < ROUNDING_LOSS:
            # Below what single precision resolves, in which it is looked up.
            return self._checked(state).predicted / loss
        return newton_decrement_at(problem, pairs.to_complex(state.gains))

    def memory(self, state: GaussNewtonState) -> tuple[FitStructure, AntennaPreconditioner] | None:
        """Return the structure and the antenna blocks, which change little from one integration to the next.

        Those of double precision are not kept: each integration decides by itself whether it continues there.
        """
        if state.preconditioner is None or state.kernels.dtype != tf.float32:
            return None
        return state.kernels.structure, state.preconditioner

    def _prepared(self, state: GaussNewtonState) -> GaussNewtonState:
        """Adapt the antenna blocks to the damping of the state, or compute them, and predict the next step."""
        preconditioner = state.preconditioner
        kernels = state.kernels
        # Smooth gains couple all channels from the start.
        early = state.channel_steps > 0 and kernels.space.vectors is None
        if kernels.by_channel or (preconditioner is None and early):
            return state
        least = kernels.dampings.preconditioner if preconditioner is None else preconditioner.least
        damping = max(state.damping, least)
        if preconditioner is None or preconditioner.damping != damping:
            blocks = kernels.blocks(state.projection) if preconditioner is None else preconditioner.blocks
            inverse = kernels.inverse(blocks, kernels.scalar(damping), state.gains)
            preconditioner = AntennaPreconditioner(blocks, damping, inverse, least)
        state = replace(state, preconditioner=preconditioner)
        if state.boost > 1 and (state.curved or math.isfinite(state.predicted)):
            return state
        # A boosted damping would shrink the prediction without bringing the minimum any closer.
        due = max(state.damping / state.boost, least)
        inverse = preconditioner.inverse
        if due != damping:
            inverse = kernels.inverse(preconditioner.blocks, kernels.scalar(due), state.gains)
        predicted = float(kernels.predicted_decrease(state.projection, state.gains, inverse))
        if math.isfinite(predicted) or least > MOST_DAMPING:
            return replace(state, predicted=predicted)
        # Rounding has made blocks singular. Without a prediction the fit would go on to its largest number of steps.
        return self._prepared(replace(state, preconditioner=preconditioner._replace(least=10 * least)))


class _Step(NamedTuple):
    """A step eta, the decrease of the loss that its quadratic model predicts, and whether its preconditioner is old."""

    eta: tf.Tensor
    promised: float
    outdated: bool


def _next_boost(boost: float, gain: float) -> float:
    """Return the factor on the damping after a step with `gain` times the predicted decrease of the loss."""
    if gain < POOR_STEP:
        return RAISE_DAMPING * boost
    return max(1.0, boost / LOWER_DAMPING) if gain > GOOD_STEP else boost


def _in_double(state: GaussNewtonState, thorough: bool) -> GaussNewtonState:
    """Return a state whose products are made in double precision."""
    kernels = compiled(state.kernels.structure, state.kernels.frozen, tf.float64, thorough)
    projection = kernels.project(state.gains, *state.reduced.data)
    return replace(state, kernels=kernels, projection=projection, channel_steps=0, preconditioner=None)
