"""Elimination of the foregrounds: the best ones for given gains in closed form, and what is left for the gains.

For gains g and a baseline p = (a, b) write G_p = g_a g_b* and D_p = w_p |G_p|^2. With a Gaussian prior of mean m and
covariance C on the foregrounds F, the fit minimizes

    sum w |V - G F|^2 + (F - m)^H C^-1 (F - m).

C is known by its root: F_p = m_p + A_R (s z_R + t d_p) with vectors A_R of the model R of the baseline, coefficients
z_R that the baselines of R share, and coefficients d_p of its own, all of unit variance, and deviations s and t. An
infinite deviation is no prior at all: the foregrounds are A z, m does not matter, and A may be orthonormal (CALAMITY).

The fit is linear least squares in z and d (variable projection, Golub & Pereyra 1973). With N_p = A^T D_p A, the own
coefficients have the normal matrix t^2 N_p + 1. Putting their solution back leaves P_p = D_p - t^2 D_p A (t^2 N_p +
1)^-1 A^T D_p in place of D_p for the shared ones, whose normal matrix is s^2 sum_p A^T P_p A + 1, and what is left for
the gains is K in place of P, made in the same way. The gradient and the Gauss-Newton matrix for a relative change eta
of the gains, g (1 + eta), are those of a fit with fixed foregrounds, but for K in place of D in the matrix.

Models m that have their coefficients in common count as one, whose channels are those of all of them, one after the
other: N = sum_m A_m^T D_m A_m.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.batches import Piece, make_piece, span_of
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.tensors import FitTensors

# Regularizes N relative to its mean diagonal: far below any signal, enough for models with most channels flagged.
RIDGE = 1e-12
# The same for the kernel in float32, whose rounding would swamp the damping where flags leave foregrounds undetermined.
# One iteration of Tikhonov's regularization keeps what it takes from well determined ones to its square.
KERNEL_RIDGE = {tf.float32: 1e-3, tf.float64: 1e-9}
# A finite prior leaves nothing undetermined. Foregrounds that it holds where the data hardly do would converge slowly
# with more.
FINITE_KERNEL_RIDGE = {tf.float32: 1e-6, tf.float64: 1e-12}

# From this many visibilities on, the elementwise products of a fit are compiled (XLA): one pass over the memory in
# place of a dozen, for a second of compilation.
LEAST_FUSED = 1_000_000


class Roots(NamedTuple):
    """How foregrounds answer a weighted change y of the visibilities: ``Q S^T S Q^T y``, with the span Q of a batch.

    Attributes
    ----------
    first
        S of the models of a batch, or of its baselines if they have coefficients of their own besides the shared ones,
        (N, Nvec, rank). Of a joint batch that of all members together, (1, Nvec, Nmembers * rank).
    shared
        S of the shared coefficients, (Nmodels, Nvec, rank), if there are both kinds; None otherwise.
    """

    first: tf.Tensor
    shared: tf.Tensor | None


class Projection(NamedTuple):
    """The reduced problem at given gains.

    Attributes
    ----------
    loss
        sum w |V - G F|^2 at the best foregrounds, plus the squares of coefficients that have a prior; scalar, float64.
    model
        F on the baselines, shape (2, Nbls, Nfreqs), float64.
    descent
        Minus half the gradient of the loss in eta, shape (2, Nants, Nfreqs), float64.
    curvature
        D of each baseline, shape (Nbls, Nfreqs).
    baseline_model
        `model` in the precision of the inner products, like `curvature` and `roots`.
    roots
        Of each batch.
    """

    loss: tf.Tensor
    model: tf.Tensor
    descent: tf.Tensor
    curvature: tf.Tensor
    baseline_model: tf.Tensor
    roots: tuple[Roots, ...]


class _BaselineProducts:
    """Elementwise products of gains, models and data on all baselines, in the notation of the module.

    Parameters
    ----------
    tensors
        Index tensors of the fit. From `LEAST_FUSED` visibilities on the products are compiled.
    """

    def __init__(self, tensors: FitTensors) -> None:
        self._tensors = tensors
        fused = tensors.n_baselines * tensors.n_frequencies >= LEAST_FUSED
        self.curvature, self.match, self.residual, self.change, self.pull = (
            tf.function(function, jit_compile=fused, autograph=False)
            for function in (self._curvature, self._match, self._residual, self._change, self._pull)
        )

    def _curvature(self, gains: tf.Tensor, weights: tf.Tensor) -> tf.Tensor:
        """Return D, (Nbls, Nfreqs), for gains (2, Nants, Nfreqs); see the module."""
        return weights * pairs.squared_modulus(self._tensors.gain_products(gains))

    def _match(
        self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor, mean: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return D, (Nbls, Nfreqs), and G* w V, less D m if there is a mean m, (2, Nbls, Nfreqs)."""
        products = self._tensors.gain_products(gains)
        curvature = weights * pairs.squared_modulus(products)
        matched = pairs.conjugate_multiply(products, weights * visibilities)
        return curvature, matched if mean is None else matched - curvature * mean

    def _residual(
        self, gains: tf.Tensor, model: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return sum w |V - G F|^2, and minus half its gradient in eta with F fixed, (2, Nants, Nfreqs)."""
        products = self._tensors.gain_products(gains)
        residual = visibilities - pairs.multiply(products, model)
        pull = pairs.conjugate_multiply(model, weights * pairs.conjugate_multiply(products, residual))
        return tf.reduce_sum(weights * pairs.squared_modulus(residual)), self._tensors.sum_over_antenna(pull)

    def _change(self, eta: tf.Tensor, curvature: tf.Tensor, model: tf.Tensor) -> tf.Tensor:
        """Return D F (eta_a + eta_b*), (2, Nbls, Nfreqs)."""
        return curvature * pairs.multiply(model, self._tensors.relative_change(eta))

    def _pull(self, change: tf.Tensor, answer: tf.Tensor | None, curvature: tf.Tensor, model: tf.Tensor) -> tf.Tensor:
        """Return F* (y - D x) of a weighted change y that foregrounds answer by x, by antenna; (2, Nants, Nfreqs)."""
        left = change if answer is None else change - curvature * answer
        return self._tensors.sum_over_antenna(pairs.conjugate_multiply(model, left))


class Projector:
    """Eliminates the foregrounds of one fit structure.

    Parameters
    ----------
    structure
        Of the fit.
    tensors
        Its index tensors.
    dtype
        Of the inner products of the iteration, for which float32 is enough but close to a minimum far below the data.
        The loss, its gradient and N are always evaluated in float64: in float32 the scale of the gains drifts unseen.

    Attributes
    ----------
    pieces
        The batches, with their vectors.
    common
        Orthonormal basis that spans all bases, (Nfreqs, rank), of `dtype`.
    """

    def __init__(self, structure: FitStructure, tensors: FitTensors, dtype: tf.DType = tf.float32) -> None:
        self.tensors, self.dtype, self._products = tensors, dtype, _BaselineProducts(tensors)
        self._finite, self._two_levels = structure.prior != "none", structure.prior == "both"
        self._level = 0 if structure.prior == "own" else 1
        distinct = list({id(basis): basis for basis in tensors.bases}.values())
        self.common = tf.constant(span_of(distinct, dtype), dtype)
        needed = tensors.shared or self._two_levels
        self.pieces = [
            make_piece(batch, tensors.owner(batch) if needed else None, self._two_levels, dtype)
            for batch in tensors.batches
        ]
        self.project = tf.function(self._project, autograph=False)

    def _factor(self, normal: tf.Tensor, filled: np.ndarray) -> tuple[tf.Tensor, tf.Tensor]:
        """Return the Cholesky factors of N, and a root R of the kernel, N^-1 ~ R^T R; all (N, Nvec, Nvec).

        With the ridge e and M = N + e, the kernel is M^-1 (1 + e M^-1). With a finite prior, N has its 1 already.

        Parameters
        ----------
        normal
            N, (N, Nvec, Nvec).
        filled
            See `calstudy.calibrate.batches.Vectors`.
        """
        identity = tf.eye(normal.shape[2], batch_shape=tf.shape(normal)[:1], dtype=normal.dtype)
        diagonal = tf.linalg.diag_part(normal)
        mean = (tf.reduce_sum(diagonal * filled, -1) / filled.sum(-1))[:, None, None]
        if not self._finite:
            # A model without any data gets the identity, and with it coefficients of zero.
            normal += tf.where(mean > 0, RIDGE * mean, 1.0) * identity
            if not filled.all():
                normal += tf.linalg.diag((1 - filled) * tf.where(mean > 0, mean, 1.0)[:, 0])
        ridge = (FINITE_KERNEL_RIDGE if self._finite else KERNEL_RIDGE)[self.dtype] * mean
        root = tf.linalg.triangular_solve(tf.linalg.cholesky(normal + ridge * identity), identity)
        again = tf.linalg.cholesky(identity + ridge * tf.matmul(root, root, transpose_b=True))
        return tf.linalg.cholesky(normal), tf.matmul(again, root, transpose_a=True)

    def _project(
        self,
        gains: tf.Tensor,
        visibilities: tf.Tensor,
        weights: tf.Tensor,
        mean: tf.Tensor | None = None,
        deviations: tf.Tensor | None = None,
    ) -> Projection:
        """Return the projection at gains (2, Nants, Nfreqs).

        Parameters
        ----------
        visibilities, weights
            (2, Nbls, Nfreqs) and (Nbls, Nfreqs).
        mean
            m, like the visibilities, if the prior is finite.
        deviations
            t of the baselines' own coefficients and s of the shared ones, (2,), if the prior is finite.
        """
        eliminate = self._eliminate_both if self._two_levels else self._eliminate_one
        curvature, matched = self._products.match(gains, visibilities, weights, mean)
        models: list[tf.Tensor] = []
        penalties: list[tf.Tensor] = []
        roots: list[Roots] = []
        for piece in self.pieces:
            first, last = piece.batch.baselines
            # Without this, all batches would be worked on at once, and their temporaries add up.
            with tf.control_dependencies([models[-1], roots[-1].first] if models else []):
                model, penalty, root = eliminate(piece, curvature[first:last], matched[:, first:last], deviations)
            models.append(model)
            penalties.append(penalty)
            roots.append(root)
        model = tf.concat(models, axis=1) if mean is None else tf.concat(models, axis=1) + mean
        loss, descent = self._products.residual(gains, model, visibilities, weights)
        return Projection(
            loss + tf.add_n(penalties),
            model,
            descent,
            tf.cast(curvature, self.dtype),
            tf.cast(model, self.dtype),
            tuple(roots),
        )

    def _eliminate_one(
        self, piece: Piece, curvature: tf.Tensor, matched: tf.Tensor, deviations: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor, Roots]:
        """Return F - m on the baselines, the prior's share of the loss, and the roots, where a model has one kind.

        Parameters
        ----------
        curvature, matched
            D and G* w V - D m of its baselines.
        deviations
            See `_project`.
        """
        owner, vectors = piece.owner, piece.vectors
        if owner is not None:
            curvature, matched = tf.math.segment_sum(curvature, owner), piece.to_models(matched)
        if piece.batch.joint:
            # All members are one model with the channels of all of them.
            curvature, matched = tf.reshape(curvature, [1, -1]), tf.reshape(matched, [2, 1, -1])
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
        model = tf.reshape(vectors.expand(scale * coefficients), [2, -1, self.tensors.n_frequencies])
        return piece.to_baselines(model), penalty, Roots(vectors.overlap(tf.cast(scale * root, self.dtype)), None)

    def _eliminate_both(
        self, piece: Piece, curvature: tf.Tensor, matched: tf.Tensor, deviations: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor, Roots]:
        """Return what `_eliminate_one` does, where baselines have coefficients of their own besides the shared ones."""
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

    def answer(self, change: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return how the foregrounds of the baselines answer a weighted change y of the visibilities.

        The product S^T S itself would not do in float32: where flags leave a foreground nearly undetermined it is
        large, and its rounding would be large for the others.

        Parameters
        ----------
        change
            (2, Nbls, Nfreqs).
        projection
            Whose curvature and roots count.
        """
        answers = []
        for piece, roots in zip(self.pieces, projection.roots, strict=True):
            first, last = piece.batch.baselines
            part = change[:, first:last]
            if roots.shared is None:
                answers.append(piece.to_baselines(piece.absorb(piece.to_models(part), roots.first)))
                continue
            curvature = projection.curvature[first:last]
            left = part - curvature * piece.absorb(part, roots.first)
            common = piece.to_baselines(piece.absorb(piece.to_models(left), roots.shared))
            answers.append(common + piece.absorb(part - curvature * common, roots.first))
        return answers[0] if len(answers) == 1 else tf.concat(answers, axis=1)

    def baseline_roots(self, piece: Piece, roots: Roots) -> tf.Tensor:
        """Return S of each baseline of a batch by itself, (Nbls, Nvec, rank)."""
        root = roots.first
        if piece.batch.joint:
            root = tf.transpose(tf.reshape(root, [root.shape[1], -1, piece.span.shape[1]]), [1, 0, 2])
        owned = self._two_levels or not self.tensors.shared
        return root if owned else tf.gather(root, piece.owner)

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the reduced problem times eta, shape (2, Nants, Nfreqs)."""
        curvature, model = projection.curvature, projection.baseline_model
        change = self._products.change(eta, curvature, model)
        return self._products.pull(change, self.answer(change, projection), curvature, model)

    def curvature_descent(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return minus the product of the Jacobian with the second derivative of the residual along eta.

        Along g exp(t eta), with foregrounds that follow as F + t dF, the second derivative of G F in t is
        G ((eta_a + eta_b*)^2 F + 2 (eta_a + eta_b*) dF). Shape (2, Nants, Nfreqs).
        """
        curvature, model = projection.curvature, projection.baseline_model
        first = self._products.change(eta, curvature, model)
        bent = pairs.multiply(model, self.tensors.relative_change(eta)) - 2 * self.answer(first, projection)
        change = self._products.change(eta, curvature, bent)
        return -self._products.pull(change, self.answer(change, projection), curvature, model)


class FrozenForegrounds:
    """Takes the place of `Projector` for a sky-based fit, whose foregrounds are known: there is nothing to eliminate.

    Without foregrounds to respond, the Gauss-Newton matrix does not couple channels.
    """

    def __init__(self, tensors: FitTensors, dtype: tf.DType = tf.float32) -> None:
        self.tensors, self.dtype, self._products = tensors, dtype, _BaselineProducts(tensors)
        self.project = tf.function(self._project, autograph=False)

    def _project(self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor) -> Projection:
        loss, descent = self._products.residual(gains, model, visibilities, weights)
        curvature = tf.cast(self._products.curvature(gains, weights), self.dtype)
        return Projection(loss, model, descent, curvature, tf.cast(model, self.dtype), ())

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the gains alone times eta, shape (2, Nants, Nfreqs)."""
        curvature, model = projection.curvature, projection.baseline_model
        return self._products.pull(self._products.change(eta, curvature, model), None, curvature, model)

    def curvature_descent(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return what `Projector.curvature_descent` does; foregrounds do not follow."""
        curvature, model = projection.curvature, projection.baseline_model
        bent = pairs.multiply(model, self.tensors.relative_change(eta))
        return -self._products.pull(self._products.change(eta, curvature, bent), None, curvature, model)
