"""Sky-based calibration: foregrounds are known and frozen, only the gains are fitted."""

from __future__ import annotations

import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.tensors import FitTensors


class FrozenForegrounds:
    """Takes the place of `calstudy.calibrate.projection.Projector` where there is nothing to eliminate.

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
