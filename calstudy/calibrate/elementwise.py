"""Elementwise products of gains, models and data on baselines, in the notation of `calstudy.calibrate.projection`."""

from __future__ import annotations

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.tensors import Ends, FitTensors

# From this many visibilities on, the elementwise products of a fit are compiled (XLA): one pass over the memory in
# place of a dozen, for a second of compilation.
LEAST_FUSED = 1_000_000


class BaselineProducts:
    """The products of the elimination and of its Gauss-Newton matrix on some baselines.

    They are compiled if `fused`; batches with equal numbers of baselines share one compilation.
    """

    def __init__(self, tensors: FitTensors) -> None:
        self._n_antennas = tensors.n_antennas
        self.fused = tensors.n_baselines * tensors.n_frequencies >= LEAST_FUSED
        self.curvature, self.match, self.residual, self.unmatched, self.change, self.pull = (
            tf.function(function, jit_compile=self.fused, autograph=False)
            for function in (self._curvature, self._match, self._residual, self._unmatched, self._change, self._pull)
        )

    def _curvature(self, gains: tf.Tensor, ends: Ends, weights: tf.Tensor) -> tf.Tensor:
        """Return D, (Nbls, Nfreqs), for gains (2, Nants, Nfreqs)."""
        return weights * pairs.squared_modulus(ends.gain_products(gains))

    def _match(
        self, gains: tf.Tensor, ends: Ends, visibilities: tf.Tensor, weights: tf.Tensor, mean: tf.Tensor | None
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return D, (Nbls, Nfreqs), and G* w V, less D m if there is a mean m, (2, Nbls, Nfreqs)."""
        products = ends.gain_products(gains)
        curvature = weights * pairs.squared_modulus(products)
        matched = pairs.conjugate_multiply(products, weights * visibilities)
        return curvature, matched if mean is None else matched - curvature * mean

    def _residual(
        self, gains: tf.Tensor, ends: Ends, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor
    ) -> tuple[tf.Tensor, tf.Tensor]:
        """Return sum w |V - G F|^2, and minus half its gradient in eta with F fixed, (2, Nants, Nfreqs)."""
        products = ends.gain_products(gains)
        residual = visibilities - pairs.multiply(products, model)
        pull = pairs.conjugate_multiply(model, weights * pairs.conjugate_multiply(products, residual))
        loss = tf.reduce_sum(weights * pairs.squared_modulus(residual))
        return loss, ends.sum_over_antenna(pull, self._n_antennas)

    def _unmatched(
        self, gains: tf.Tensor, ends: Ends, visibilities: tf.Tensor, weights: tf.Tensor, model: tf.Tensor
    ) -> tf.Tensor:
        """Return G* w (V - G F), (2, Nbls, Nfreqs)."""
        products = ends.gain_products(gains)
        return pairs.conjugate_multiply(products, weights * (visibilities - pairs.multiply(products, model)))

    def _change(self, eta: tf.Tensor, ends: Ends, curvature: tf.Tensor, model: tf.Tensor) -> tf.Tensor:
        """Return D F (eta_a + eta_b*), (2, Nbls, Nfreqs)."""
        return curvature * pairs.multiply(model, ends.relative_change(eta))

    def _pull(
        self, change: tf.Tensor, answer: tf.Tensor | None, ends: Ends, curvature: tf.Tensor, model: tf.Tensor
    ) -> tf.Tensor:
        """Return F* (y - D x) summed by antenna, (2, Nants, Nfreqs).

        y is a weighted change, and x the response of the foregrounds.
        """
        left = change if answer is None else change - curvature * answer
        return ends.sum_over_antenna(pairs.conjugate_multiply(model, left), self._n_antennas)
