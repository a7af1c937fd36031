"""Complex arithmetic on real tensors whose first axis is (real, imaginary): faster than TensorFlow's complex types."""

from __future__ import annotations

import numpy as np
import tensorflow as tf


def to_pair(values: np.ndarray, dtype: tf.DType) -> tf.Tensor:
    """Return the real tensor (2, ...) of a complex array."""
    return tf.constant(np.stack([np.real(values), np.imag(values)]), dtype)


def to_complex(pair: tf.Tensor) -> np.ndarray:
    """Return the complex128 array of a real tensor (2, ...)."""
    values = pair.numpy().astype(np.float64)
    return values[0] + 1j * values[1]


def multiply(a: tf.Tensor, b: tf.Tensor) -> tf.Tensor:
    """Return a b."""
    return tf.stack([a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]])


def conjugate_multiply(a: tf.Tensor, b: tf.Tensor) -> tf.Tensor:
    """Return conj(a) b."""
    return tf.stack([a[0] * b[0] + a[1] * b[1], a[0] * b[1] - a[1] * b[0]])


def exponential(a: tf.Tensor) -> tf.Tensor:
    """Return exp(a)."""
    return tf.exp(a[0]) * tf.stack([tf.cos(a[1]), tf.sin(a[1])])


def squared_modulus(a: tf.Tensor) -> tf.Tensor:
    """Return |a|^2, without the first axis."""
    return a[0] * a[0] + a[1] * a[1]


def inner_product(a: tf.Tensor, b: tf.Tensor) -> tf.Tensor:
    """Return Re sum conj(a) b."""
    return tf.reduce_sum(a * b)
