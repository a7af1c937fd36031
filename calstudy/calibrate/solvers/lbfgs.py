"""L-BFGS on the gains, foregrounds eliminated exactly (scipy's implementation of Byrd et al. 1995).

Gains are scaled by the square root of their antenna's contribution to the curvature of the loss, so that all unknowns
have about the same curvature, which is the initial assumption of the method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.records import Solve
from calstudy.calibrate.solvers.interface import WarmStart
from calstudy.calibrate.solvers.preconditioners import antenna_degrees
from calstudy.calibrate.solvers.reduced import ReducedData, ReducedKernels, compiled, newton_decrement_at

# Steps between evaluations of the Newton decrement, which costs as much as several steps here.
WINDOW = 10
# Decrease over as many steps, relative to the loss, above which it is not evaluated.
FAST = 1e-2


@dataclass(frozen=True, eq=False)
class LbfgsState:
    """One point of the iteration; losses are relative to the weighted square of the data.

    Attributes
    ----------
    coordinates
        Coordinates of the gains in their space, times `unit`, float64.
    unit
        Scale of each antenna's coordinates, (1, Nants, 1), float64.
    newton_decrement
        Relative Newton decrement (see `Solve`); infinite while unknown.
    message
        Message of scipy at the end; None before.
    """

    problem: CalibrationProblem
    kernels: ReducedKernels
    reduced: ReducedData
    coordinates: np.ndarray
    unit: np.ndarray
    history: tuple[float, ...]
    newton_decrement: float = math.inf
    message: str | None = None

    def gains(self, coordinates: np.ndarray) -> tf.Tensor:
        """Return the gains with these coordinates, (2, Nants, Nfreqs)."""
        return self.kernels.exact_space.expand(tf.constant(coordinates / self.unit))

    def newton_decrement_at(self, coordinates: np.ndarray) -> float:
        """Return the relative Newton decrement at these coordinates."""
        return newton_decrement_at(self.problem, pairs.to_complex(self.gains(coordinates)))

    def project(self, coordinates: np.ndarray) -> tuple[tf.Tensor, Projection]:
        """Return the gains with these coordinates, and the projection there."""
        gains = self.gains(coordinates)
        return gains, self.kernels.project(gains, *self.reduced.data)


@dataclass(frozen=True)
class Lbfgs:
    """Limited-memory quasi-Newton iteration on the gains.

    Parameters
    ----------
    tolerance
        Converged when a Gauss-Newton step would lower the loss by less than this fraction.
    max_steps
        Maximum number of steps.
    memory_size
        Number of pairs of steps and gradients that are kept.
    """

    tolerance: float = 1e-3
    max_steps: int = 2000
    memory_size: int = 20

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> LbfgsState:
        """Project at the first gains."""
        kernels = compiled(problem.structure, problem.frozen)
        reduced = kernels.reduce(problem, problem.initial_gains if warm is None else warm.gains)
        projection = kernels.project(reduced.gains, *reduced.data)
        degrees = antenna_degrees(kernels.tensors, projection).numpy().mean(axis=1)
        unit = np.sqrt(degrees / degrees.mean())[None, :, None].astype(np.float64)
        coordinates = kernels.exact_space.reduce(reduced.gains).numpy() * unit
        return LbfgsState(problem, kernels, reduced, coordinates, unit, (float(projection.loss),))

    def step(self, state: LbfgsState) -> LbfgsState:
        """Take all steps: the memory of the method lives within one call."""
        history, shape = list(state.history), state.coordinates.shape
        looked, newton_decrement = len(history), math.inf
        # The loss is small, and scipy's line search has absolute tolerances.
        first = max(history[0], np.finfo(float).tiny)

        def value(point: np.ndarray) -> tuple[float, np.ndarray]:
            gains, projection = state.project(point.reshape(shape))
            slope = -2 * pairs.multiply(projection.descent, gains) / pairs.squared_modulus(gains)
            slope = state.kernels.exact_space.reduce(slope).numpy() / state.unit
            return float(projection.loss) / first, np.ravel(slope) / first

        def judge(intermediate_result: OptimizeResult) -> None:
            nonlocal looked, newton_decrement
            history.append(intermediate_result.fun * first)
            if len(history) >= looked + WINDOW and history[-1 - WINDOW] - history[-1] < FAST * history[-1]:
                looked = len(history)
                newton_decrement = state.newton_decrement_at(intermediate_result.x.reshape(shape))
                if newton_decrement < self.tolerance:
                    raise StopIteration

        options = {"maxiter": self.max_steps, "maxfun": 10 * self.max_steps, "maxcor": self.memory_size}
        found = minimize(
            value,
            np.ravel(state.coordinates),
            jac=True,
            method="L-BFGS-B",
            callback=judge,
            options=options | {"ftol": 0.0, "gtol": 0.0},
        )
        if len(history) > looked:
            newton_decrement = state.newton_decrement_at(found.x.reshape(shape))
        return replace(
            state,
            coordinates=found.x.reshape(shape),
            history=tuple(history),
            newton_decrement=newton_decrement,
            message=str(found.message).strip(),
        )

    def terminate(self, state: LbfgsState) -> Solve | None:
        """Decide by the Newton decrement."""
        n_steps = len(state.history) - 1
        if not math.isfinite(state.history[-1]):
            return Solve("failed", f"the loss is not finite after {n_steps} steps")
        if state.message is None:
            return None
        if state.newton_decrement < self.tolerance:
            return Solve(
                "converged", f"a Gauss-Newton step would lower the loss by {state.newton_decrement:.1e} of itself"
            )
        hint = f"{state.newton_decrement:.1e} of the loss is predicted to go"
        if n_steps >= self.max_steps:
            return Solve("max-steps", f"not converged after {n_steps} steps: {hint}")
        return Solve("stalled", f"no step lowers the loss any more after {n_steps} steps ({state.message}): {hint}")

    def losses(self, state: LbfgsState) -> Sequence[float]:
        """Return the loss history in the unit of the data squared."""
        return [loss * state.reduced.loss_unit for loss in state.history]

    def estimate(self, state: LbfgsState) -> tuple[np.ndarray, np.ndarray]:
        """Return the current gains, and the foregrounds that fit best with them."""
        gains, projection = state.project(state.coordinates)
        return pairs.to_complex(gains), state.kernels.tensors.unload(projection.model, state.reduced.scale)

    def newton_decrement(self, state: LbfgsState, problem: CalibrationProblem) -> float:
        """Return the relative Newton decrement at the estimate."""
        del problem
        return state.newton_decrement

    def memory(self, state: LbfgsState) -> None:
        """Return nothing: only the gains carry over."""
