"""The default solver: foregrounds eliminated exactly, damped Gauss-Newton on the gains.

Each step solves the damped normal equations of the reduced problem (`calstudy.calibrate.solvers.reduced`) by
preconditioned conjugate gradients, with the damping tied to the loss, so that it vanishes towards the minimum. The
first two steps use the antenna blocks of each channel as preconditioner, later ones the channel blocks of each antenna,
which also predict how much the loss can still fall: the criterion of convergence. Where baselines share models, the
couplings between antennas remain the strong ones, and the antenna blocks of each channel are used throughout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.solvers.interface import Estimate, Verdict, WarmStart
from calstudy.calibrate.solvers.preconditioners import AntennaBlocks, Inverse
from calstudy.calibrate.solvers.reduced import (
    PRECONDITIONER_DAMPING,
    ROUNDING_LOSS,
    ReducedKernels,
    compiled,
    damping_at,
    newton_decrement_at,
)

# Accepted steps before the antenna blocks are made.
CHANNEL_STEPS = 2
# With more than this on the damping, no step is small enough to lower the loss.
MAX_BOOST = 1e6
# Antenna blocks that need more iterations than this are out of date.
CG_REFRESH = 15


class AntennaPreconditioner(NamedTuple):
    """The channel blocks of each antenna, and their inverse at one damping."""

    blocks: AntennaBlocks
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
    boost
        Factor on the damping; grows tenfold whenever a step did not lower the loss.
    preconditioner
        The antenna blocks, once they are in use.
    gained
        Decrease of the loss by the last step that lowered it; infinite before the first.
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
    n_accepted: int = 0
    boost: float = 1.0
    preconditioner: AntennaPreconditioner | None = None
    gained: float = math.inf
    predicted: float = math.inf

    @property
    def damping(self) -> float:
        """Damping of the next step, relative to the diagonal of the Gauss-Newton matrix."""
        return damping_at(self.history[-1]) * self.boost

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
    """

    tolerance: float = 1e-3
    max_steps: int = 100

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> GaussNewtonState:
        """Project at the first gains, and take over the preconditioner of the warm start."""
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
        )
        if warm is not None:
            state = replace(state, preconditioner=warm.memory)
        return self._prepared(state)

    def step(self, state: GaussNewtonState) -> GaussNewtonState:
        """Try one damped step, and keep it if it lowers the loss."""
        kernels, preconditioner = state.kernels, state.preconditioner
        damping = tf.constant(state.damping, tf.float32)
        if preconditioner is None:
            eta, promised = kernels.channel_step(state.projection, state.gains, damping)
        else:
            eta, iterations = kernels.antenna_step(state.projection, state.gains, preconditioner.inverse, damping)
            if iterations > CG_REFRESH:
                preconditioner = None
        gains = state.gains + pairs.multiply(state.gains, tf.cast(eta, tf.float64))
        trial = kernels.project(gains, *state.data)
        loss = float(trial.loss)
        # Refused as well: a loss that is not a number, and no step at all, from blocks that are singular to float32.
        if not loss < state.history[-1]:
            # At the minimum itself no step brings anything.
            if kernels.by_channel and state.boost == 1 and promised > 0:
                state = replace(state, predicted=float(promised))
            return self._prepared(replace(state, history=(*state.history, state.history[-1]), boost=10 * state.boost))
        boosted = state.boost > 1
        state = replace(
            state,
            gains=gains,
            projection=trial,
            history=(*state.history, loss),
            n_accepted=state.n_accepted + 1,
            boost=1.0,
            preconditioner=preconditioner,
            gained=state.history[-1] - loss,
            predicted=math.inf,
        )
        if not kernels.by_channel:
            return self._prepared(state)
        # Without slow directions, the next step will bring less than this one did. One that a boosted damping kept
        # small says nothing of the next.
        return state if boosted else replace(state, predicted=float(promised))

    def terminate(self, state: GaussNewtonState) -> Verdict | None:
        """Judge convergence by the decrease of the loss that the next step is predicted to bring."""
        loss, n_steps = state.history[-1], len(state.history) - 1
        if not math.isfinite(loss):
            return Verdict("failed", "the loss at the first gains is not finite")
        if loss < ROUNDING_LOSS:
            return Verdict("converged", f"the residual is rounding: its loss relative to the data is {loss:.1e}")
        fall = state.predicted / loss
        if fall < self.tolerance and min(state.decrease_to_come, state.gained / loss) < self.tolerance:
            return Verdict("converged", f"the next step would lower the loss by {fall:.1e} of itself")
        if state.boost > MAX_BOOST:
            hint = f", though {fall:.1e} of itself is predicted" if math.isfinite(fall) else ""
            return Verdict("stalled", f"no step lowers the loss{hint}")
        if n_steps >= self.max_steps:
            hint = f": {fall:.1e} of the loss is predicted to go" if math.isfinite(fall) else ""
            return Verdict("max-steps", f"not converged after {n_steps} steps{hint}")
        return None

    def losses(self, state: GaussNewtonState) -> Sequence[float]:
        """Return the loss history in the unit of the data squared."""
        return [loss * state.loss_unit for loss in state.history]

    def estimate(self, state: GaussNewtonState) -> Estimate:
        """Return the current gains, and the foregrounds that fit best with them."""
        model = state.kernels.tensors.unload(state.projection.model, state.scale)
        return Estimate(pairs.to_complex(state.gains), model)

    def newton_decrement(self, state: GaussNewtonState, problem: CalibrationProblem) -> float:
        """Return the predicted decrease that convergence is judged by; looked up anew if the iteration has none yet."""
        if state.history[-1] < ROUNDING_LOSS:
            return 0.0
        if math.isfinite(state.predicted):
            return state.predicted / state.history[-1]
        return newton_decrement_at(problem, pairs.to_complex(state.gains))

    def memory(self, state: GaussNewtonState) -> AntennaPreconditioner | None:
        """Return the antenna blocks, which hardly change from one integration to the next."""
        return state.preconditioner

    def _prepared(self, state: GaussNewtonState) -> GaussNewtonState:
        """Bring the antenna blocks to the damping of the state, or make them, and let them predict the next step."""
        preconditioner = state.preconditioner
        kernels = state.kernels
        # Smooth gains couple all channels from the start.
        early = state.n_accepted < CHANNEL_STEPS and kernels.space.vectors is None
        if kernels.by_channel or (preconditioner is None and early):
            return state
        damping = max(state.damping, PRECONDITIONER_DAMPING)
        if preconditioner is None or preconditioner.damping != damping:
            blocks = kernels.blocks(state.projection) if preconditioner is None else preconditioner.blocks
            inverse = kernels.inverse(blocks, tf.constant(damping, tf.float32), state.gains)
            preconditioner = AntennaPreconditioner(blocks, damping, inverse)
        state = replace(state, preconditioner=preconditioner)
        # A boosted damping shrinks the prediction without bringing the minimum any closer.
        if state.boost > 1:
            return state
        fall = kernels.predicted_decrease(state.projection, state.gains, preconditioner.inverse)
        return replace(state, predicted=float(fall))
