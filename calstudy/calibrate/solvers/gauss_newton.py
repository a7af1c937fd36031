"""The default solver: foregrounds eliminated exactly, damped Gauss-Newton on the gains.

Each step solves the damped normal equations of the reduced problem (see `calstudy.calibrate.projection`) by
preconditioned conjugate gradients, with the damping tied to the loss, so that it vanishes towards the minimum. The
first two steps use the antenna blocks of each channel as preconditioner, later ones the channel blocks of each antenna,
which also predict how much the loss can still fall: the criterion of convergence. Where baselines share models, the
couplings between antennas remain the strong ones, and the antenna blocks of each channel are used throughout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.projection import Projection, Projector
from calstudy.calibrate.solvers.conjugate_gradients import Operator, conjugate_gradients
from calstudy.calibrate.solvers.interface import Estimate, Verdict, WarmStart
from calstudy.calibrate.solvers.preconditioners import (
    antenna_blocks,
    antenna_degrees,
    antenna_factors,
    channel_factors,
    solve_antennas,
    solve_channels,
)
from calstudy.calibrate.tensors import FitTensors, Measurements

# Damping, relative to the diagonal, is this times the loss relative to the data, within the two bounds.
DAMPING_PER_LOSS = 10.0
DAMPING_BOUNDS = (1e-6, 1e-2)
# In float32 the preconditioner cannot be factored with less.
PRECONDITIONER_DAMPING = 1e-5
# The factors are kept while the damping stays within this ratio of theirs.
DAMPING_RATIO = 3.0
CHANNEL_STEPS = 2
CG_TOLERANCE = 1e-3
CG_CHANNEL_ITERATIONS = 300
CG_ANTENNA_ITERATIONS = 60
# With more than this on the damping, no step is small enough to lower the loss.
MAX_BOOST = 1e6
# Antenna blocks that need more iterations than this are out of date.
CG_REFRESH = 30
# Loss relative to the data below which a residual is rounding: 3e-8 of the visibilities, float32's resolution.
ROUNDING_LOSS = 1e-15


class Kernels:
    """The compiled pieces of the solver for one fit structure."""

    def __init__(self, structure: FitStructure) -> None:
        self.tensors = FitTensors(structure)
        self.projector = Projector(self.tensors)
        self.project = self.projector.project
        self.channel_step = tf.function(self._channel_step)
        self.antenna_step = tf.function(self._antenna_step)
        self.blocks = tf.function(self._blocks)
        self.factors = tf.function(antenna_factors)
        self.predicted_decrease = tf.function(self._predicted_decrease)

    def _channel_step(self, projection: Projection, damping: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:
        """Return eta, and the decrease of the loss that its quadratic model promises."""
        factors = channel_factors(self.projector, projection, damping)
        eta, _ = self._solve(projection, damping, lambda values: solve_channels(factors, values), CG_CHANNEL_ITERATIONS)
        return eta, pairs.inner_product(tf.cast(projection.descent, tf.float32), eta)

    def _antenna_step(
        self, projection: Projection, factors: tf.Tensor, damping: tf.Tensor
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return eta, and the iterations it took."""
        return self._solve(projection, damping, lambda values: solve_antennas(factors, values), CG_ANTENNA_ITERATIONS)

    def _solve(
        self, projection: Projection, damping: tf.Tensor, preconditioner: Operator, iterations: int
    ) -> tuple[tf.Tensor, tf.Tensor]:
        diagonal = damping * antenna_degrees(self.projector, projection)
        return conjugate_gradients(
            lambda eta: self.projector.hessian_product(eta, projection) + diagonal * eta,
            preconditioner,
            tf.cast(projection.descent, tf.float32),
            tf.constant(CG_TOLERANCE),
            tf.constant(iterations),
        )

    def _blocks(self, projection: Projection) -> tuple[tf.Tensor, tf.Tensor]:
        blocks = antenna_blocks(self.projector, projection)
        return blocks, antenna_degrees(self.projector, projection)

    def _predicted_decrease(self, projection: Projection, factors: tf.Tensor) -> tf.Tensor:
        descent = tf.cast(projection.descent, tf.float32)
        return pairs.inner_product(descent, solve_antennas(factors, descent))


@lru_cache(maxsize=4)
def compiled(structure: FitStructure) -> Kernels:
    """Return the kernels of a structure, compiled once for all its integrations."""
    return Kernels(structure)


class AntennaPreconditioner(NamedTuple):
    """The channel blocks of each antenna, with factors at one damping."""

    blocks: tf.Tensor
    degrees: tf.Tensor
    damping: float
    factors: tf.Tensor


@dataclass(frozen=True, eq=False)
class GaussNewtonState:
    """One point of the iteration; losses are relative to the weighted square of the data.

    Attributes
    ----------
    boost
        Factor on the damping; grows tenfold whenever a step did not lower the loss.
    preconditioner
        The antenna blocks, once they are in use.
    predicted
        Decrease of the loss that is predicted for the next step; infinite while unknown.
    """

    kernels: Kernels
    data: Measurements
    weights: tf.Tensor
    loss_unit: float
    gains: tf.Tensor
    projection: Projection
    history: tuple[float, ...]
    n_accepted: int = 0
    boost: float = 1.0
    preconditioner: AntennaPreconditioner | None = None
    predicted: float = math.inf

    @property
    def damping(self) -> float:
        """Damping of the next step, relative to the diagonal of the Gauss-Newton matrix."""
        low, high = DAMPING_BOUNDS
        return min(max(DAMPING_PER_LOSS * self.history[-1], low), high) * self.boost


