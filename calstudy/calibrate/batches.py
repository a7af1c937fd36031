"""Batches of foreground models that are processed at once, and the products with their bases.

Baselines of similar length share a basis (`calstudy.calibrate.basis`), and an array can have as many bases as
baselines. The size of compiled graphs grows with the number of pieces. Models of different bases are therefore put
together into a few batches, with coefficients padded with zeros: a vector of zeros contributes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg

from calstudy.base.tensorflow import tf

# Different bases are padded to about this many sizes: more take longer to compile, fewer longer to run.
BATCHES = 8
# Batches of fewer baselines than this are not worth their compilation.
LEAST_BATCH = 16
# No model of a batch has more than this many times the vectors of its narrowest one: the cost of padding grows with the
# square and the cube of their number.
WIDEST = 4 / 3
# Singular values, or diagonals of a pivoted QR, kept in what bases or their products span, relative to the largest:
# what is left out is an error of the Gauss-Newton matrix.
SPAN_CUTOFF = {tf.float32: 1e-9, tf.float64: 1e-15}
# Random products of columns from which their span is found, over the number of columns: the rank is 1.1 to 1.4 times
# that, and about twice in 1,500 channels.
PRODUCT_SAMPLES = 3
# One matrix product for each basis is faster than one for each model, if the basis has at least this many models.
ALIKE = 4


class Batch(NamedTuple):
    """Consecutive models, from the first to one past the last in the solvers' order, that are eliminated at once.

    `bases` are the different ones, (Nfreqs, Nvec) each, float64, and `basis_index` that of each model, ascending.
    """

    models: tuple[int, int]
    baselines: tuple[int, int]
    bases: tuple[np.ndarray, ...]
    basis_index: np.ndarray


def make_batches(bases: Sequence[np.ndarray], sizes: Sequence[int], edges: np.ndarray, most: int) -> list[Batch]:
    """Divide models into batches of at most `most` baselines, with similar numbers of vectors.

    A model with more baselines than that still forms one batch. `bases` and `sizes` (numbers of models) are those of
    consecutive buckets; `edges` are the first baseline of each model and one past the last, (Nmodels + 1,).
    """
    bucket_of = np.repeat(np.arange(len(bases)), sizes)
    # Few bases are better kept apart, because none is padded then.
    apart = len(bases) <= BATCHES
    if not apart:
        most = min(most, max(-(-int(edges[-1]) // BATCHES), LEAST_BATCH))
    n_models, cuts = len(bucket_of), [0]
    widths = np.array([basis.shape[-1] for basis in bases])[bucket_of]
    for model in range(1, n_models):
        wider = widths[model] > WIDEST * widths[cuts[-1]]
        full = edges[model + 1] - edges[cuts[-1]] > most or wider
        other = bucket_of[model] != bucket_of[model - 1]
        if full or (other and apart):
            cuts.append(model)
    batches = []
    for start, end in pairwise([*cuts, n_models]):
        found, index = np.unique(bucket_of[start:end], return_inverse=True)
        chosen = tuple(bases[bucket] for bucket in found)
        batches.append(Batch((start, end), (int(edges[start]), int(edges[end])), chosen, index))
    return batches


class Vectors:
    """Products with the vectors A of some rows, which are models or baselines.

    `bases` are the different A^T, (Nbases, Nvec, length), float64, padded with rows of zeros beyond the numbers of
    vectors, `widths`; `overlaps` are A^T Q of each, (Nbases, Nvec, rank), with the batch's span Q, in the precision of
    the inner products; `index` is that of the basis of each row, (Nrows,), ascending.
    """

    def __init__(self, bases: np.ndarray, overlaps: np.ndarray, widths: np.ndarray, index: np.ndarray) -> None:
        self.n_vectors, self.length = bases.shape[1:]
        # One where coefficients are not padding, zero where they are.
        self.filled = np.arange(self.n_vectors) < widths[index][:, None]
        self._by_basis = len(index) >= ALIKE * len(bases) or len(bases) == 1
        if self._by_basis:
            self._rows_of_basis = np.bincount(index, minlength=len(bases)).tolist()
            self._bases = [tf.constant(basis.T) for basis in bases]
            self._overlaps = [tf.constant(overlap) for overlap in overlaps]
            frequent = bases[np.array(self._rows_of_basis) >= self.length]
            self._product_span = product_span([(basis.T, basis.T) for basis in frequent], tf.float64)
        else:
            self._stack, self._stacked_overlaps = tf.constant(bases[index]), tf.constant(overlaps[index])

    def normal(self, curvature: tf.Tensor) -> tf.Tensor:
        """Return A^T D A, (Nrows, Nvec, Nvec), for D of shape (Nrows, length)."""
        if not self._by_basis:
            return tf.matmul(curvature[:, None, :] * self._stack, self._stack, transpose_b=True)
        found = []
        for rows, basis in zip(tf.split(curvature, self._rows_of_basis), self._bases, strict=True):
            # Either the products of vectors with each other or those of vectors with D are computed, the fewer ones.
            if rows.shape[0] > self.n_vectors:
                span = self._product_span if rows.shape[0] >= self.length else None
                found.append(column_products(rows, basis, basis, span))
                continue
            product = tf.reshape(rows[:, None, :] * tf.transpose(basis), [-1, self.length]) @ basis
            found.append(tf.reshape(product, [-1, self.n_vectors, self.n_vectors]))
        return joined(found, 0)

    def reduce(self, values: tf.Tensor) -> tf.Tensor:
        """Return A^T y, (Nrows, Nvec, 2), for y of shape (2, Nrows, length)."""
        if not self._by_basis:
            return tf.matmul(self._stack, tf.transpose(values, [1, 2, 0]))
        found = []
        for rows, basis in zip(tf.split(values, self._rows_of_basis, axis=1), self._bases, strict=True):
            product = tf.reshape(rows, [-1, self.length]) @ basis
            found.append(tf.reshape(product, [2, -1, self.n_vectors]))
        return tf.transpose(joined(found, 1), [1, 2, 0])

    def expand(self, coefficients: tf.Tensor) -> tf.Tensor:
        """Return A u, (2, Nrows, length), for coefficients u of shape (Nrows, Nvec, 2)."""
        if not self._by_basis:
            product = tf.matmul(self._stack, coefficients, transpose_a=True)
            return tf.transpose(product, [2, 0, 1])
        found = []
        columns = tf.transpose(coefficients, [2, 0, 1])
        for rows, basis in zip(tf.split(columns, self._rows_of_basis, axis=1), self._bases, strict=True):
            product = tf.matmul(tf.reshape(rows, [-1, self.n_vectors]), basis, transpose_b=True)
            found.append(tf.reshape(product, [2, -1, self.length]))
        return joined(found, 1)

    def overlap(self, root: tf.Tensor) -> tf.Tensor:
        """Return R A^T Q, (Nrows, N, rank), for R of shape (Nrows, N, Nvec)."""
        if not self._by_basis:
            return root @ self._stacked_overlaps
        found = []
        for rows, overlap in zip(tf.split(root, self._rows_of_basis), self._overlaps, strict=True):
            product = tf.reshape(rows, [-1, self.n_vectors]) @ overlap
            found.append(tf.reshape(product, [-1, root.shape[1], overlap.shape[1]]))
        return joined(found, 0)


class Piece(NamedTuple):
    """One batch, and the vectors of its models.

    `span` is an orthonormal basis Q of what they span, (Nfreqs, rank), in the precision of the inner products. `owner`
    is the position in the batch of the model of each baseline, ascending, (Nbls,); None if each baseline is its own
    model. `own` are vectors of the baselines, if they have their own coefficients besides the shared ones.
    """

    batch: Batch
    span: tf.Tensor
    owner: tf.Tensor | None
    vectors: Vectors
    own: Vectors | None

    def to_models(self, values: tf.Tensor) -> tf.Tensor:
        """Add up the baselines of each model: (2, Nbls, Nfreqs) to (2, Nmodels, Nfreqs)."""
        if self.owner is None:
            return values
        return tf.stack([tf.math.segment_sum(part, self.owner) for part in tf.unstack(values)])

    def to_baselines(self, values: tf.Tensor) -> tf.Tensor:
        """Copy the values of each model to its baselines, the transpose of `to_models`."""
        return values if self.owner is None else tf.gather(values, self.owner, axis=1)

    def absorb(self, values: tf.Tensor, root: tf.Tensor) -> tf.Tensor:
        """Return ``Q S^T S Q^T y``, (2, N, Nfreqs), for y of that shape and S of shape (N, Nvec, rank)."""
        n_frequencies, rank = self.span.shape
        inner = tf.reshape(values, [-1, n_frequencies]) @ self.span
        # Real and imaginary part share one batched product.
        inner = tf.transpose(tf.reshape(inner, [2, -1, root.shape[2]]), [1, 0, 2])
        inner = tf.matmul(inner, root, transpose_b=True) @ root
        inner = tf.reshape(tf.transpose(inner, [1, 0, 2]), [-1, rank])
        return tf.reshape(tf.matmul(inner, self.span, transpose_b=True), [2, -1, n_frequencies])


def make_piece(batch: Batch, span: np.ndarray, owner: np.ndarray | None, with_own: bool, dtype: tf.DType) -> Piece:
    """Build the vectors of a batch; those of its baselines as well, if these have their own coefficients."""
    kind = dtype.as_numpy_dtype
    own = _vectors(batch, span, owner, kind) if with_own else None
    index = None if owner is None else tf.constant(owner, tf.int32)
    return Piece(batch, tf.constant(span, dtype), index, _vectors(batch, span, None, kind), own)


def span_of(bases: Sequence[np.ndarray], dtype: tf.DType) -> np.ndarray:
    """Return an orthonormal basis of the joint span of bases (Nfreqs, Nvec), (Nfreqs, rank), to a precision."""
    vectors = np.concatenate([_normalized(basis) for basis in bases], axis=1)
    # R of a QR decomposition has the same left singular vectors; the right ones, of no use, would take most time.
    triangle = np.asarray(np.linalg.qr(vectors.T, mode="r"))
    left, singular, _ = np.linalg.svd(triangle.T, full_matrices=False)
    return left[:, singular > SPAN_CUTOFF[dtype] * singular[0]]


def product_span(pairs: Sequence[tuple[np.ndarray, np.ndarray]], dtype: tf.DType) -> tf.Tensor | None:
    """Return an orthonormal basis of the span of products of columns, (length, rank); None if it is the whole space.

    Smooth columns, such as foreground vectors, have products whose rank is little more than the sum of both ranks. The
    span is found from products of random combinations of the columns (Halko, Martinsson & Tropp 2011, SIAM Rev. 53,
    217). Each column of the first of a pair is multiplied with each of the second, (length, Nleft) and (length,
    Nright), float64.
    """
    rng = np.random.default_rng(1)
    samples = []
    for left, right in pairs:
        count = PRODUCT_SAMPLES * (left.shape[1] + right.shape[1])
        first, second = (_normalized(side) for side in (left, right))
        first, second = (side @ rng.standard_normal((side.shape[1], count)) for side in (first, second))
        samples.append(first * second)
    if not samples:
        return None
    basis, triangle, _ = scipy.linalg.qr(np.concatenate(samples, axis=1), mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(triangle))
    kept = diagonal > SPAN_CUTOFF[dtype] * diagonal[0]
    return None if kept.all() else tf.constant(basis[:, kept], dtype)


def column_products(rows: tf.Tensor, left: tf.Tensor, right: tf.Tensor, span: tf.Tensor | None = None) -> tf.Tensor:
    """Return sum_f y(f) A_i(f) B_j(f), (Nrows, Nleft, Nright), for rows y, (Nrows, length).

    A and B are (length, Nleft) and (length, Nright). With the span of the products of their columns (see
    `product_span`), rows are first multiplied with it, which is less work for many rows.
    """
    products = tf.reshape(left[:, :, None] * right[:, None, :], [left.shape[0], -1])
    found = rows @ products if span is None else (rows @ span) @ tf.matmul(span, products, transpose_a=True)
    return tf.reshape(found, [-1, left.shape[1], right.shape[1]])


def _vectors(batch: Batch, span: np.ndarray, owner: np.ndarray | None, dtype: np.dtype) -> Vectors:
    """Build the vectors of the models of a batch or, with `owner`, of its baselines."""
    widths = np.array([basis.shape[1] for basis in batch.bases])
    stack = np.zeros((len(widths), widths.max(), len(span)))
    for row, basis in zip(stack, batch.bases, strict=True):
        row[: basis.shape[1]] = basis.T
    index = batch.basis_index if owner is None else batch.basis_index[owner]
    return Vectors(stack, (stack @ span).astype(dtype), widths, index)


def _normalized(columns: np.ndarray) -> np.ndarray:
    """Normalize columns; columns of zeros stay as they are."""
    norms = np.linalg.norm(columns, axis=0)
    return columns / np.where(norms > 0, norms, 1)


def joined(parts: list[tf.Tensor], axis: int) -> tf.Tensor:
    """Concatenate tensors, without a copy if there is only one."""
    return parts[0] if len(parts) == 1 else tf.concat(parts, axis)
