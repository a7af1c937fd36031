"""The likelihood of paper Eq. LOGLIKELIHOOD and LOGLIKELIHOODREDUNDANT, and the prior on the summed model."""

from __future__ import annotations

from collections.abc import Sequence

import tensorflow as tf

from calstudy.calibrate.tensors import FitTensors

# Real and imaginary parts stay apart here: stacking them would cost the compiled step a copy each time.
Parts = tuple[tf.Tensor, tf.Tensor]


def foreground_model(coefficients: Sequence[tf.Tensor], bases: Sequence[tf.Tensor]) -> Parts:
    """Return sum_i u_i A_i of all models, one matrix product per bucket (paper Eq. FGMODEL).

    Parameters
    ----------
    coefficients
        For each bucket, u of shape (2, Nmembers, Nvec); (2, 1, Nvec) for a joint bucket.
    bases
        For each bucket, the basis A of shape (Nvec, Nfreqs); (Nvec, Nmembers, Nfreqs) for a joint bucket.

    Returns
    -------
    Real and imaginary part, each of shape (Nmodels, Nfreqs).
    """
    real, imaginary = [], []
    for u, basis in zip(coefficients, bases, strict=True):
        n_vectors, n_frequencies = basis.shape[0], basis.shape[-1]
        both = tf.reshape(u, [-1, n_vectors]) @ tf.reshape(basis, [n_vectors, -1])
        both = tf.reshape(both, [-1, n_frequencies])
        n_members = both.shape[0] // 2
        real.append(both[:n_members])
        imaginary.append(both[n_members:])
    return tf.concat(real, axis=0), tf.concat(imaginary, axis=0)


def likelihood(
    tensors: FitTensors, gains: tf.Tensor, model: Parts, visibilities: tf.Tensor, weights: tf.Tensor
) -> tf.Tensor:
    """Return sum w |v - g_a g_b* F|^2 over baselines and channels.

    Parameters
    ----------
    gains
        Shape (2, Nants, Nfreqs).
    model
        F on the baselines, real and imaginary part, each (Nbls, Nfreqs).
    visibilities, weights
        Shapes (2, Nbls, Nfreqs) and (Nbls, Nfreqs).
    """
    a_real, a_imaginary = tf.gather(gains[0], tensors.first), tf.gather(gains[1], tensors.first)
    b_real, b_imaginary = tf.gather(gains[0], tensors.second), tf.gather(gains[1], tensors.second)
    product_real = a_real * b_real + a_imaginary * b_imaginary
    product_imaginary = a_imaginary * b_real - a_real * b_imaginary
    residual_real = visibilities[0] - (product_real * model[0] - product_imaginary * model[1])
    residual_imaginary = visibilities[1] - (product_imaginary * model[0] + product_real * model[1])
    return tf.reduce_sum(weights * (tf.square(residual_real) + tf.square(residual_imaginary)))


def sum_prior(tensors: FitTensors, model: Parts, weights: tf.Tensor, target: tf.Tensor) -> tf.Tensor:
    """Return |sum w' (F - m)|^2 with w' = w, on the model itself and not on gains times model (paper §Method).

    Parameters
    ----------
    model
        F on the baselines, real and imaginary part, each (Nbls, Nfreqs).
    weights
        Shape (Nbls, Nfreqs).
    target
        The weighted sum of the sky model, shape (2,).
    """
    # The sum runs over visibilities as they were measured, also where the solver turned a baseline around.
    imaginary = model[1] if tensors.orientation is None else model[1] * tf.constant(tensors.orientation, weights.dtype)
    real_excess = tf.reduce_sum(weights * model[0]) - target[0]
    imaginary_excess = tf.reduce_sum(weights * imaginary) - target[1]
    return tf.square(real_excess) + tf.square(imaginary_excess)
