"""Adamax (Kingma & Ba 2014) on gains and foreground coefficients together; a rate of 0.01 is the paper's solver.

One call runs many steps inside one compiled loop. The loss is paper Eq. LOGLIKELIHOOD or LOGLIKELIHOODREDUNDANT of
visibilities in units of their rms, so that the learning rate is a relative change, plus the prior on the summed model
where the problem has it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, Prior
from calstudy.calibrate.projection import Projector
from calstudy.calibrate.records import Solve
from calstudy.calibrate.solvers.interface import WarmStart
from calstudy.calibrate.solvers.reduced import newton_decrement_at
from calstudy.calibrate.tensors import Ends, FitTensors, GainSpace

# Real and imaginary parts stay apart here: stacking them would cost the compiled step a copy each time.
RealImaginary = tuple[tf.Tensor, tf.Tensor]
# Baselines are divided into at most this many parts, so that the temporary arrays of a part stay in the processor's
# cache. More of them take longer to compile.
PARTS = 8


Precision = Literal["single", "double"]

# Decay of the moments and the guard of the denominator: Kingma & Ba (2014), Keras' defaults.
BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-7
STEPS_PER_CALL = 50


class Parameters(NamedTuple):
    """Unknowns or anything of their shape: gains, or their coefficients in a smooth basis, (2, Nants, Nfreqs or Ngain).

    Coefficients of foregrounds are (2, Nmembers, Nvec) of each bucket; none if these are frozen.
    """

    gains: tf.Tensor
    coefficients: tuple[tf.Tensor, ...]


class FitData(NamedTuple):
    """Visibilities (2, Nbls, Nfreqs), weights (Nbls, Nfreqs) and the prior's target (2,), in units of the rms.

    The model (2, Nbls, Nfreqs) is given only if it is frozen, `summed` (see `sum_prior`) only if it is not.
    """

    visibilities: tf.Tensor
    weights: tf.Tensor
    target: tf.Tensor
    summed: tuple[tf.Tensor, ...]
    model: tf.Tensor | None = None


class Part(NamedTuple):
    """The first and one past the last of the buckets, models and baselines of a part of the loss."""

    buckets: tuple[int, int]
    models: tuple[int, int]
    baselines: tuple[int, int]


def foreground_model(coefficients: Sequence[tf.Tensor], bases: Sequence[tf.Tensor]) -> RealImaginary:
    """Return sum_i u_i A_i of all models, real and imaginary part, each (Nmodels, Nfreqs) (paper Eq. FGMODEL).

    There is one matrix product per bucket, of u, (2, Nmembers, Nvec), and the basis A, (Nvec, Nfreqs).
    """
    products = [tf.reshape(u, [-1, basis.shape[0]]) @ basis for u, basis in zip(coefficients, bases, strict=True)]
    # The gradient of a split is one concatenation; that of two slices would be two arrays padded with zeros.
    real, imaginary = zip(*(tf.split(product, 2) for product in products), strict=True)
    return tf.concat(real, axis=0), tf.concat(imaginary, axis=0)


def likelihood(
    ends: Ends, gains: tf.Tensor, model: RealImaginary, visibilities: tf.Tensor, weights: tf.Tensor
) -> tf.Tensor:
    """Return sum w |v - g_a g_b* F|^2 over baselines and channels.

    Gains are (2, Nants, Nfreqs); F is given on the baselines, real and imaginary part, each (Nbls, Nfreqs).
    Visibilities are (2, Nbls, Nfreqs), weights (Nbls, Nfreqs).
    """
    first, second = ends
    real, imaginary = tf.unstack(gains)
    a_real, a_imaginary = tf.gather(real, first), tf.gather(imaginary, first)
    b_real, b_imaginary = tf.gather(real, second), tf.gather(imaginary, second)
    product_real = a_real * b_real + a_imaginary * b_imaginary
    product_imaginary = a_imaginary * b_real - a_real * b_imaginary
    residual_real = visibilities[0] - (product_real * model[0] - product_imaginary * model[1])
    residual_imaginary = visibilities[1] - (product_imaginary * model[0] + product_real * model[1])
    return tf.reduce_sum(weights * (tf.square(residual_real) + tf.square(residual_imaginary)))


def sum_prior(coefficients: Sequence[tf.Tensor], summed: Sequence[tf.Tensor], target: tf.Tensor) -> tf.Tensor:
    """Return |sum w' (F - m)|^2 with w' = w, on the model itself and not on gains times model (paper §Method).

    `coefficients` are u of each bucket, see `foreground_model`; `summed` are their weights in the real and the
    imaginary part of sum w F, of the same shapes. The target is the weighted sum of the sky model, (2,).
    """
    # One sum of all is compiled faster than one for each bucket.
    products = [tf.reshape(u * weight, [2, -1]) for u, weight in zip(coefficients, summed, strict=True)]
    return tf.reduce_sum(tf.square(tf.reduce_sum(tf.concat(products, axis=1), axis=1) - target))


def _make_parts(tensors: FitTensors) -> list[Part]:
    """Divide all baselines into at most `PARTS` parts, of whole buckets."""
    parts: list[Part] = []
    start = 0
    for bucket, (_, model) in enumerate(tensors.slices):
        first_model = tensors.slices[start][0]
        (first, _), (_, last) = tensors.baselines_of(first_model), tensors.baselines_of(model - 1)
        if last >= tensors.n_baselines * (len(parts) + 1) / PARTS:
            parts.append(Part((start, bucket + 1), (first_model, model), (first, last)))
            start = bucket + 1
    return parts


class JointLoss:
    """The loss of one fit structure, in parts.

    Gains are fitted in `space`. Of the priors of the overall scale, only ``sum`` is part of the loss. `dtype` is that
    of the loss, its parameters, and `space`.
    """

    def __init__(self, tensors: FitTensors, space: GainSpace, prior: Prior, dtype: tf.DType) -> None:
        self._tensors, self._space, self._with_prior, self._dtype = tensors, space, prior == "sum", dtype
        self._bases = [tf.constant(basis.T, self._dtype) for basis in tensors.bases]
        self._parts = _make_parts(tensors)

    def summed(self, weights: tf.Tensor) -> tuple[tf.Tensor, ...]:
        """Return the weight of each coefficient in the sum of w F, w of (Nbls, Nfreqs), float64; see `sum_prior`."""
        # The sum runs over visibilities as they were measured, also where the solver turned a baseline around.
        orientation = self._tensors.orientation
        of_parts = tf.stack([weights, weights if orientation is None else weights * orientation])
        return self.coefficients(self._tensors.sum_over_group(of_parts))

    def coefficients(self, models: tf.Tensor) -> tuple[tf.Tensor, ...]:
        """Return A^T F of each bucket for models (2, Nmodels, Nfreqs), float64; the transpose of `foreground_model`."""
        parts = zip(self._tensors.slices, self._tensors.bases, strict=True)
        return tuple(tf.cast(models[:, first:last] @ basis, self._dtype) for (first, last), basis in parts)

    def model(self, coefficients: Sequence[tf.Tensor]) -> tf.Tensor:
        """Return F on the baselines, (2, Nbls, Nfreqs), for the coefficients of each bucket; see `foreground_model`."""
        return self._tensors.to_baselines(tf.stack(foreground_model(coefficients, self._bases)))

    def _part_loss(self, part: Part, gains: tf.Tensor, coefficients: tuple[tf.Tensor, ...], data: FitData) -> tf.Tensor:
        """Return the likelihood of a part, for gains (2, Nants, Nfreqs) and the coefficients of its models."""
        first, last = part.baselines
        if data.model is not None:
            model = tf.unstack(data.model[:, first:last])
        else:
            model = foreground_model(coefficients, self._bases[slice(*part.buckets)])
            if self._tensors.model_index is not None:
                owner = self._tensors.model_index[first:last] - part.models[0]
                model = tuple(tf.gather(values, owner) for values in model)
        ends = self._tensors.ends.slice(first, last)
        return likelihood(ends, gains, model, data.visibilities[:, first:last], data.weights[first:last])

    def value(self, parameters: Parameters, data: FitData) -> tf.Tensor:
        """Return the likelihood, plus the sum prior where the problem has it."""
        gains = self._space.expand(parameters.gains)
        values = [
            self._part_loss(part, gains, parameters.coefficients[slice(*part.buckets)], data) for part in self._parts
        ]
        if self._with_prior and data.model is None:
            values.append(sum_prior(parameters.coefficients, data.summed, data.target))
        return tf.add_n(values)

    def value_and_gradient(self, parameters: Parameters, data: FitData) -> tuple[tf.Tensor, Parameters]:
        """Return the loss and its gradient, of the shape of the parameters."""
        gains = self._space.expand(parameters.gains)
        values, of_gains, of_coefficients = [], [], []
        # The gradient of each part by itself: that of their sum would keep all that the parts need until the end.
        for part in self._parts:
            coefficients = parameters.coefficients[slice(*part.buckets)]
            with tf.GradientTape() as tape:
                tape.watch([gains, coefficients])
                value = self._part_loss(part, gains, coefficients, data)
            slope, slopes = tape.gradient(value, [gains, coefficients])
            values.append(value)
            of_gains.append(slope)
            of_coefficients.extend(slopes)
        if self._with_prior and data.model is None:
            with tf.GradientTape() as tape:
                tape.watch(parameters.coefficients)
                values.append(sum_prior(parameters.coefficients, data.summed, data.target))
            slopes = tape.gradient(values[-1], parameters.coefficients)
            of_coefficients = [slope + more for slope, more in zip(of_coefficients, slopes, strict=True)]
        return tf.add_n(values), Parameters(self._space.reduce(tf.add_n(of_gains)), tuple(of_coefficients))


_map = tf.nest.map_structure
"""Apply a function to all tensors of one or more parameters."""


class Descent(NamedTuple):
    """Parameters, first and second moments of the gradient after a step, and the parameters with the lowest loss."""

    parameters: Parameters
    moments: tuple[Parameters, Parameters]
    best: Parameters
    best_loss: tf.Tensor


def update(
    learning_rate: float | tf.Tensor,
    step: tf.Tensor,
    parameters: Parameters,
    moments: tuple[Parameters, Parameters],
    gradient: Parameters,
) -> tuple[Parameters, tuple[Parameters, Parameters]]:
    """Take a step, counted from one in the dtype of the parameters; return parameters and moments."""
    first = _map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, moments[0], gradient)
    rate = tf.cast(learning_rate, step.dtype) / (1 - tf.cast(BETA_1, step.dtype) ** step)
    second = _map(lambda n, g: tf.maximum(BETA_2 * n, tf.abs(g)), moments[1], gradient)
    moved = _map(lambda x, m, n: x - rate * m / (n + EPSILON), parameters, first, second)
    return moved, (first, second)


class JointKernels:
    """Loss, gradient and the compiled descent for one fit structure."""

    def __init__(self, structure: FitStructure, precision: Precision, prior: Prior) -> None:
        self.dtype = tf.float32 if precision == "single" else tf.float64
        self.tensors = FitTensors(structure)
        self.projector = Projector(structure, self.tensors)
        self.space = GainSpace(structure.gain_vectors, self.dtype)
        self.loss = JointLoss(self.tensors, self.space, prior, self.dtype)
        self.descend = tf.function(self._descend, jit_compile=True, autograph=False)

    def load(self, problem: CalibrationProblem, gains: np.ndarray) -> tuple[Parameters, FitData, float]:
        """Return gains with their best-fitting foregrounds, in weighted least squares, the data, and their unit."""
        exact = self.tensors.load(problem, tf.float64)
        start = pairs.to_pair(gains, tf.float64)
        coefficients: tuple[tf.Tensor, ...] = ()
        model, target, summed = None, 0j, ()
        if (known := problem.mean) is not None:
            model = self.tensors.load_model(known, exact.scale, self.dtype)
        else:
            best = self.projector.project(start, exact.visibilities, exact.weights).model
            coefficients = self.loss.coefficients(self.tensors.of_models(tf.concat(best, axis=1)))
            target, summed = problem.prior_target / exact.scale, self.loss.summed(self.tensors.ordered(problem.summing))
        visibilities, weights = (tf.cast(part, self.dtype) for part in (exact.visibilities, exact.weights))
        data = FitData(visibilities, weights, pairs.to_pair(np.array(target), self.dtype), summed, model)
        return Parameters(self.space.reduce(tf.cast(start, self.dtype)), coefficients), data, exact.scale

    def estimate(self, parameters: Parameters, data: FitData, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Return gains and model in the problem's order and unit; `scale` is the unit of `data` in the problem's."""
        model = self.loss.model(parameters.coefficients) if data.model is None else data.model
        return pairs.to_complex(self.space.expand(parameters.gains)), self.tensors.unload([model], scale)

    def _descend(
        self, n_steps: tf.Tensor, done: tf.Tensor, learning_rate: tf.Tensor, descent: Descent, data: FitData
    ) -> tuple[Descent, tf.Tensor, tf.Tensor]:
        """Take `n_steps` steps after `done`; return the descent, the loss before each step, and the loss after all."""

        def body(index: tf.Tensor, now: Descent, losses: tf.Tensor) -> tuple[tf.Tensor, Descent, tf.Tensor]:
            value, gradient = self.loss.value_and_gradient(now.parameters, data)
            better = value < now.best_loss
            best = _map(lambda new, old: tf.where(better, new, old), now.parameters, now.best)
            step = tf.cast(done + index + 1, self.dtype)
            moved = update(learning_rate, step, now.parameters, now.moments, gradient)
            descent = Descent(*moved, best, tf.where(better, value, now.best_loss))
            return index + 1, descent, tf.tensor_scatter_nd_update(losses, [[index]], [value])

        start = (tf.constant(0), descent, tf.zeros([STEPS_PER_CALL], self.dtype))
        _, descent, losses = tf.while_loop(lambda index, *_: index < n_steps, body, start, parallel_iterations=1)
        return descent, losses, self.loss.value(descent.parameters, data)


