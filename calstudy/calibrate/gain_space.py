"""The space of the gains: any gain in any channel, or combinations of smooth functions of frequency.

Solvers iterate on relative changes eta of the gains, g (1 + eta). A smooth basis B is a change of coordinates, eta = (c
B^T) / g.
"""

from __future__ import annotations

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs


class GainSpace:
    """Coordinates of the gains: pairs (2, Nants, Nfreqs) themselves, or coefficients (2, Nants, Ngain) of a basis.

    The basis is orthonormal, (Nfreqs, Ngain), as from `calstudy.calibrate.basis.gain_vectors`, or None for no
    restriction. `dtype` is that of all tensors.
    """

    def __init__(self, vectors: np.ndarray | None, dtype: tf.DType) -> None:
        self.vectors = None if vectors is None else tf.constant(vectors, dtype)

    def expand(self, coordinates: tf.Tensor) -> tf.Tensor:
        """Return the gains with these coordinates, (2, Nants, Nfreqs)."""
        if self.vectors is None:
            return coordinates
        return tf.einsum("pac,fc->paf", coordinates, self.vectors)

    def reduce(self, values: tf.Tensor) -> tf.Tensor:
        """Return the coordinates of the closest gains in least squares; the transpose of `expand`."""
        return values if self.vectors is None else tf.einsum("paf,fc->pac", values, self.vectors)

    def expand_relative(self, coordinates: tf.Tensor, gains: tf.Tensor) -> tf.Tensor:
        """Return eta for a change of the gains with these coordinates."""
        if self.vectors is None:
            return coordinates
        return pairs.conjugate_multiply(gains, self.expand(coordinates)) / pairs.squared_modulus(gains)

    def reduce_relative(self, values: tf.Tensor, gains: tf.Tensor) -> tf.Tensor:
        """Apply the transpose of `expand_relative`."""
        if self.vectors is None:
            return values
        return self.reduce(pairs.multiply(gains, values) / pairs.squared_modulus(gains))

    def columns(self, gains: tf.Tensor) -> tf.Tensor:
        """Return eta of each antenna for a unit of each coefficient of a basis, (Nants, Nfreqs, Ngain), complex."""
        inverse = 1 / tf.complex(gains[0], gains[1])
        return inverse[:, :, None] * tf.cast(self.vectors, inverse.dtype)
