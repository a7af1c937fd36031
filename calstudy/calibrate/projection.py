"""Elimination of the foregrounds: the best ones for given gains in closed form, and the reduced problem for the gains.

For gains g and a baseline p = (a, b) write G_p = g_a g_b* and D_p = w_p |G_p|^2. With a Gaussian prior of mean m and
covariance C on the foregrounds F, the fit minimizes

    sum w |V - G F|^2 + (F - m)^H C^-1 (F - m).

C is given by its root: F_p = m_p + A_R (s z_R + t d_p) with vectors A_R of the model R of the baseline, coefficients
z_R that the baselines of R share, and coefficients d_p of its own, all of unit variance, and deviations s and t. An
infinite deviation is no prior at all: the foregrounds are A z, m has no effect, and A may be orthonormal (CALAMITY).

The fit is linear least squares in z and d (variable projection, Golub & Pereyra 1973). With N_p = A^T D_p A, the own
coefficients have the normal matrix t^2 N_p + 1. Inserting their solution replaces D_p by P_p = D_p - t^2 D_p A (t^2 N_p
+ 1)^-1 A^T D_p for the shared ones, whose normal matrix is s^2 sum_p A^T P_p A + 1. Inserting their solution in the
same way replaces P by K for the gains. The gradient and the Gauss-Newton matrix for a relative change eta of the gains,
g (1 + eta), are those of a fit with fixed foregrounds, with K in place of D in the matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.batches import Piece, joined, make_piece, product_span, span_of
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.tensors import BaselineProducts, Ends, FitTensors

# Regularizes N relative to its mean diagonal: far below any signal, enough for models with most channels flagged.
RIDGE = 1e-12
# The same for the kernel in float32, whose rounding would swamp the damping where flags leave foregrounds undetermined.
# One iteration of Tikhonov's regularization keeps what it takes from well determined ones to its square.
KERNEL_RIDGE = {tf.float32: 1e-3, tf.float64: 1e-9}
# A finite prior leaves nothing undetermined. Foregrounds that it holds where the data hardly do would converge slowly
# with more.
FINITE_KERNEL_RIDGE = {tf.float32: 1e-6, tf.float64: 1e-12}


class Roots(NamedTuple):
    """Roots S of the foregrounds' response ``Q S^T S Q^T y`` to a weighted change y, with the span Q of a batch.

    S is (N, Nvec, rank): `first` of the models of a batch, or, if its baselines have their own coefficients besides the
    `shared` ones, of these baselines.
    """

    first: tf.Tensor
    shared: tf.Tensor | None


class Linearization(NamedTuple):
    """The contribution of consecutive baselines to the Gauss-Newton matrix, in the precision of the inner products.

    `curvature` is D, (Nbls, Nfreqs), `model` is F, (2, Nbls, Nfreqs), and `roots` are those of each batch.
    """

    curvature: tf.Tensor
    model: tf.Tensor
    roots: tuple[Roots, ...]


class Projection(NamedTuple):
    """The reduced problem at given gains, in float64.

    `loss` is sum w |V - G F|^2 at the best foregrounds, plus the squares of coefficients that have a prior. `model` is
    F on the baselines of consecutive stretches, each (2, Nbls, Nfreqs), and `parts` are their linearizations. `descent`
    is minus half the gradient of the loss in eta, (2, Nants, Nfreqs).
    """

    loss: tf.Tensor
    model: tuple[tf.Tensor, ...]
    descent: tf.Tensor
    parts: tuple[Linearization, ...]

    def power(self) -> tf.Tensor:
        """Return D |F|^2 of all baselines, (Nbls, Nfreqs)."""
        return joined([part.curvature * pairs.squared_modulus(part.model) for part in self.parts], 0)


class Stretch(NamedTuple):
    """Consecutive batches, from the first to one past the last of `baselines`, whose products are made at once."""

    baselines: tuple[int, int]
    ends: Ends
    pieces: tuple[Piece, ...]

    def slices(self) -> list[slice]:
        """Return the baselines of each batch, counted from the first of the stretch."""
        return [slice(*(edge - self.baselines[0] for edge in piece.batch.baselines)) for piece in self.pieces]


class Projector:
    """Eliminates the foregrounds of one fit structure.

    `dtype` is the precision of the inner products of the iteration. float32 is enough, except close to a minimum far
    below the data. The loss, its gradient and N are always evaluated in float64: in float32 the scale of the gains
    drifts.

    With `twice`, foregrounds are projected out of the residual, or of a change, a second time. Its rounding has a part
    that they absorb, and gains that they can follow have derivatives below it. It has no effect if the prior is finite:
    foregrounds would respond to the remaining residual as well, and such derivatives are larger.

    `stretches` are the batches with their vectors. In large fits each is processed by itself, so that its temporary
    arrays stay in the cache; in others the elementwise products are computed for all baselines at once, in fewer
    operations. `common` is an orthonormal basis that spans all bases, (Nfreqs, rank).
    """

    def __init__(
        self, structure: FitStructure, tensors: FitTensors, dtype: tf.DType = tf.float32, twice: bool = False
    ) -> None:
        self.tensors, self.dtype, self._products = tensors, dtype, BaselineProducts(tensors)
        self._finite, self._two_levels = structure.prior != "none", structure.prior == "both"
        self._level = 0 if structure.prior == "own" else 1
        self._twice = twice and not self._finite
        distinct = list({id(basis): basis for basis in tensors.bases}.values())
        # A batch of short baselines spans little of what all bases do.
        self._common, self._spans = span_of(distinct, dtype), [span_of(batch.bases, dtype) for batch in tensors.batches]
        self.common = tf.constant(self._common, dtype)
        needed = tensors.shared or self._two_levels
        pieces = [
            make_piece(batch, span, tensors.owner(batch) if needed else None, self._two_levels, dtype)
            for batch, span in zip(tensors.batches, self._spans, strict=True)
        ]
        together = [(piece,) for piece in pieces] if self._products.fused else [tuple(pieces)]
        edges = [(group[0].batch.baselines[0], group[-1].batch.baselines[1]) for group in together]
        self.stretches = [Stretch(e, tensors.ends.slice(*e), group) for e, group in zip(edges, together, strict=True)]
        self.project = tf.function(self._project, autograph=False)

    @cached_property
    def _product_spans(self) -> list[tf.Tensor | None]:
        """Spans of the products of each batch's span with the common basis; None for batches of few baselines."""
        found = []
        with tf.init_scope():
            for batch, span in zip(self.tensors.batches, self._spans, strict=True):
                few = 2 * (batch.baselines[1] - batch.baselines[0]) < len(span)
                found.append(None if few else product_span([(span, self._common)], self.dtype))
        return found

    def of_pieces(self, projection: Projection) -> Iterator[tuple[Piece, tf.Tensor | None, Linearization]]:
        """Yield each batch, the span of the products of its span with the common basis, and its part of a projection.

        The part has only the roots of this batch.
        """
        spans = iter(self._product_spans)
        for stretch, part in zip(self.stretches, projection.parts, strict=True):
            for piece, rows, roots in zip(stretch.pieces, stretch.slices(), part.roots, strict=True):
                yield piece, next(spans), Linearization(part.curvature[rows], part.model[:, rows], (roots,))

    def _factor(self, normal: tf.Tensor, filled: np.ndarray) -> tuple[tf.Tensor, tf.Tensor]:
        """Return the Cholesky factors of N, and a root R of the kernel, N^-1 ~ R^T R; all (N, Nvec, Nvec).

        With the ridge e and M = N + e, the kernel is M^-1 (1 + e M^-1). With a finite prior, N includes its 1 already.
        For `filled` see `calstudy.calibrate.batches.Vectors`.
        """
        # Only diagonals change: whole matrices of ridges would go through the memory several times.
        diagonal = tf.linalg.diag_part(normal)
        mean = tf.reduce_sum(diagonal * filled, -1, keepdims=True) / filled.sum(-1, keepdims=True)
        if not self._finite:
            # A model without any data gets the identity, and with it coefficients of zero, as padding does.
            diagonal += tf.where(mean > 0, (1 - filled) * mean, 1.0)
            normal = tf.linalg.set_diag(normal, diagonal + RIDGE * mean)
        ridge = (FINITE_KERNEL_RIDGE if self._finite else KERNEL_RIDGE)[self.dtype] * mean
        lower = tf.linalg.cholesky(tf.linalg.set_diag(normal, diagonal + ridge))
        root = tf.linalg.triangular_solve(lower, tf.eye(normal.shape[2], dtype=normal.dtype))
        more = ridge[:, None] * tf.matmul(root, root, transpose_b=True)
        again = tf.linalg.cholesky(tf.linalg.set_diag(more, 1 + tf.linalg.diag_part(more)))
        return tf.linalg.cholesky(normal), tf.matmul(again, root, transpose_a=True)

    def _project(
        self,
        gains: tf.Tensor,
        visibilities: tf.Tensor,
        weights: tf.Tensor,
        mean: tf.Tensor | None = None,
        deviations: tf.Tensor | None = None,
    ) -> Projection:
        """Project at gains (2, Nants, Nfreqs).

        Visibilities are (2, Nbls, Nfreqs), weights (Nbls, Nfreqs). With a finite prior, `mean` is m, like the
        visibilities, and `deviations` are t of the baselines' own coefficients and s of the shared ones, (2,).
        """
        found: list[Projection] = []
        for stretch in self.stretches:
            start, end = stretch.baselines
            data = visibilities[:, start:end], weights[start:end], None if mean is None else mean[:, start:end]
            # Without this, all stretches would be processed at once, and their temporaries add up.
            before = [tensor for tensor in tf.nest.flatten(found[-1:]) if tensor is not None]
            with tf.control_dependencies(before):
                part = self._project_stretch(stretch, gains, data, deviations)
            # The gradient is added up on the way, for the same reason.
            found.append(part._replace(descent=part.descent + found[-1].descent) if found else part)
        return Projection(
            tf.add_n([part.loss for part in found]),
            tuple(part.model[0] for part in found),
            found[-1].descent,
            tuple(part.parts[0] for part in found),
        )

    def _project_stretch(
        self,
        stretch: Stretch,
        gains: tf.Tensor,
        data: tuple[tf.Tensor, tf.Tensor, tf.Tensor | None],
        deviations: tf.Tensor | None,
    ) -> Projection:
        """Return the part of a stretch in the projection, from its visibilities, weights and mean."""
        eliminate = self._eliminate_both if self._two_levels else self._eliminate_one
        visibilities, weights, mean = data
        curvature, matched = self._products.match(gains, stretch.ends, visibilities, weights, mean)
        models: list[tf.Tensor] = []
        penalties: list[tf.Tensor] = []
        roots: list[Roots] = []
        for piece, rows in zip(stretch.pieces, stretch.slices(), strict=True):
            # As for stretches.
            with tf.control_dependencies([models[-1], roots[-1].first] if models else []):
                model, penalty, root = eliminate(piece, curvature[rows], matched[:, rows], deviations)
            models.append(model)
            penalties.append(penalty)
            roots.append(root)
        model = joined(models, 1) if mean is None else joined(models, 1) + mean
        loss, descent = self._products.residual(gains, stretch.ends, visibilities, weights, model)
        part = Linearization(tf.cast(curvature, self.dtype), tf.cast(model, self.dtype), tuple(roots))
        if self._twice:
            left = self._products.unmatched(gains, stretch.ends, visibilities, weights, model)
            descent = self._pulled(left, stretch, part)
        return Projection(loss + tf.add_n(penalties), (model,), descent, (part,))

    def _eliminate_one(
        self, piece: Piece, curvature: tf.Tensor, matched: tf.Tensor, deviations: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor, Roots]:
        """Eliminate one kind of coefficients; return F - m on the baselines, the prior's part of the loss, and roots.

        `curvature` and `matched` are D and G* w V - D m of the baselines of the batch; for `deviations` see `_project`.
        """
        owner, vectors = piece.owner, piece.vectors
        if owner is not None:
            curvature, matched = tf.math.segment_sum(curvature, owner), piece.to_models(matched)
        normal, projected = vectors.normal(curvature), vectors.reduce(matched)
        scale = tf.constant(1.0, tf.float64)
        if deviations is not None:
            scale = deviations[self._level]
            normal = tf.square(scale) * normal + tf.eye(normal.shape[2], dtype=normal.dtype)
        factor, root = self._factor(normal, vectors.filled)
        coefficients = tf.linalg.cholesky_solve(factor, scale * projected)
        if not self._finite:
            # One step of iterative refinement: the ridge would be an error of the gradient.
            coefficients += tf.linalg.cholesky_solve(factor, projected - normal @ coefficients)
        penalty = tf.constant(0.0, tf.float64) if deviations is None else tf.reduce_sum(tf.square(coefficients))
        model = vectors.expand(scale * coefficients)
        return piece.to_baselines(model), penalty, Roots(vectors.overlap(tf.cast(scale * root, self.dtype)), None)

    def _eliminate_both(
        self, piece: Piece, curvature: tf.Tensor, matched: tf.Tensor, deviations: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor, Roots]:
        """Do the same as `_eliminate_one` for baselines with their own coefficients besides the shared ones."""
        vectors: Any = piece.own
        owner, (own, shared) = piece.owner, tf.unstack(deviations)
        normal, projected = vectors.normal(curvature), vectors.reduce(matched)
        identity = tf.eye(normal.shape[2], dtype=normal.dtype)
        factor, root = self._factor(tf.square(own) * normal + identity, vectors.filled)
        half = tf.linalg.triangular_solve(factor, normal)
        left = normal - tf.square(own) * tf.matmul(half, half, transpose_a=True)
        answered = projected - tf.square(own) * normal @ tf.linalg.cholesky_solve(factor, projected)
        common = tf.square(shared) * tf.math.segment_sum(left, owner) + identity
        common_factor, common_root = self._factor(common, piece.vectors.filled)
        z = tf.linalg.cholesky_solve(common_factor, shared * tf.math.segment_sum(answered, owner))
        mine = tf.gather(shared * z, owner)
        d = tf.linalg.cholesky_solve(factor, own * (projected - normal @ mine))
        penalty = tf.reduce_sum(tf.square(z)) + tf.reduce_sum(tf.square(d))
        roots = Roots(
            vectors.overlap(tf.cast(own * root, self.dtype)),
            piece.vectors.overlap(tf.cast(shared * common_root, self.dtype)),
        )
        return vectors.expand(mine + own * d), penalty, roots

    def _answer(self, stretch: Stretch, change: tf.Tensor, part: Linearization) -> tf.Tensor:
        """Return the foregrounds' response of a stretch to a weighted change y of its visibilities, (2, Nbls, Nfreqs).

        The product S^T S itself would not suffice in float32: where flags leave a foreground nearly undetermined it is
        large, and its rounding would be large for the others.
        """
        answers = []
        for piece, rows, roots in zip(stretch.pieces, stretch.slices(), part.roots, strict=True):
            own = change[:, rows]
            if roots.shared is None:
                answers.append(piece.to_baselines(piece.absorb(piece.to_models(own), roots.first)))
                continue
            curvature = part.curvature[rows]
            left = own - curvature * piece.absorb(own, roots.first)
            common = piece.to_baselines(piece.absorb(piece.to_models(left), roots.shared))
            answers.append(common + piece.absorb(own - curvature * common, roots.first))
        return joined(answers, 1)

    def baseline_roots(self, piece: Piece, roots: Roots) -> tf.Tensor:
        """Return S of each baseline of a batch by itself, (Nbls, Nvec, rank)."""
        root = roots.first
        owned = self._two_levels or not self.tensors.shared
        return root if owned else tf.gather(root, piece.owner)

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the reduced problem times eta, shape (2, Nants, Nfreqs)."""

        def of_stretch(eta: tf.Tensor, stretch: Stretch, part: Linearization) -> tf.Tensor:
            change = self._products.change(eta, stretch.ends, part.curvature, part.model)
            return self._pulled(change, stretch, part)

        return self._over_stretches(of_stretch, eta, projection)

    def _pulled(self, change: tf.Tensor, stretch: Stretch, part: Linearization) -> tf.Tensor:
        """Return F* (y - D x) summed by antenna, for a weighted change y and the response x of the foregrounds."""
        answer = self._answer(stretch, change, part)
        if self._twice:
            change -= part.curvature * answer
            answer = self._answer(stretch, change, part)
        return self._products.pull(change, answer, stretch.ends, part.curvature, part.model)

    def descent_by(self, difference: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return half of what the negative gradient gains where data differ by G times `difference`."""

        def of_stretch(rows: tf.Tensor, stretch: Stretch, part: Linearization) -> tf.Tensor:
            return self._pulled(part.curvature * rows[:, slice(*stretch.baselines)], stretch, part)

        return self._over_stretches(of_stretch, difference, projection)

    def left_of(self, difference: tf.Tensor, eta: tf.Tensor, projection: Projection) -> tuple[tf.Tensor, ...]:
        """Return the rest of a difference of the data after gains and foregrounds respond, times D, of each stretch."""
        found = []
        for stretch, part in zip(self.stretches, projection.parts, strict=True):
            change = part.curvature * difference[:, slice(*stretch.baselines)]
            change -= self._products.change(eta, stretch.ends, part.curvature, part.model)
            found.append(change - part.curvature * self._answer(stretch, change, part))
        return tuple(found)

    def curvature_descent(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return minus the product of the Jacobian with the second derivative of the residual along eta.

        Along g exp(t eta), with foregrounds that follow as F + t dF, the second derivative of G F in t is
        G ((eta_a + eta_b*)^2 F + 2 (eta_a + eta_b*) dF). Shape (2, Nants, Nfreqs).
        """

        def of_stretch(eta: tf.Tensor, stretch: Stretch, part: Linearization) -> tf.Tensor:
            ends, curvature, model = stretch.ends, part.curvature, part.model
            first = self._products.change(eta, ends, curvature, model)
            second = pairs.multiply(model, ends.relative_change(eta)) - 2 * self._answer(stretch, first, part)
            return self._pulled(self._products.change(eta, ends, curvature, second), stretch, part)

        return -self._over_stretches(of_stretch, eta, projection)

    def _over_stretches(
        self, function: Callable[[tf.Tensor, Stretch, Linearization], tf.Tensor], eta: tf.Tensor, projection: Projection
    ) -> tf.Tensor:
        """Sum a function over the stretches, one after the other."""
        sums: list[tf.Tensor] = []
        for stretch, part in zip(self.stretches, projection.parts, strict=True):
            with tf.control_dependencies(sums[-1:]):
                found = function(eta, stretch, part)
                sums.append(sums[-1] + found if sums else found)
        return sums[-1]