compiled = lru_cache(maxsize=4)(JointKernels)
"""The kernels of a structure, precision and prior, compiled once for all integrations and learning rates."""


@dataclass(frozen=True, eq=False)
class AdamaxState:
    """One point of the descent; losses are in units of the data's mean square."""

    kernels: JointKernels
    data: FitData
    scale: float
    descent: Descent
    history: tuple[float, ...]


@dataclass(frozen=True)
class Adamax:
    """Descent with a constant learning rate; fields are as in `calstudy.calibrate.settings.AdamaxSettings`.

    The ``published`` rule is one step after a loss that differs from the loss before it by less than the tolerance. In
    single precision with a tolerance of 1e-14 that is when two consecutive losses are equal, which happens by chance
    once the loss falls slowly.
    """

    learning_rate: float = 0.01
    max_steps: int = 10_000
    tolerance: float = 1e-14
    precision: Precision = "single"
    stop: Literal["best-loss", "published"] = "best-loss"
    keep: Literal["best", "last"] = "best"

    @property
    def unchecked(self) -> Adamax:
        """The same: the iteration has no check of convergence of its own."""
        return self

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> AdamaxState:
        """Start from the first gains and their best-fitting foregrounds, in weighted least squares."""
        kernels = compiled(problem.structure, self.precision, problem.prior)
        gains = problem.initial_gains if warm is None else warm.gains
        parameters, data, scale = kernels.load(problem, gains)
        loss = kernels.loss.value(parameters, data)
        zero = _map(tf.zeros_like, parameters)
        descent = Descent(parameters, (zero, zero), parameters, loss)
        return AdamaxState(kernels, data, scale, descent, (float(loss),))

    def step(self, state: AdamaxState) -> AdamaxState:
        """Take up to `STEPS_PER_CALL` steps."""
        done = len(state.history) - 1
        n_steps = min(STEPS_PER_CALL, self.max_steps - done)
        after = self._steps(state, n_steps)
        if self.stop == "published" and (last := self._last_step(after.history, done)) is not None:
            return self._steps(state, last - done) if last - done < n_steps else after
        return after

    def _steps(self, state: AdamaxState, n_steps: int) -> AdamaxState:
        done = len(state.history) - 1
        settings = tf.constant(n_steps), tf.constant(done), tf.constant(self.learning_rate, state.kernels.dtype)
        descent, losses, final = state.kernels.descend(*settings, state.descent, state.data)
        if final < descent.best_loss:
            descent = descent._replace(best=descent.parameters, best_loss=final)
        history = (*state.history, *losses.numpy()[1:n_steps].astype(float), float(final))
        return replace(state, descent=descent, history=history)

    def _last_step(self, history: Sequence[float], done: int) -> int | None:
        """Return the number of the step after `done` at which the published rule stops, or None if it does not.

        The authors compare the losses before two consecutive steps, and take the second, but record none at the start.
        """
        steps = range(max(done + 1, 3), len(history))
        return next((step for step in steps if abs(history[step - 1] - history[step - 2]) < self.tolerance), None)

    def terminate(self, state: AdamaxState) -> Solve | None:
        """Decide by the change of the loss, with the chosen rule."""
        n_steps = len(state.history) - 1
        if not math.isfinite(state.history[-1]):
            return Solve("failed", f"the loss is not finite after {n_steps} steps; lower the learning rate")
        if self.stop == "published":
            if self._last_step(state.history, n_steps - 1) is not None:
                return Solve("converged", f"two consecutive losses differ by less than {self.tolerance:g}")
        elif n_steps >= STEPS_PER_CALL:
            before = min(state.history[:-STEPS_PER_CALL])
            if abs(before - float(state.descent.best_loss)) < self.tolerance:
                message = f"the best loss fell by less than {self.tolerance:g} over {STEPS_PER_CALL} steps"
                return Solve("converged", message)
        if n_steps < self.max_steps:
            return None
        if self.tolerance == 0:
            return Solve("max-steps", f"stopped after {n_steps} steps, a fixed number (tolerance: 0)")
        return Solve("max-steps", f"not converged after {n_steps} steps")

    def losses(self, state: AdamaxState) -> Sequence[float]:
        """Return the loss history, prior included, in the unit of the data squared."""
        return [loss * state.scale**2 for loss in state.history]

    def estimate(self, state: AdamaxState) -> tuple[np.ndarray, np.ndarray]:
        """Return the best gains and foregrounds so far, or the last."""
        chosen = state.descent.best if self.keep == "best" else state.descent.parameters
        return state.kernels.estimate(chosen, state.data, state.scale)

    def newton_decrement(self, state: AdamaxState, problem: CalibrationProblem) -> float:
        """Return the relative Newton decrement at the estimate."""
        return newton_decrement_at(problem, self.estimate(state)[0])

    def memory(self, state: AdamaxState) -> None:
        """Return nothing: only the gains carry over."""