@dataclass(frozen=True)
class GaussNewton:
    """Variable projection with a damped Gauss-Newton iteration.

    Parameters
    ----------
    tolerance
        Converged when the predicted decrease of the loss, relative to the loss, is smaller.
    max_steps
        Gauss-Newton steps at most.
    """

    tolerance: float = 1e-3
    max_steps: int = 30

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> GaussNewtonState:
        """Project at the first gains, and take over the preconditioner of the warm start."""
        kernels = compiled(problem.structure)
        data = kernels.tensors.load(problem, tf.float64)
        total = float(tf.reduce_sum(data.weights))
        weights = data.weights / total
        gains = pairs.to_pair(problem.initial_gains if warm is None else warm.gains, tf.float64)
        projection = kernels.project(gains, data.visibilities, weights)
        state = GaussNewtonState(
            kernels, data, weights, total * data.scale**2, gains, projection, (float(projection.loss),)
        )
        if warm is not None:
            state = replace(state, preconditioner=warm.memory)
        return self._prepared(state)

    def step(self, state: GaussNewtonState) -> GaussNewtonState:
        """Try one damped step, and keep it if it lowers the loss."""
        kernels, preconditioner = state.kernels, state.preconditioner
        damping = tf.constant(state.damping, tf.float32)
        if preconditioner is None:
            eta, promised = kernels.channel_step(state.projection, damping)
        else:
            eta, iterations = kernels.antenna_step(state.projection, preconditioner.factors, damping)
            if int(iterations) > CG_REFRESH:
                preconditioner = None
        gains = state.gains + pairs.multiply(state.gains, tf.cast(eta, tf.float64))
        trial = kernels.project(gains, state.data.visibilities, state.weights)
        loss = float(trial.loss)
        # Written so that a loss that is not a number is refused as well.
        if not loss <= state.history[-1]:
            return self._prepared(replace(state, history=(*state.history, state.history[-1]), boost=10 * state.boost))
        state = replace(
            state,
            gains=gains,
            projection=trial,
            history=(*state.history, loss),
            n_accepted=state.n_accepted + 1,
            boost=1.0,
            preconditioner=preconditioner,
        )
        # Group models leave no slow directions, so that the next step will bring less than this one did.
        return replace(state, predicted=float(promised)) if kernels.tensors.shared else self._prepared(state)

    def terminate(self, state: GaussNewtonState) -> Verdict | None:
        """Judge convergence by the decrease of the loss that the next step is predicted to bring."""
        loss, n_steps = state.history[-1], len(state.history) - 1
        if not math.isfinite(loss):
            return Verdict("failed", "the loss at the first gains is not finite")
        if loss < ROUNDING_LOSS:
            return Verdict("converged", f"the residual is rounding: its loss relative to the data is {loss:.1e}")
        fall = state.predicted / loss
        if fall < self.tolerance:
            return Verdict("converged", f"the next step would lower the loss by {fall:.1e} of itself")
        if state.boost > MAX_BOOST:
            return Verdict("stalled", f"no step lowers the loss, though {fall:.1e} of itself is predicted")
        if n_steps >= self.max_steps:
            return Verdict(
                "max-steps", f"not converged after {n_steps} steps: {fall:.1e} of the loss is predicted to go"
            )
        return None

    def losses(self, state: GaussNewtonState) -> Sequence[float]:
        """Return the loss history in the unit of the data squared."""
        return [loss * state.loss_unit for loss in state.history]

    def estimate(self, state: GaussNewtonState) -> Estimate:
        """Return the current gains, and the foregrounds that fit best with them."""
        model = state.kernels.tensors.unload(state.projection.model, state.data.scale)
        return Estimate(pairs.to_complex(state.gains), model)

    def memory(self, state: GaussNewtonState) -> AntennaPreconditioner | None:
        """Return the antenna blocks, which hardly change from one integration to the next."""
        return state.preconditioner

    def _prepared(self, state: GaussNewtonState) -> GaussNewtonState:
        """Bring the antenna blocks up to date with the state, and let them predict the decrease of the next step."""
        preconditioner = state.preconditioner
        if state.kernels.tensors.shared or (preconditioner is None and state.n_accepted < CHANNEL_STEPS):
            return state
        damping = max(state.damping, PRECONDITIONER_DAMPING)
        ratio = preconditioner.damping / damping if preconditioner else math.inf
        if not 1 / DAMPING_RATIO < ratio < DAMPING_RATIO:
            blocks, degrees = preconditioner[:2] if preconditioner else state.kernels.blocks(state.projection)
            factors = state.kernels.factors(blocks, degrees, tf.constant(damping, tf.float32))
            preconditioner = AntennaPreconditioner(blocks, degrees, damping, factors)
        state = replace(state, preconditioner=preconditioner)
        # A boosted damping shrinks the prediction without bringing the minimum any closer.
        if state.boost > 1:
            return state
        return replace(
            state, predicted=float(state.kernels.predicted_decrease(state.projection, preconditioner.factors))
        )
