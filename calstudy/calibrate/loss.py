"""The likelihood of paper Eq. LOGLIKELIHOOD and LOGLIKELIHOODREDUNDANT, and the prior on the summed model."""

from __future__ import annotations

from collections.abc import Sequence

import tensorflow as tf

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
        # The gradient of a split is one concatenation; that of two slices would be two arrays padded with zeros.
        parts = tf.split(tf.reshape(both, [-1, n_frequencies]), 2)
        real.append(parts[0])
        imaginary.append(parts[1])
    return tf.concat(real, axis=0), tf.concat(imaginary, axis=0)


def likelihood(
    antennas: tuple[tf.Tensor, tf.Tensor], gains: tf.Tensor, model: Parts, visibilities: tf.Tensor, weights: tf.Tensor
) -> tf.Tensor:
    """Return sum w |v - g_a g_b* F|^2 over baselines and channels.

    Parameters
    ----------
    antennas
        a and b of each baseline, each of shape (Nbls,), int32.
    gains
        Shape (2, Nants, Nfreqs).
    model
        F on the baselines, real and imaginary part, each (Nbls, Nfreqs).
    visibilities, weights
        Shapes (2, Nbls, Nfreqs) and (Nbls, Nfreqs).
    """
    first, second = antennas
    real, imaginary = tf.unstack(gains)
    a_real, a_imaginary = tf.gather(real, first), tf.gather(imaginary, first)
    b_real, b_imaginary = tf.gather(real, second), tf.gather(imaginary, second)
    product_real = a_real * b_real + a_imaginary * b_imaginary
    product_imaginary = a_imaginary * b_real - a_real * b_imaginary
    residual_real = visibilities[0] - (product_real * model[0] - product_imaginary * model[1])
    residual_imaginary = visibilities[1] - (product_imaginary * model[0] + product_real * model[1])
    return tf.reduce_sum(weights * (tf.square(residual_real) + tf.square(residual_imaginary)))


def sum_prior(coefficients: Sequence[tf.Tensor], summed: Sequence[tf.Tensor], target: tf.Tensor) -> tf.Tensor:
    """Return |sum w' (F - m)|^2 with w' = w, on the model itself and not on gains times model (paper §Method).

    Parameters
    ----------
    coefficients
        u of each bucket, see `foreground_model`.
    summed
        What sum w F has of each of them, for its real part and its imaginary part, of the same shapes.
    target
        The weighted sum of the sky model, shape (2,).
    """
    parts = [tf.reduce_sum(u * weight, axis=(1, 2)) for u, weight in zip(coefficients, summed, strict=True)]
    return tf.reduce_sum(tf.square(tf.add_n(parts) - target))
