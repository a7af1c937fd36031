"""Variable projection: the best foregrounds for given gains in closed form, and the problem that is left for the gains.

For gains g and a baseline p = (a, b) write G_p = g_a g_b* and D_p = w_p |G_p|^2, and let R be its foreground model. The
likelihood is linear least squares in u_R, with normal matrix N_R = A^T (sum_p D_p) A over the baselines of R. Putting
its solution back leaves a function of the gains alone (Golub & Pereyra 1973), whose gradient and Gauss-Newton matrix
are below for a relative change eta of the gains, g (1 + eta).

Models m that have their coefficients in common count as one, whose channels are those of all of them, one after the
other: N = sum_m A_m^T D_m A_m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.tensors import FitTensors

# Regularizes N relative to its mean diagonal: far below any signal, enough for models with most channels flagged.
RIDGE = 1e-12
# The same for the kernel in float32, whose rounding would swamp the damping where flags leave foregrounds undetermined.
# One iteration of Tikhonov's regularization keeps what it takes from well determined ones to its square.
KERNEL_RIDGE = 1e-3
# Singular values kept in the common basis of all buckets, relative to the largest.
SPAN_CUTOFF = 1e-9


class Projection(NamedTuple):
    """The reduced problem at given gains.

    Attributes
    ----------
    loss
        sum w |v - G F|^2 at the best foregrounds; scalar, float64.
    model
        F, shape (2, Nmodels, Nfreqs), float64.
    descent
        Minus half the gradient of the loss in eta, shape (2, Nants, Nfreqs), float64.
    curvature
        D of each baseline, shape (Nbls, Nfreqs), float32.
    baseline_model
        F on the baselines, shape (2, Nbls, Nfreqs), float32.
    roots
        S of the models of each stretch, shape (Nmodels, Nvec, rank), float32, padded with rows of zeros: foregrounds
        answer a weighted change y of the visibilities of their group with ``Q S^T S Q^T y``, where Q is the common
        basis. Of a joint piece that of all members together, shape (1, Nvec, Nmembers * rank).
    """

    loss: tf.Tensor
    model: tf.Tensor
    descent: tf.Tensor
    curvature: tf.Tensor
    baseline_model: tf.Tensor
    roots: tuple[tf.Tensor, ...]


class _Piece(NamedTuple):
    """What one piece of models adds to a `Projection`; `pull` is its share of the descent, by baseline."""

    loss: tf.Tensor
    model: tf.Tensor
    pull: tf.Tensor
    curvature: tf.Tensor
    baseline_model: tf.Tensor
    root: tf.Tensor


class Projector:
    """Eliminates the foregrounds of one fit structure.

    Attributes
    ----------
    common
        Orthonormal basis Q that spans all bases, (Nfreqs, rank), float32.
    overlaps
        A^T Q of each piece, (Nvec, rank), float32; one member after the other, (Nvec, Nmembers * rank), if it is
        joint.

    The loss, its gradient and N are evaluated in float64: in float32 the scale of the gains drifts unseen. The inner
    products of the iteration need only float32.
    """

    def __init__(self, tensors: FitTensors) -> None:
        self.tensors = tensors
        self._stretches = tensors.stretches
        distinct = list({id(basis): basis for basis in tensors.bases}.values())
        left, singular, _ = np.linalg.svd(
            np.concatenate([_side_by_side(basis) for basis in distinct], axis=1), full_matrices=False
        )
        common = left[:, singular > SPAN_CUTOFF * singular[0]]
        self.common = tf.constant(common, tf.float32)
        self.rank = common.shape[1]
        self._joint = [basis.ndim == 3 for basis in tensors.bases]
        self._bases = [tf.constant(basis.reshape(-1, basis.shape[-1]), tf.float64) for basis in tensors.bases]
        self.overlaps = [tf.constant(_overlap(basis, common), tf.float32) for basis in tensors.bases]
        self.project = tf.function(self._project)

    def _factor(self, curvature: tf.Tensor, basis: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:
        """Return, for the models of one piece, the Cholesky factors of N and a root R of the kernel, N^-1 ~ R^T R.

        Both have the shape (Nmembers, Nvec, Nvec). With the ridge e and M = N + e, the kernel is M^-1 (1 + e M^-1).
        """
        n_frequencies, n_vectors = basis.shape
        weighted = tf.reshape(curvature[:, None, :] * tf.transpose(basis), [-1, n_frequencies])
        normal = tf.reshape(weighted @ basis, [-1, n_vectors, n_vectors])
        mean = tf.reduce_mean(tf.linalg.diag_part(normal), -1)[:, None, None]
        identity = tf.eye(n_vectors, batch_shape=tf.shape(normal)[:1], dtype=normal.dtype)
        # A model without any data gets the identity, and with it coefficients of zero.
        normal += tf.where(mean > 0, RIDGE * mean, 1.0) * identity
        ridge = KERNEL_RIDGE * mean
        root = tf.linalg.triangular_solve(tf.linalg.cholesky(normal + ridge * identity), identity)
        again = tf.linalg.cholesky(identity + ridge * tf.matmul(root, root, transpose_b=True))
        return tf.linalg.cholesky(normal), tf.matmul(again, root, transpose_a=True)

    def _project(self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor) -> Projection:
        pieces: list[_Piece] = []
        descent: list[tf.Tensor] = []
        roots: list[tf.Tensor] = []
        for stretch in self._stretches:
            # Without this, all stretches would be worked on at once, and their temporaries add up.
            with tf.control_dependencies([descent[-1], roots[-1]] if descent else []):
                members = [self._project_piece(index, gains, visibilities, weights) for index in stretch]
                pull = tf.concat([member.pull for member in members], axis=1)
                before = descent[-1] if descent else 0.0
                descent.append(before + self.tensors.sum_over_antenna(pull, self.tensors.baselines_of(stretch)))
                widest = max(member.root.shape[1] for member in members)
                padded = [tf.pad(part.root, [[0, 0], [0, widest - part.root.shape[1]], [0, 0]]) for part in members]
                roots.append(tf.concat(padded, axis=0))
            pieces += members
        return Projection(
            tf.add_n([piece.loss for piece in pieces]),
            tf.concat([piece.model for piece in pieces], axis=1),
            descent[-1],
            tf.concat([piece.curvature for piece in pieces], axis=0),
            tf.concat([piece.baseline_model for piece in pieces], axis=1),
            tuple(roots),
        )

    def _project_piece(self, index: int, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor) -> _Piece:
        """Eliminate the foregrounds of one piece of models."""
        tensors, basis = self.tensors, self._bases[index]
        start, (first, last) = tensors.slices[index][0], tensors.baseline_slices[index]
        visibilities, weights = visibilities[:, first:last], weights[first:last]
        products = tensors.gain_products(gains, first, last)
        curvature = weights * pairs.squared_modulus(products)
        matched = pairs.conjugate_multiply(products, weights * visibilities)
        owner = None if tensors.model_index is None else tensors.model_index[first:last] - start
        if owner is None:
            group_curvature = curvature
        else:
            group_curvature = tf.math.segment_sum(curvature, owner)
            matched = tf.stack([tf.math.segment_sum(part, owner) for part in tf.unstack(matched)])
        # More than the channels of one model where all members of a joint piece are one.
        length, n_vectors = basis.shape
        factor, root = self._factor(tf.reshape(group_curvature, [-1, length]), basis)
        projected = tf.reshape(tf.reshape(matched, [-1, length]) @ basis, [2, -1, n_vectors])
        coefficients = tf.linalg.cholesky_solve(factor, tf.transpose(projected, [1, 2, 0]))
        coefficients = tf.reshape(tf.transpose(coefficients, [2, 0, 1]), [-1, n_vectors])
        model = tf.reshape(tf.matmul(coefficients, basis, transpose_b=True), [2, -1, tensors.n_frequencies])
        overlap = self.overlaps[index]
        spread = tf.reshape(tf.cast(root, tf.float32), [-1, n_vectors]) @ overlap
        baseline_model = model if owner is None else tf.gather(model, owner, axis=1)
        residual = visibilities - pairs.multiply(products, baseline_model)
        return _Piece(
            tf.reduce_sum(weights * pairs.squared_modulus(residual)),
            model,
            pairs.conjugate_multiply(baseline_model, weights * pairs.conjugate_multiply(products, residual)),
            tf.cast(curvature, tf.float32),
            tf.cast(baseline_model, tf.float32),
            tf.reshape(spread, [-1, n_vectors, overlap.shape[1]]),
        )

    def absorb(self, values: tf.Tensor, roots: tuple[tf.Tensor, ...]) -> tf.Tensor:
        """Return ``Q S^T S Q^T values`` for each model; values and result (2, Nmodels, Nfreqs).

        The product S^T S itself would not do in float32: where flags leave a foreground nearly undetermined it is
        large, and its rounding would be large for the others.
        """
        answers = []
        n_frequencies, rank = self.common.shape
        for stretch, root in zip(self._stretches, roots, strict=True):
            first, last = self.tensors.models_of(stretch)
            inner = tf.reshape(values[:, first:last], [-1, n_frequencies]) @ self.common
            # Real and imaginary part share one batched product.
            inner = tf.transpose(tf.reshape(inner, [2, -1, root.shape[2]]), [1, 0, 2])
            inner = tf.matmul(inner, root, transpose_b=True) @ root
            inner = tf.reshape(tf.transpose(inner, [1, 0, 2]), [-1, rank])
            outer = tf.matmul(inner, self.common, transpose_b=True)
            answers.append(tf.reshape(outer, [2, -1, n_frequencies]))
        return answers[0] if len(answers) == 1 else tf.concat(answers, axis=1)

    def baseline_roots(self, stretch: range, root: tf.Tensor) -> tf.Tensor:
        """Return S of each baseline of a stretch by itself, (Nbls, Nvec, rank)."""
        if self._joint[stretch[0]]:
            root = tf.transpose(tf.reshape(root, [root.shape[1], -1, self.rank]), [1, 0, 2])
        if self.tensors.model_index is None:
            return root
        start, end = self.tensors.baselines_of(stretch)
        return tf.gather(root, self.tensors.model_index[start:end] - self.tensors.models_of(stretch)[0])

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the reduced problem times eta, shape (2, Nants, Nfreqs), float32."""
        tensors = self.tensors
        curvature, model = projection.curvature, projection.baseline_model
        change = curvature * pairs.multiply(model, tensors.relative_change(eta))
        absorbed = tensors.to_baselines(self.absorb(tensors.sum_pairs_over_group(change), projection.roots))
        return tensors.sum_over_antenna(pairs.conjugate_multiply(model, change - curvature * absorbed))


