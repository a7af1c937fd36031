"""Two block-diagonal approximations of the Gauss-Newton matrix of the gains.

Far from the minimum the couplings between antennas within a channel matter most; close to it, those between channels
within an antenna, which the eliminated foregrounds bring in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.projection import Projection, Projector
from calstudy.calibrate.tensors import FitTensors

# Antennas and channels with hardly any data count as having this fraction of the mean.
DEGREE_FLOOR = 1e-4


def antenna_degrees(tensors: FitTensors, projection: Projection) -> tf.Tensor:
    """Return sum_b D |F|^2 of each antenna and channel, floored, shape (Nants, Nfreqs), float32."""
    power = projection.curvature * pairs.squared_modulus(projection.baseline_model)
    degree = tf.math.unsorted_segment_sum(power, tensors.first, tensors.n_antennas)
    degree += tf.math.unsorted_segment_sum(power, tensors.second, tensors.n_antennas)
    return tf.maximum(degree, DEGREE_FLOOR * tf.reduce_mean(degree))


def channel_factors(tensors: FitTensors, projection: Projection, damping: tf.Tensor) -> tf.Tensor:
    """Return Cholesky factors of the damped antenna blocks of each channel, shape (2, Nfreqs, Nants, Nants).

    Foregrounds are held fixed in these blocks, so that real and imaginary parts of eta decouple: the blocks are the
    degree plus and minus the coupling matrix.
    """
    power = tf.transpose(projection.curvature * pairs.squared_modulus(projection.baseline_model))
    index = tf.stack([tensors.first, tensors.second], axis=1)
    shape = [tensors.n_antennas, tensors.n_antennas, tensors.n_frequencies]
    coupling = tf.transpose(tf.scatter_nd(index, tf.transpose(power), shape), [2, 0, 1])
    coupling += tf.transpose(coupling, [0, 2, 1])
    degree = tf.reduce_sum(coupling, -1)
    degree = tf.maximum(degree, DEGREE_FLOOR * tf.reduce_mean(degree))
    diagonal = tf.linalg.diag(degree * (1 + damping))
    # The common phase of a channel is an exact null of the second block; a constant matrix lifts it.
    lift = tf.reduce_mean(degree, -1)[:, None, None] / tensors.n_antennas
    return tf.stack([tf.linalg.cholesky(diagonal + coupling), tf.linalg.cholesky(diagonal - coupling + lift)])


def solve_channels(factors: tf.Tensor, values: tf.Tensor) -> tf.Tensor:
    """Apply the inverse of the channel blocks to (2, Nants, Nfreqs)."""
    columns = tf.transpose(values, [0, 2, 1])[..., None]
    return tf.transpose(tf.linalg.cholesky_solve(factors, columns)[..., 0], [0, 2, 1])


class AntennaRows(NamedTuple):
    """Which rows of all the sequences an antenna needs; (Nants, Nrows), padded with rows of sign and mask zero.

    Attributes
    ----------
    row, baseline
        The row, and the baseline that brings it in.
    sign
        -1 where the antenna is the first of the baseline, 1 where it is the second.
    """

    row: np.ndarray
    baseline: np.ndarray
    sign: np.ndarray


def antenna_rows(tensors: FitTensors) -> AntennaRows:
    """Return the rows of each antenna, for sequences stacked model after model."""
    sizes = np.concatenate(
        [np.full(e - s, b.shape[-1]) for (s, e), b in zip(tensors.slices, tensors.bases, strict=True)]
    )
    starts = np.cumsum(sizes) - sizes
    model = np.arange(tensors.n_baselines) if tensors.model_index is None else tensors.model_index.numpy()
    columns: list[list[np.ndarray]] = []
    for antenna in range(tensors.n_antennas):
        parts = [
            (np.arange(starts[model[p]], starts[model[p]] + sizes[model[p]]), p, sign)
            for index, sign in ((tensors.first, -1), (tensors.second, 1))
            for p in np.flatnonzero(index.numpy() == antenna)
        ]
        rows = [part[0] for part in parts]
        columns.append(
            [
                np.concatenate([*rows, np.empty(0, int)]),
                np.concatenate([*(np.full(r.size, p) for r, p, _ in parts), np.empty(0, int)]),
                np.concatenate([*(np.full(r.size, sign) for r, _, sign in parts), np.empty(0, int)]),
            ]
        )
    longest = max(column[0].size for column in columns)
    padded = [
        np.stack([np.pad(part, (0, longest - part.size)) for part in parts]) for parts in zip(*columns, strict=True)
    ]
    return AntennaRows(*padded)


def antenna_blocks(projector: Projector, projection: Projection) -> tf.Tensor:
    """Return the channel blocks of each antenna, Hermitian, shape (Nants, Nfreqs, Nfreqs), complex64, undamped.

    Each baseline adds diag(K) - (D F) Q W Q^T (D F)^* to both its antennas, conjugated for the first. With the kernel
    as a sum of squares, the second terms of an antenna are one product of a long thin matrix with itself. Couplings
    between baselines that share a foreground model are left out; the blocks stay positive.
    """
    tensors, common = projector.tensors, projector.common
    # In the common basis, for all the sequences at once would be the largest array of a solve.
    rows = tf.concat(
        [projector.spread(index, root, by_member=True) for index, root in enumerate(projection.roots)],
        axis=0,
    )
    weighted = projection.curvature * projection.baseline_model
    table = antenna_rows(tensors)

    def block(inputs: tuple[tf.Tensor, ...]) -> tf.Tensor:
        row, baseline, sign, degree = inputs
        row_sequences = tf.matmul(tf.gather(rows, row), common, transpose_b=True)
        real = tf.abs(sign)[:, None] * row_sequences * tf.gather(weighted[0], baseline)
        imaginary = sign[:, None] * row_sequences * tf.gather(weighted[1], baseline)
        both = tf.concat([real, imaginary], axis=0)
        crossed = tf.matmul(imaginary, real, transpose_a=True)
        square = tf.matmul(both, both, transpose_a=True)
        return tf.complex(tf.linalg.diag(degree) - square, tf.transpose(crossed) - crossed)

    inputs = (
        tf.constant(table.row, tf.int32),
        tf.constant(table.baseline, tf.int32),
        tf.constant(table.sign, tf.float32),
        antenna_degrees(tensors, projection),
    )
    # One antenna at a time: the temporaries of several would be large.
    return tf.map_fn(block, inputs, fn_output_signature=tf.complex64, parallel_iterations=1)


def solve_antennas(factors: tf.Tensor, values: tf.Tensor) -> tf.Tensor:
    """Apply the inverse of the antennas' blocks to (2, Nants, Nfreqs)."""
    solved = tf.linalg.cholesky_solve(factors, tf.complex(values[0], values[1])[..., None])[..., 0]
    return tf.stack([tf.math.real(solved), tf.math.imag(solved)])
