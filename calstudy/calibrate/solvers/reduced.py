"""The problem for the gains alone, with the foregrounds eliminated, as all its solvers use it.

Eliminating the foregrounds (`calstudy.calibrate.projection`) leaves a least-squares problem for relative changes eta of
the gains, g (1 + eta). At given gains it has a loss L, half of its negative gradient d (the descent direction) and a
Gauss-Newton matrix H. The damped normal equations

    (H + mu K) eta = d,

with the diagonal K of `calstudy.calibrate.solvers.preconditioners.antenna_degrees`, are solved by preconditioned
conjugate gradients. The step is predicted to lower the loss by d^T eta. With a damping that vanishes with the loss this
is the Newton decrement; relative to the loss it measures the distance from the minimum at which any solver has stopped.
Where the preconditioner has the channel blocks of each antenna, its inverse approximates that of H + mu K.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.projection import Linearization, Projection, Projector
from calstudy.calibrate.settings import MOST_COUPLED
from calstudy.calibrate.solvers.preconditioners import (
    AntennaBlocks,
    CoupledBlocks,
    Inverse,
    antenna_blocks,
    antenna_degrees,
    antenna_inverse,
    channel_inverse,
    conjugate_gradients,
    coordinate_inverse,
    coupled_blocks,
    coupled_inverse,
)
from calstudy.calibrate.tensors import BaselineProducts, FitTensors, GainSpace

MOST_DAMPING = 1e-2
CG_TOLERANCE = 1e-3
CG_CHANNEL_ITERATIONS = 300
CG_ANTENNA_ITERATIONS = 60
# With coupled blocks, which take fewer than that to this tolerance.
CG_COUPLED_TOLERANCE = 1e-8
# Largest fraction of baselines without a model of their own, 1 - models / baselines, for which the channel blocks of
# each antenna are the better preconditioner. On the paper's minimally redundant array, 0.05, a fit with weights of its
# own gains takes a fourteenth of the time with them. With 0.18 and more the decrease of the loss that they predict is
# too small by factors, and fits to the default tolerance stop 5 to 130 times as far above the minimum.
FEW_TIED = 0.1
# Loss relative to the data below which a residual is left as it is: 3e-8 of the visibilities, float32's resolution. In
# double precision 3e-10: gains that matter less are nearly degenerate with foregrounds to rounding.
ROUNDING_LOSS = 1e-15
ROUNDING_LOSS_IN_DOUBLE = 1e-19


class FrozenForegrounds:
    """Replacement of `calstudy.calibrate.projection.Projector` for known foregrounds.

    Because foregrounds do not respond, the Gauss-Newton matrix does not couple channels.
    """

    def __init__(self, tensors: FitTensors, dtype: tf.DType = tf.float32) -> None:
        self.tensors, self.dtype, self._products = tensors, dtype, BaselineProducts(tensors)
        self.project = tf.function(self._project, autograph=False)

    def _project(self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor) -> Projection:
        loss, descent = self._products.residual(gains, self.tensors.ends, visibilities, weights, model)
        curvature = self._products.curvature(gains, self.tensors.ends, weights)
        part = Linearization(tf.cast(curvature, self.dtype), tf.cast(model, self.dtype), ())
        return Projection(loss, (model,), descent, (part,))

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the gains alone times eta, shape (2, Nants, Nfreqs)."""
        (part,), ends = projection.parts, self.tensors.ends
        change = self._products.change(eta, ends, part.curvature, part.model)
        return self._products.pull(change, None, ends, part.curvature, part.model)

    def curvature_descent(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the same as `Projector.curvature_descent`, with fixed foregrounds."""
        (part,), ends = projection.parts, self.tensors.ends
        second = pairs.multiply(part.model, ends.relative_change(eta))
        change = self._products.change(eta, ends, part.curvature, second)
        return -self._products.pull(change, None, ends, part.curvature, part.model)


class Dampings(NamedTuple):
    """Dampings relative to the diagonal.

    `per_loss` is that over the loss relative to the data, `least` the smallest that products in a precision can
    resolve, and `preconditioner` the smallest with which blocks can be inverted. `remembered` ones stay raised for the
    next steps.
    """

    per_loss: float
    least: float
    preconditioner: float
    remembered: bool = False


FREE = {tf.float32: Dampings(10.0, 1e-6, 1e-5), tf.float64: Dampings(10.0, 1e-14, 1e-13)}
# Smooth gains, which foregrounds can follow, have a curvature from a finite prior alone: the square of the noise over
# the deviation, far below the damping of a fit that does not determine them at all. Where it is small, valleys are
# curved, and refused steps come one after the other.
FINITE = {tf.float32: Dampings(0.1, 1e-7, 1e-6, True), tf.float64: Dampings(0.1, 1e-14, 1e-13, True)}


class ReducedData(NamedTuple):
    """The arrays of a reduced problem, in float64.

    Gains to start from are (2, Nants, Nfreqs). Data are visibilities (2, Nbls, Nfreqs), in the unit `scale`, their
    weighted rms; weights (Nbls, Nfreqs) whose sum is one; and the model if it is frozen, or mean and deviations of a
    finite prior. `loss_unit` is the unit of the loss, in the unit of the data squared.
    """

    gains: tf.Tensor
    data: tuple[tf.Tensor, ...]
    scale: float
    loss_unit: float


class NormalEquations(NamedTuple):
    """The Gauss-Newton equations at gains, with a damping relative to the diagonal, and a preconditioner's inverse."""

    projection: Projection
    gains: tf.Tensor
    damping: tf.Tensor
    inverse: Inverse


def as_graph(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that TensorFlow runs as a graph, without the passes of its graph optimizer.

    They take a quarter to a half of the compilation time, and change results by rounding only. Without them solves of
    350 antennas take 1 to 7 percent longer, so that ten of these offset the gain. The option applies to the whole
    process; it is restored after each call.
    """
    graph = tf.function(function, autograph=False)

    def call(*arguments: Any) -> Any:
        before = tf.config.optimizer.get_experimental_options()["disable_meta_optimizer"]
        tf.config.optimizer.set_experimental_options({"disable_meta_optimizer": True})
        try:
            return graph(*arguments)
        finally:
            tf.config.optimizer.set_experimental_options({"disable_meta_optimizer": before})

    return call


class ReducedKernels:
    """The compiled operations on the reduced problem of one fit structure.

    `by_channel` says whether the antenna blocks of each channel are the preconditioner throughout: couplings between
    antennas remain the strong ones where more than a few baselines share models without a finite prior, and are the
    only ones where the foregrounds are frozen. If `coupled`, the preconditioner has the couplings between smooth gains
    of all antennas, besides the blocks of each antenna: for thorough kernels, if the array is not too large and each
    baseline has only its own model and coefficients.
    """

    def __init__(
        self, structure: FitStructure, frozen: bool = False, dtype: tf.DType = tf.float32, thorough: bool = False
    ) -> None:
        self.tensors = FitTensors(structure)
        self.structure, self.frozen, self.dtype = structure, frozen, dtype
        finite = structure.prior != "none" and not frozen
        tied = 1 - self.tensors.n_models / self.tensors.n_baselines > FEW_TIED and not finite
        self.by_channel = (tied or frozen) and structure.gain_vectors is None
        self.dampings = (FINITE if finite else FREE)[dtype]
        self.projector = (
            FrozenForegrounds(self.tensors, dtype) if frozen else Projector(structure, self.tensors, dtype, thorough)
        )
        self.coupled = thorough and self._can_couple()
        self.cg_tolerance = CG_COUPLED_TOLERANCE if self.coupled else CG_TOLERANCE
        self.space = GainSpace(structure.gain_vectors, dtype)
        self.exact_space = GainSpace(structure.gain_vectors, tf.float64)
        self.project = as_graph(self.projector.project)
        self.step = as_graph(self._step)
        self.blocks = as_graph(self._blocks)
        self._antenna_inverse = as_graph(self._inverse)
        self.accelerate = as_graph(self._accelerate)
        self.solve_graph = as_graph(self.solve)
        self.left_of = as_graph(self._left_of)
        self.predicted_decrease = as_graph(self._predicted_decrease)

    def _can_couple(self) -> bool:
        if isinstance(self.projector, FrozenForegrounds):
            return False
        rows = 2 * self.tensors.n_antennas * self.projector.common.shape[1]
        alone = not self.tensors.shared and self.structure.prior != "both"
        return alone and self.structure.gain_vectors is None and rows <= MOST_COUPLED

    def scalar(self, value: float) -> tf.Tensor:
        """Return a number in the precision of the inner products."""
        return tf.constant(value, self.dtype)

    def damping(self, loss: float) -> float:
        """Return the damping, relative to the diagonal, at a loss relative to the weighted square of the data."""
        return min(max(self.dampings.per_loss * loss, self.dampings.least), MOST_DAMPING)

    def reduce(self, problem: CalibrationProblem, gains: np.ndarray) -> ReducedData:
        """Return the data of a problem, and gains (Nants, Nfreqs) as close as their space allows, as tensors."""
        data = self.tensors.load(problem, tf.float64)
        total = float(tf.reduce_sum(data.weights))
        arrays: tuple[tf.Tensor, ...] = (data.visibilities, data.weights / total)
        if (mean := problem.mean) is not None:
            arrays += (self.tensors.load_model(mean, data.scale, tf.float64),)
        if self.structure.prior != "none":
            # Coefficients of unit variance stay so if the loss is divided by its unit and the weights by their sum.
            arrays += (tf.constant(math.sqrt(total) * np.array(problem.deviations), tf.float64),)
        start = self.exact_space.expand(self.exact_space.reduce(pairs.to_pair(gains, tf.float64)))
        return ReducedData(start, arrays, data.scale, total * data.scale**2)

    def _step(
        self, projection: Projection, gains: tf.Tensor, inverse: Inverse | None, damping: tf.Tensor
    ) -> tuple[tf.Tensor, tf.Tensor, tf.Tensor]:
        """Return eta, the decrease of the loss that its quadratic model predicts, and the number of iterations.

        With `inverse` of None, the preconditioner has the antenna blocks of each channel.
        """
        most = CG_CHANNEL_ITERATIONS if inverse is None else CG_ANTENNA_ITERATIONS
        equations, descent = (
            self._equations(projection, gains, inverse, damping),
            tf.cast(projection.descent, self.dtype),
        )
        eta, iterations = self.solve(equations, descent, self.cg_tolerance, most)
        return eta, pairs.inner_product(descent, eta), iterations

    def _equations(
        self, projection: Projection, gains: tf.Tensor, inverse: Inverse | None, damping: tf.Tensor
    ) -> NormalEquations:
        known = channel_inverse(self.tensors, projection, damping) if inverse is None else inverse
        return NormalEquations(projection, gains, damping, known)

    def _accelerate(
        self, projection: Projection, gains: tf.Tensor, inverse: Inverse | None, damping: tf.Tensor, eta: tf.Tensor
    ) -> tf.Tensor:
        """Return the geodesic acceleration of a step eta (Transtrum & Sethna 2012), (2, Nants, Nfreqs).

        It solves the damped normal equations of the step for the second derivative of the residual along eta. Half of
        it added to eta keeps a long step in a curved valley.
        """
        equations = self._equations(projection, gains, inverse, damping)
        descent = self.projector.curvature_descent(eta, projection)
        return self.solve(equations, descent, self.cg_tolerance, CG_ANTENNA_ITERATIONS)[0]

    def solve(
        self, equations: NormalEquations, descent: tf.Tensor, tolerance: float, iterations: int
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return eta for minus half a gradient, both (2, Nants, Nfreqs), and the number of iterations."""
        projection = equations.projection
        diagonal = equations.damping * antenna_degrees(self.tensors, projection)
        gains = tf.cast(equations.gains, self.dtype)

        def operator(coordinates: tf.Tensor) -> tf.Tensor:
            eta = self.space.expand_relative(coordinates, gains)
            image = self.projector.hessian_product(eta, projection) + diagonal * eta
            return self.space.reduce_relative(image, gains)

        coordinates, count = conjugate_gradients(
            operator,
            equations.inverse.apply,
            self.space.reduce_relative(descent, gains),
            tf.constant(tolerance, self.dtype),
            tf.constant(iterations),
        )
        return self.space.expand_relative(coordinates, gains), count

    def _left_of(
        self, equations: NormalEquations, difference: tf.Tensor, tolerance: float, iterations: int
    ) -> tuple[tf.Tensor, ...]:
        """Return the rest of a difference of the data after a fit with foregrounds, times D (`Projector.left_of`)."""
        if isinstance(self.projector, FrozenForegrounds):
            raise TypeError("known foregrounds have no prior")
        projection = equations.projection
        descent = self.projector.descent_by(difference, projection)
        eta, _ = self.solve(equations, descent, tolerance, iterations)
        return self.projector.left_of(difference, eta, projection)

    def _blocks(self, projection: Projection) -> AntennaBlocks | CoupledBlocks:
        if isinstance(self.projector, FrozenForegrounds):
            return AntennaBlocks(antenna_degrees(self.tensors, projection))
        return (coupled_blocks if self.coupled else antenna_blocks)(self.projector, projection)

    def inverse(self, blocks: AntennaBlocks | CoupledBlocks, damping: tf.Tensor, gains: tf.Tensor) -> Inverse:
        """Invert damped blocks, at gains (2, Nants, Nfreqs)."""
        if isinstance(blocks, CoupledBlocks):
            return coupled_inverse(blocks, self.tensors.ends, float(damping))
        return self._antenna_inverse(blocks, damping, gains)

    def _inverse(self, blocks: AntennaBlocks, damping: tf.Tensor, gains: tf.Tensor) -> Inverse:
        if self.space.vectors is None:
            return antenna_inverse(blocks, damping)
        return coordinate_inverse(blocks, self.space.columns(tf.cast(gains, self.dtype)), damping)

    def _predicted_decrease(self, projection: Projection, gains: tf.Tensor, inverse: Inverse) -> tf.Tensor:
        descent = self.space.reduce_relative(tf.cast(projection.descent, self.dtype), tf.cast(gains, self.dtype))
        return pairs.inner_product(descent, inverse.apply(descent))


def compiled(
    structure: FitStructure, frozen: bool = False, dtype: tf.DType = tf.float32, thorough: bool = False
) -> ReducedKernels:
    """Return the kernels of a structure, compiled once for all its integrations.

    `dtype` is that of the inner products (see `calstudy.calibrate.projection.Projector`). With `thorough`, they resolve
    gains that foregrounds can nearly follow, by coupled blocks and foregrounds that respond twice: for an iteration in
    double precision, not for a check whether one is needed.
    """
    return _kernels(structure, frozen, dtype, thorough)


# By positional arguments alone, because a cache takes others for different ones.
_kernels = lru_cache(maxsize=8)(ReducedKernels)


def newton_decrement_at(problem: CalibrationProblem, gains: np.ndarray) -> float:
    """Return the relative Newton decrement of the reduced problem at gains (Nants, Nfreqs) (see `Solve`)."""
    kernels = compiled(problem.structure, problem.frozen)
    reduced = kernels.reduce(problem, gains)
    projection = kernels.project(reduced.gains, *reduced.data)
    loss = float(projection.loss)
    if loss < ROUNDING_LOSS:
        return 0.0
    damping = kernels.damping(loss)
    if kernels.by_channel:
        _, decrease, _ = kernels.step(projection, reduced.gains, None, kernels.scalar(damping))
        return float(decrease) / loss
    stronger = kernels.scalar(max(damping, kernels.dampings.preconditioner))
    inverse = kernels.inverse(kernels.blocks(projection), stronger, reduced.gains)
    return float(kernels.predicted_decrease(projection, reduced.gains, inverse)) / loss
