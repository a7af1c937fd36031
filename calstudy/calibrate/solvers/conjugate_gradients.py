"""Preconditioned conjugate gradients on real tensors of any shape."""

from __future__ import annotations

from collections.abc import Callable

from calstudy.base.tensorflow import tf
from calstudy.calibrate.pairs import inner_product

Operator = Callable[[tf.Tensor], tf.Tensor]


def conjugate_gradients(
    operator: Operator, preconditioner: Operator, right_side: tf.Tensor, tolerance: tf.Tensor, max_iterations: tf.Tensor
) -> tuple[tf.Tensor, tf.Tensor]:
    """Solve ``operator(x) = right_side`` from zero; both operators must be symmetric and positive definite.

    Iterations stop when the residual's squared norm, in the metric of the preconditioner, has fallen by the factor
    `tolerance`, or at `max_iterations`, an int32 scalar. Returns the solution and the number of iterations.
    """
    first = preconditioner(right_side)
    squared = inner_product(right_side, first)

    def unfinished(
        iteration: tf.Tensor, _x: tf.Tensor, _residual: tf.Tensor, _direction: tf.Tensor, rho: tf.Tensor
    ) -> tf.Tensor:
        return (iteration < max_iterations) & (rho > tolerance * squared)

    def body(
        iteration: tf.Tensor, x: tf.Tensor, residual: tf.Tensor, direction: tf.Tensor, rho: tf.Tensor
    ) -> tuple[tf.Tensor, ...]:
        image = operator(direction)
        length = rho / inner_product(direction, image)
        x, residual = x + length * direction, residual - length * image
        conditioned = preconditioner(residual)
        new_rho = inner_product(residual, conditioned)
        return iteration + 1, x, residual, conditioned + new_rho / rho * direction, new_rho

    start = (tf.constant(0), tf.zeros_like(right_side), right_side, first, squared)
    iterations, x, *_ = tf.while_loop(unfinished, body, start)
    return x, iterations
