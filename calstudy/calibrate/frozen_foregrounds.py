"""Projection of a sky-based fit, whose foregrounds are known, so that none are eliminated."""

from __future__ import annotations

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.elementwise import BaselineProducts
from calstudy.calibrate.projection import Linearization, Projection
from calstudy.calibrate.tensors import FitTensors


class FrozenForegrounds:
    """Replacement of `calstudy.calibrate.projection.Projector` for known foregrounds.

    Because foregrounds do not respond, the Gauss-Newton matrix does not couple channels.
    """

    def __init__(self, tensors: FitTensors, dtype: tf.DType = tf.float32) -> None:
        self.tensors, self.dtype, self._products = tensors, dtype, BaselineProducts(tensors)
        self.project = tf.function(self._project, autograph=False)

    def _project(self, gains: tf.Tensor, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor) -> Projection:
        loss, descent = self._products.residual(gains, self.tensors.ends, visibilities, weights, model)
        curvature = self._products.curvature(gains, self.tensors.ends, weights)
        part = Linearization(tf.cast(curvature, self.dtype), tf.cast(model, self.dtype), ())
        return Projection(loss, (model,), descent, (part,))

    def hessian_product(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the Gauss-Newton matrix of the gains alone times eta, shape (2, Nants, Nfreqs)."""
        (part,), ends = projection.parts, self.tensors.ends
        change = self._products.change(eta, ends, part.curvature, part.model)
        return self._products.pull(change, None, ends, part.curvature, part.model)

    def curvature_descent(self, eta: tf.Tensor, projection: Projection) -> tf.Tensor:
        """Return the same as `Projector.curvature_descent`, with fixed foregrounds."""
        (part,), ends = projection.parts, self.tensors.ends
        second = pairs.multiply(part.model, ends.relative_change(eta))
        change = self._products.change(eta, ends, part.curvature, second)
        return -self._products.pull(change, None, ends, part.curvature, part.model)