class FrozenForegrounds:
    """Takes the place of `Projector` for a sky-based fit, whose foregrounds are known: there is nothing to eliminate.

    Without foregrounds to respond, the Gauss-Newton matrix does not couple channels.
    """

    def __init__(self, tensors: FitTensors) -> None:
        self.tensors = tensors
        self.project = tf.function(self._project)

    def _project(self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor) -> Projection:
        products = self.tensors.gain_products(gains)
        residual = visibilities - pairs.multiply(products, model)
        loss = tf.reduce_sum(weights * pairs.squared_modulus(residual))
        pull = pairs.conjugate_multiply(model, weights * pairs.conjugate_multiply(products, residual))
        curvature = tf.cast(weights * pairs.squared_modulus(products), tf.float32)
        descent = self.tensors.sum_over_antenna(pull)
        return Projection(loss, model, descent, curvature, tf.cast(model, tf.float32), ())

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the gains alone times eta, shape (2, Nants, Nfreqs), float32."""
        model = projection.baseline_model
        change = projection.curvature * pairs.multiply(model, self.tensors.relative_change(eta))
        return self.tensors.sum_over_antenna(pairs.conjugate_multiply(model, change))


def _side_by_side(basis: np.ndarray) -> np.ndarray:
    """Return a basis (Nfreqs, Nvec), or those of all members of a joint piece, (Nfreqs, Nmembers * Nvec)."""
    return basis if basis.ndim == 2 else np.moveaxis(basis, 0, 1).reshape(basis.shape[1], -1)


def _overlap(basis: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Return A^T Q, (Nvec, rank), or those of all members of a joint piece, (Nvec, Nmembers * rank)."""
    if basis.ndim == 2:
        return basis.T @ common
    return np.moveaxis(basis.transpose(0, 2, 1) @ common, 0, 1).reshape(basis.shape[-1], -1)
