"""The likelihood of paper Eq. LOGLIKELIHOOD and LOGLIKELIHOODREDUNDANT, and the prior on the summed model."""

from __future__ import annotations

from collections.abc import Sequence

import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.tensors import FitTensors


def foreground_model(coefficients: Sequence[tf.Tensor], bases: Sequence[tf.Tensor]) -> tf.Tensor:
    """Return sum_i u_i A_i of all models, one matrix product per bucket (paper Eq. FGMODEL).

    Parameters
    ----------
    coefficients
        For each bucket, u of shape (2, Nmembers, Nvec).
    bases
        For each bucket, the basis A of shape (Nvec, Nfreqs).

    Returns
    -------
    Tensor of shape (2, Nmodels, Nfreqs).
    """
    models = []
    for u, basis in zip(coefficients, bases, strict=True):
        n_vectors, n_frequencies = basis.shape
        models.append(tf.reshape(tf.reshape(u, [-1, n_vectors]) @ basis, [2, -1, n_frequencies]))
    return tf.concat(models, axis=1)


def likelihood(
    tensors: FitTensors, gains: tf.Tensor, model: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor
) -> tf.Tensor:
    """Return sum w |v - g_a g_b* F|^2 over baselines and channels.

    Parameters
    ----------
    gains
        Shape (2, Nants, Nfreqs).
    model
        F on the baselines, shape (2, Nbls, Nfreqs).
    visibilities, weights
        Shapes (2, Nbls, Nfreqs) and (Nbls, Nfreqs).
    """
    residual = visibilities - pairs.multiply(tensors.gain_products(gains), model)
    return tf.reduce_sum(weights * pairs.squared_modulus(residual))


def sum_prior(tensors: FitTensors, model: tf.Tensor, weights: tf.Tensor, target: tf.Tensor) -> tf.Tensor:
    """Return |sum w' (F - m)|^2 with w' = w, on the model itself and not on gains times model (paper §Method).

    Parameters
    ----------
    model
        F on the baselines, shape (2, Nbls, Nfreqs).
    weights
        Shape (Nbls, Nfreqs).
    target
        The weighted sum of the sky model, shape (2,).
    """
    # The sum runs over visibilities as they were measured, also where the solver turned a baseline around.
    imaginary = model[1] if tensors.orientation is None else model[1] * tf.constant(tensors.orientation, model.dtype)
    total = tf.stack([tf.reduce_sum(weights * model[0]), tf.reduce_sum(weights * imaginary)])
    return pairs.squared_modulus(total - target)
