"""Batches of foreground models that are worked on at once, and the products with their bases.

Baselines of like length share a basis (`calstudy.calibrate.basis`), and an array can have as many bases as baselines.
What is compiled grows with the number of pieces, so that models of different bases are put together into a few batches,
their coefficients padded with zeros: a vector of zeros has no part in anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import tensorflow as tf

# Different bases are padded to about this many sizes: more take longer to compile, fewer longer to run.
BATCHES = 8
# Batches of fewer baselines than this are not worth their compilation.
LEAST_BATCH = 16
# One matrix product for each basis is faster than one for each model, if that many have it.
ALIKE = 4


class Batch(NamedTuple):
    """Consecutive models whose foregrounds are eliminated at once.

    Attributes
    ----------
    models, baselines
        First one and one past the last, in the solvers' order.
    bases
        The different bases of these models, (Nfreqs, Nvec) each, float64; a single one of (Nmodels, Nfreqs, Nvec) if
        the models have their coefficients in common.
    basis_index
        Which of them each model has, (Nmodels,), ascending.
    """

    models: tuple[int, int]
    baselines: tuple[int, int]
    bases: tuple[np.ndarray, ...]
    basis_index: np.ndarray

    @property
    def joint(self) -> bool:
        """Whether the models have their coefficients in common."""
        return self.bases[0].ndim == 3


def make_batches(bases: Sequence[np.ndarray], sizes: Sequence[int], edges: np.ndarray, most: int) -> list[Batch]:
    """Return batches of at most `most` baselines, unless one model has more or models have common coefficients.

    Parameters
    ----------
    bases
        Of each bucket, as in `Batch`; their models follow each other.
    sizes
        Number of models of each bucket.
    edges
        First baseline of each model, and one past the last of all, (Nmodels + 1,).
    most
        Baselines.
    """
    joint = np.repeat([basis.ndim == 3 for basis in bases], sizes)
    bucket_of = np.repeat(np.arange(len(bases)), sizes)
    # Few bases are better kept apart, because none is padded then.
    apart = len(bases) - np.unique(bucket_of[joint]).size <= BATCHES
    if not apart:
        most = min(most, max(-(-int(edges[-1]) // BATCHES), LEAST_BATCH))
    n_models, cuts = len(bucket_of), [0]
    for model in range(1, n_models):
        full = not joint[model] and edges[model + 1] - edges[cuts[-1]] > most
        other = bucket_of[model] != bucket_of[model - 1]
        if full or (other and (apart or joint[model] or joint[model - 1])):
            cuts.append(model)
    batches = []
    for start, end in pairwise([*cuts, n_models]):
        found, index = np.unique(bucket_of[start:end], return_inverse=True)
        chosen = tuple(bases[bucket] for bucket in found)
        batches.append(Batch((start, end), (int(edges[start]), int(edges[end])), chosen, index))
    return batches


class Vectors:
    """Products with the vectors A of some rows, which are models or baselines.

    Parameters
    ----------
    bases
        Different A^T, (Nbases, Nvec, length), float64, padded with rows of zeros.
    overlaps
        A^T Q of each, (Nbases, Nvec, rank), in the precision of the inner products.
    widths
        Vectors that are not padding, (Nbases,).
    index
        Which of them each row has, (Nrows,), ascending.
    """

    def __init__(self, bases: np.ndarray, overlaps: np.ndarray, widths: np.ndarray, index: np.ndarray) -> None:
        self.n_vectors, self.length = bases.shape[1:]
        # One where coefficients are not padding, zero where they are.
        self.filled = np.arange(self.n_vectors) < widths[index][:, None]
        # How many rows each basis has, or, if there are few of each, the basis of every row.
        self._rows_of_basis = np.bincount(index, minlength=len(bases)).tolist()
        self._by_basis = len(index) >= ALIKE * len(bases) or len(bases) == 1
        self._bases = [tf.constant(basis.T) for basis in bases] if self._by_basis else []
        self._overlaps = [tf.constant(overlap) for overlap in overlaps] if self._by_basis else []
        self._stack, self._stacked_overlaps = tf.constant(bases), tf.constant(overlaps)
        self._index = tf.constant(index, tf.int32)

    def normal(self, curvature: tf.Tensor) -> tf.Tensor:
        """Return A^T D A, (Nrows, Nvec, Nvec), for D of shape (Nrows, length)."""
        if not self._by_basis:
            stacked = tf.gather(self._stack, self._index)
            return tf.matmul(curvature[:, None, :] * stacked, stacked, transpose_b=True)
        found = []
        for rows, basis in zip(tf.split(curvature, self._rows_of_basis), self._bases, strict=True):
            weighted = tf.reshape(tf.expand_dims(rows, 1) * tf.transpose(basis), [-1, self.length])
            found.append(tf.reshape(weighted @ basis, [-1, self.n_vectors, self.n_vectors]))
        return _joined(found, 0)

    def reduce(self, values: tf.Tensor) -> tf.Tensor:
        """Return A^T y, (Nrows, Nvec, 2), for y of shape (2, Nrows, length)."""
        if not self._by_basis:
            return tf.matmul(tf.gather(self._stack, self._index), tf.transpose(values, [1, 2, 0]))
        found = []
        for rows, basis in zip(tf.split(values, self._rows_of_basis, axis=1), self._bases, strict=True):
            product = tf.reshape(rows, [-1, self.length]) @ basis
            found.append(tf.reshape(product, [2, -1, self.n_vectors]))
        return tf.transpose(_joined(found, 1), [1, 2, 0])

    def expand(self, coefficients: tf.Tensor) -> tf.Tensor:
        """Return A u, (2, Nrows, length), for coefficients u of shape (Nrows, Nvec, 2)."""
        if not self._by_basis:
            product = tf.matmul(tf.gather(self._stack, self._index), coefficients, transpose_a=True)
            return tf.transpose(product, [2, 0, 1])
        found = []
        columns = tf.transpose(coefficients, [2, 0, 1])
        for rows, basis in zip(tf.split(columns, self._rows_of_basis, axis=1), self._bases, strict=True):
            product = tf.matmul(tf.reshape(rows, [-1, self.n_vectors]), basis, transpose_b=True)
            found.append(tf.reshape(product, [2, -1, self.length]))
        return _joined(found, 1)

    def overlap(self, root: tf.Tensor) -> tf.Tensor:
        """Return R A^T Q, (Nrows, N, rank), for R of shape (Nrows, N, Nvec)."""
        if not self._by_basis:
            return root @ tf.gather(self._stacked_overlaps, self._index)
        found = []
        for rows, overlap in zip(tf.split(root, self._rows_of_basis), self._overlaps, strict=True):
            product = tf.reshape(rows, [-1, self.n_vectors]) @ overlap
            found.append(tf.reshape(product, [-1, root.shape[1], overlap.shape[1]]))
        return _joined(found, 0)


class Piece(NamedTuple):
    """One batch, and its vectors.

    Attributes
    ----------
    owner
        Position in the batch of the model of each baseline, (Nbls,); None if each baseline is its own model.
    vectors
        Of its models.
    own
        Of its baselines, if they have coefficients of their own besides the shared ones.
    """

    batch: Batch
    owner: tf.Tensor | None
    vectors: Vectors
    own: Vectors | None

    def to_models(self, values: tf.Tensor) -> tf.Tensor:
        """Add up the baselines of each model: (2, Nbls, Nfreqs) to (2, Nmodels, Nfreqs)."""
        if self.owner is None:
            return values
        return tf.stack([tf.math.segment_sum(part, self.owner) for part in tf.unstack(values)])

    def to_baselines(self, values: tf.Tensor) -> tf.Tensor:
        """Give each baseline what its model has, the transpose of `to_models`."""
        return values if self.owner is None else tf.gather(values, self.owner, axis=1)


def make_piece(batch: Batch, common: np.ndarray, owner: np.ndarray | None, with_own: bool, dtype: tf.DType) -> Piece:
    """Return a batch with its vectors.

    Parameters
    ----------
    batch, common
        As for `batch_vectors`.
    owner
        Position in the batch of the model of each baseline, ascending, (Nbls,); None if each baseline is its own model.
    with_own
        Whether baselines have coefficients of their own besides the shared ones.
    dtype
        Of the overlaps.
    """
    kind = dtype.as_numpy_dtype
    own = batch_vectors(batch, common, owner, kind) if with_own else None
    return Piece(
        batch, None if owner is None else tf.constant(owner, tf.int32), batch_vectors(batch, common, None, kind), own
    )


def batch_vectors(batch: Batch, common: np.ndarray, owner: np.ndarray | None, dtype: np.dtype) -> Vectors:
    """Return the vectors of the models of a batch, or of its baselines.

    Models with common coefficients are one row, whose channels are those of all of them, one after the other.

    Parameters
    ----------
    batch
        Which.
    common
        Q, (Nfreqs, rank).
    owner
        Position in the batch of the model of each baseline, ascending, for the vectors of the baselines; None for those
        of the models.
    dtype
        Of the overlaps.
    """
    if batch.joint:
        (basis,) = batch.bases
        whole = basis.reshape(-1, basis.shape[-1]).T[None]
        overlap = np.moveaxis(basis.transpose(0, 2, 1) @ common, 0, 1).reshape(1, basis.shape[-1], -1)
        return Vectors(whole, overlap.astype(dtype), np.array([basis.shape[-1]]), np.zeros(1, int))
    widths = np.array([basis.shape[1] for basis in batch.bases])
    stack = np.zeros((len(widths), widths.max(), len(common)))
    for row, basis in zip(stack, batch.bases, strict=True):
        row[: basis.shape[1]] = basis.T
    index = batch.basis_index if owner is None else batch.basis_index[owner]
    return Vectors(stack, (stack @ common).astype(dtype), widths, index)


def _joined(parts: list[tf.Tensor], axis: int) -> tf.Tensor:
    return parts[0] if len(parts) == 1 else tf.concat(parts, axis)
