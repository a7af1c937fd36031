"""Approximations of the Gauss-Newton matrix of the gains, and their inverses.

Far from the minimum the couplings between antennas within a channel matter most; close to it, those between channels
within an antenna, which the eliminated foregrounds cause. Where the damping is so small that smooth gains of all
antennas together, which foregrounds can follow, must be resolved, both matter.

In the notation of `calstudy.calibrate.projection`, the block of one antenna is K - C. K is diagonal, the sum of D |F|^2
over the antenna's baselines: its degrees. C is the part that the foregrounds of these baselines absorb, the sum of (D
F)^* P S^T S P^T (D F) with the span P of a baseline's batch, conjugated where the antenna is the second of its
baseline. Foregrounds of few vectors follow only smooth changes, so that K - C is close to zero only for some gains in
the span of the common basis Q of all foregrounds, and not much below K for others. The preconditioner M has the values
of the block on that span, and is K on its complement in the metric of K:

    M = K - L (Q^T C Q) L^T, L = K Q (Q^T K Q)^-1
    M^-1 = K^-1 + Q [ (Q^T (K - C) Q)^-1 - (Q^T K Q)^-1 ] Q^T

M is positive definite, because C nowhere exceeds K. With a damping relative to the diagonal, K is replaced by (1 +
damping) K, which does not change L.

The coupled blocks have the same form, with all antennas in one: M has the values of the whole Gauss-Newton matrix on
the span of Q, for gains of any antennas, and is K on its complement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import scipy.linalg

from calstudy.base.tensorflow import tf
from calstudy.calibrate.batches import Piece, column_products, joined
from calstudy.calibrate.pairs import inner_product
from calstudy.calibrate.projection import Linearization, Projection, Projector
from calstudy.calibrate.tensors import Ends, FitTensors

# Floor of the degrees relative to their mean, for antennas and channels with few data.
DEGREE_FLOOR = 1e-4


class Inverse(Protocol):
    """The inverse of a preconditioner."""

    def apply(self, values: tf.Tensor) -> tf.Tensor:
        """Return the inverse times real and imaginary parts of the gains, or of their coordinates, (2, Nants, N)."""


def antenna_degrees(tensors: FitTensors, projection: Projection) -> tf.Tensor:
    """Return sum_b D |F|^2 of each antenna and channel, floored, shape (Nants, Nfreqs)."""
    power, ends = projection.power(), tensors.ends
    degree = tf.math.unsorted_segment_sum(power, ends.first, tensors.n_antennas)
    degree += tf.math.unsorted_segment_sum(power, ends.second, tensors.n_antennas)
    return tf.maximum(degree, DEGREE_FLOOR * tf.reduce_mean(degree))


class ChannelInverse(NamedTuple):
    """Cholesky factors of the antenna blocks of channels, for real and imaginary parts, (2, Nfreqs, Nants, Nants)."""

    factors: tf.Tensor

    def apply(self, values: tf.Tensor) -> tf.Tensor:
        """Return the inverse times (2, Nants, Nfreqs)."""
        columns = tf.transpose(values, [0, 2, 1])[..., None]
        return tf.transpose(tf.linalg.cholesky_solve(self.factors, columns)[..., 0], [0, 2, 1])


def channel_inverse(tensors: FitTensors, projection: Projection, damping: tf.Tensor) -> ChannelInverse:
    """Invert the damped antenna blocks of each channel.

    Foregrounds are held fixed in these blocks, so that real and imaginary parts of eta decouple: the blocks are the
    degree plus and minus the coupling matrix.
    """
    shape = [tensors.n_antennas, tensors.n_antennas, tensors.n_frequencies]
    coupling = tf.transpose(tf.scatter_nd(tf.stack(tensors.ends, axis=1), projection.power(), shape), [2, 0, 1])
    coupling += tf.transpose(coupling, [0, 2, 1])
    degree = tf.reduce_sum(coupling, -1)
    degree = tf.maximum(degree, DEGREE_FLOOR * tf.reduce_mean(degree))
    diagonal = tf.linalg.diag(degree * (1 + damping))
    # The common phase of a channel is an exact null of the second block; a constant matrix lifts it.
    lift = tf.reduce_mean(degree, -1)[:, None, None] / tensors.n_antennas
    return ChannelInverse(
        tf.stack([tf.linalg.cholesky(diagonal + coupling), tf.linalg.cholesky(diagonal - coupling + lift)])
    )


class AntennaBlocks(NamedTuple):
    """The channel blocks of each antenna, undamped: the degrees K, (Nants, Nfreqs), and what foregrounds absorb.

    With Q, (Nfreqs, rank), the Gram matrix is Q^T K Q, (Nants, rank, rank), and `absorbed` is Q^T C Q, real and
    imaginary part, (2, Nants, rank, rank). All but K are None if there are no foregrounds.
    """

    degrees: tf.Tensor
    common: tf.Tensor | None = None
    gram: tf.Tensor | None = None
    absorbed: tf.Tensor | None = None


def antenna_blocks(projector: Projector, projection: Projection) -> AntennaBlocks:
    """Compute the channel blocks of each antenna.

    Couplings between baselines that share a foreground model are left out; the blocks stay positive.
    """
    tensors, common = projector.tensors, projector.common
    rank = common.shape[1]
    degrees = antenna_degrees(tensors, projection)
    gram = column_products(degrees, common, common)
    firsts = seconds = tf.zeros([tensors.n_antennas, rank, rank], projector.dtype)
    for piece, span, part in projector.of_pieces(projection):
        # Temporaries of several batches would add up.
        with tf.control_dependencies([firsts, seconds]):
            both = _absorbed(projector, piece, span, part)
            ends = tensors.ends.slice(*piece.batch.baselines)
            firsts += tf.math.unsorted_segment_sum(both, ends.first, tensors.n_antennas)
            seconds += tf.math.unsorted_segment_sum(both, ends.second, tensors.n_antennas)
    # The second antenna of a baseline sees the conjugate.
    summed = firsts + tf.linalg.matrix_transpose(seconds)
    turned = tf.linalg.matrix_transpose(summed)
    return AntennaBlocks(degrees, common, gram, tf.stack([summed + turned, summed - turned]) / 2)


def _absorbed(projector: Projector, piece: Piece, span: tf.Tensor | None, part: Linearization) -> tf.Tensor:
    """Return Q^T C Q of each baseline of a batch, for its first antenna, (Nbls, rank, rank).

    It is Hermitian: its symmetric part is the real one, its antisymmetric part the imaginary one.
    """
    weighted = tf.reshape(part.curvature * part.model, [-1, projector.common.shape[0]])
    mixed = column_products(weighted, piece.span, projector.common, span)
    roots = projector.baseline_roots(piece, *part.roots)
    real, imaginary = (roots @ values for values in tf.split(mixed, 2))
    left, right = tf.concat([real, imaginary], 1), tf.concat([real + imaginary, imaginary - real], 1)
    return tf.matmul(left, right, transpose_a=True)


class AntennaInverse(NamedTuple):
    """Inverse of the channel blocks of each antenna, ``diagonal + Q correction Q^T``, with Q = `common`.

    `diagonal` is 1 / ((1 + damping) K); `correction` is Hermitian, real and imaginary part, (2, Nants, rank, rank).
    """

    common: tf.Tensor
    diagonal: tf.Tensor
    correction: tf.Tensor

    def apply(self, values: tf.Tensor) -> tf.Tensor:
        """Return the inverse times (2, Nants, Nfreqs)."""
        n_frequencies, rank = self.common.shape
        inner = tf.reshape(tf.reshape(values, [-1, n_frequencies]) @ self.common, [2, -1, rank, 1])
        real, imaginary = tf.unstack(self.correction)
        inner = tf.stack([real @ inner[0] - imaginary @ inner[1], real @ inner[1] + imaginary @ inner[0]])
        outer = tf.matmul(tf.reshape(inner, [-1, rank]), self.common, transpose_b=True)
        return self.diagonal * values + tf.reshape(outer, tf.shape(values))


def antenna_inverse(blocks: AntennaBlocks, damping: tf.Tensor) -> AntennaInverse:
    """Invert the damped blocks, for gains of any value in any channel."""
    # The inverse of a small difference of large numbers: what float32 has lost of it is below the damping.
    gram = tf.cast(1 + damping, tf.float64) * tf.cast(blocks.gram, tf.float64)
    real, imaginary = tf.unstack(tf.cast(blocks.absorbed, tf.float64))
    correction = _inverse(tf.complex(gram - real, -imaginary)) - tf.cast(_inverse(gram), tf.complex128)
    correction = tf.cast(tf.stack([tf.math.real(correction), tf.math.imag(correction)]), damping.dtype)
    return AntennaInverse(blocks.common, 1 / ((1 + damping) * blocks.degrees), correction)


class CoupledBlocks(NamedTuple):
    """The Gauss-Newton matrix on the span of the common basis, for baselines that each have their own model.

    A baseline depends on eta_a + eta_b*. Real parts of both antennas have the same matrix, `alike`, the symmetric part
    of Q^T (D |F|^2 - C) Q of each baseline, (Nbls, rank, rank). Imaginary parts have its negative between the two
    antennas. Real parts couple to imaginary ones by `crossed`, the antisymmetric part of Q^T C Q, negative for those of
    the second antenna. `degrees`, `common` and `gram` are as in `AntennaBlocks`.
    """

    degrees: tf.Tensor
    common: tf.Tensor
    gram: tf.Tensor
    alike: tf.Tensor
    crossed: tf.Tensor

    def matrix(self, ends: Ends) -> np.ndarray:
        """Return the matrix for real, then imaginary parts of all antennas, (2 * Nants * rank, 2 * Nants * rank)."""
        n_antennas, rank = self.gram.shape[:2]
        whole = np.zeros((2, n_antennas, rank, 2, n_antennas, rank))
        baselines = zip(*(index.numpy() for index in ends), self.alike.numpy(), self.crossed.numpy(), strict=True)
        for a, b, alike, crossed in baselines:
            for antenna, other, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                whole[0, antenna, :, 0, other] += alike
                whole[1, antenna, :, 1, other] += sign * alike
            for antenna, other, sign in ((a, a, 1), (b, b, -1), (a, b, -1), (b, a, 1)):
                whole[0, antenna, :, 1, other] += sign * crossed
                whole[1, other, :, 0, antenna] -= sign * crossed
        return whole.reshape(2 * n_antennas * rank, -1)


def coupled_blocks(projector: Projector, projection: Projection) -> CoupledBlocks:
    """Compute the Gauss-Newton matrix on the span of the common basis."""
    common, degrees = projector.common, antenna_degrees(projector.tensors, projection)
    both = joined([_absorbed(projector, *of_piece) for of_piece in projector.of_pieces(projection)], 0)
    turned = tf.linalg.matrix_transpose(both)
    alike = column_products(projection.power(), common, common) - (both + turned) / 2
    return CoupledBlocks(degrees, common, column_products(degrees, common, common), alike, (both - turned) / 2)


class CoupledInverse(NamedTuple):
    """Inverse of the damped coupled blocks, by the Cholesky factor of their matrix; Q and diagonal as `AntennaInverse`.

    `gram_inverse` is the inverse of (1 + damping) Q^T K Q, (Nants, rank, rank).
    """

    common: tf.Tensor
    diagonal: tf.Tensor
    factor: tf.Tensor
    gram_inverse: tf.Tensor

    def apply(self, values: tf.Tensor) -> tf.Tensor:
        """Return the inverse times (2, Nants, Nfreqs)."""
        inner = tf.einsum("caf,fr->car", values, self.common)
        solved = tf.reshape(tf.linalg.cholesky_solve(self.factor, tf.reshape(inner, [-1, 1])), tf.shape(inner))
        solved -= tf.linalg.matvec(self.gram_inverse, inner)
        return self.diagonal * values + tf.einsum("car,fr->caf", solved, self.common)


def coupled_inverse(blocks: CoupledBlocks, ends: Ends, damping: float) -> CoupledInverse:
    """Invert the damped coupled blocks, in double precision; all NaN if rounding has left them indefinite."""
    matrix, gram = blocks.matrix(ends), blocks.gram.numpy()
    n_antennas, rank = gram.shape[:2]
    parts = matrix.reshape(2, n_antennas, rank, 2, n_antennas, rank)
    for antenna in range(n_antennas):
        for part in range(2):
            parts[part, antenna, :, part, antenna] += damping * gram[antenna]
    # The common phase of all antennas is an exact null; a constant matrix lifts it, as for the blocks of each channel.
    parts[1, :, :, 1] += gram.mean(axis=0)[:, None] / n_antennas
    try:
        # LAPACK's is three times as fast as TensorFlow's.
        factor = scipy.linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        factor = np.full_like(matrix, np.nan)
    diagonal, gram_inverse = 1 / ((1 + damping) * blocks.degrees), _inverse((1 + damping) * blocks.gram)
    return CoupledInverse(blocks.common, diagonal, tf.constant(factor), gram_inverse)


class CoordinateInverse(NamedTuple):
    """Cholesky factors of the blocks of each antenna for coordinates, (Nants, Ngain, Ngain), complex64."""

    factors: tf.Tensor

    def apply(self, values: tf.Tensor) -> tf.Tensor:
        """Return the inverse times (2, Nants, Ngain)."""
        solved = tf.linalg.cholesky_solve(self.factors, tf.complex(values[0], values[1])[..., None])[..., 0]
        return tf.stack([tf.math.real(solved), tf.math.imag(solved)])


def coordinate_inverse(blocks: AntennaBlocks, columns: tf.Tensor, damping: tf.Tensor) -> CoordinateInverse:
    """Invert the damped blocks for gains in a space of smooth ones, with columns of `GainSpace.columns`."""
    diagonal = tf.cast((1 + damping) * blocks.degrees, columns.dtype)
    matrix = tf.matmul(columns, diagonal[:, :, None] * columns, adjoint_a=True)
    if blocks.absorbed is not None:
        # L of the module's M.
        inverse = tf.cast(_inverse(tf.cast(blocks.gram, tf.float64)), blocks.degrees.dtype)
        lift = tf.cast(blocks.degrees[:, :, None] * (blocks.common @ inverse), columns.dtype)
        inner = tf.matmul(columns, lift, adjoint_a=True)
        matrix -= inner @ tf.matmul(tf.complex(blocks.absorbed[0], blocks.absorbed[1]), inner, adjoint_b=True)
    return CoordinateInverse(tf.linalg.cholesky(matrix))


def _inverse(matrices: tf.Tensor) -> tf.Tensor:
    """Invert positive definite matrices, (..., N, N)."""
    identity = tf.eye(tf.shape(matrices)[-1], batch_shape=tf.shape(matrices)[:-2], dtype=matrices.dtype)
    return tf.linalg.cholesky_solve(tf.linalg.cholesky(matrices), identity)


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
