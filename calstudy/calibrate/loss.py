"""The joint loss of gains and foreground coefficients, and its gradient.

It is the likelihood of paper Eq. LOGLIKELIHOOD and LOGLIKELIHOODREDUNDANT, and the prior on the summed model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from calstudy.base.tensorflow import tf
from calstudy.calibrate.gain_space import GainSpace
from calstudy.calibrate.problem import Prior
from calstudy.calibrate.tensors import Ends, FitTensors

# Real and imaginary parts stay apart here: stacking them would cost the compiled step a copy each time.
RealImaginary = tuple[tf.Tensor, tf.Tensor]
# Baselines are divided into at most this many parts, so that the temporary arrays of a part stay in the processor's
# cache. More of them take longer to compile.
PARTS = 8


class Parameters(NamedTuple):
    """Unknowns or anything of their shape: gains (2, Nants, Nfreqs) and one (2, Nmembers, Nvec) per bucket.

    Gains in a smooth basis are its coefficients, (2, Nants, Ngain). With frozen foregrounds there is none.
    """

    gains: tf.Tensor
    coefficients: tuple[tf.Tensor, ...]


class FitData(NamedTuple):
    """Visibilities (2, Nbls, Nfreqs), weights (Nbls, Nfreqs) and the prior's target (2,), in units of the rms.

    The model (2, Nbls, Nfreqs) is given only if it is frozen, `summed` (see `sum_prior`) only if it is not.
    """

    visibilities: tf.Tensor
    weights: tf.Tensor
    target: tf.Tensor
    summed: tuple[tf.Tensor, ...]
    model: tf.Tensor | None = None


class Part(NamedTuple):
    """Some baselines of the loss, which is a sum over them.

    Ranges are the first one and one past the last, in the solvers' order.
    """

    buckets: tuple[int, int]
    models: tuple[int, int]
    baselines: tuple[int, int]


def foreground_model(coefficients: Sequence[tf.Tensor], bases: Sequence[tf.Tensor]) -> RealImaginary:
    """Return sum_i u_i A_i of all models, real and imaginary part, each (Nmodels, Nfreqs) (paper Eq. FGMODEL).

    There is one matrix product per bucket, of u, (2, Nmembers, Nvec), and the basis A, (Nvec, Nfreqs).
    """
    real, imaginary = [], []
    for u, basis in zip(coefficients, bases, strict=True):
        both = tf.reshape(u, [-1, basis.shape[0]]) @ basis
        # The gradient of a split is one concatenation; that of two slices would be two arrays padded with zeros.
        parts = tf.split(both, 2)
        real.append(parts[0])
        imaginary.append(parts[1])
    return tf.concat(real, axis=0), tf.concat(imaginary, axis=0)


def likelihood(
    ends: Ends,
    gains: tf.Tensor,
    model: RealImaginary,
    visibilities: tf.Tensor,
    weights: tf.Tensor,
) -> tf.Tensor:
    """Return sum w |v - g_a g_b* F|^2 over baselines and channels.

    Gains are (2, Nants, Nfreqs); F is given on the baselines, real and imaginary part, each (Nbls, Nfreqs).
    Visibilities are (2, Nbls, Nfreqs), weights (Nbls, Nfreqs).
    """
    first, second = ends
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

    `coefficients` are u of each bucket, see `foreground_model`; `summed` are their weights in the real and the
    imaginary part of sum w F, of the same shapes. The target is the weighted sum of the sky model, (2,).
    """
    # One sum of all is compiled faster than one for each bucket.
    products = [tf.reshape(u * weight, [2, -1]) for u, weight in zip(coefficients, summed, strict=True)]
    return tf.reduce_sum(tf.square(tf.reduce_sum(tf.concat(products, axis=1), axis=1) - target))


def _make_parts(tensors: FitTensors) -> list[Part]:
    """Divide all baselines into at most `PARTS` parts, of whole buckets."""
    parts: list[Part] = []
    start = 0
    for bucket, (_, model) in enumerate(tensors.slices):
        first_model = tensors.slices[start][0]
        (first, _), (_, last) = tensors.baselines_of(first_model), tensors.baselines_of(model - 1)
        if last >= tensors.n_baselines * (len(parts) + 1) / PARTS:
            parts.append(Part((start, bucket + 1), (first_model, model), (first, last)))
            start = bucket + 1
    return parts


class JointLoss:
    """The loss of one fit structure, in parts.

    Gains are fitted in `space`. Of the priors of the overall scale, only ``sum`` is part of the loss. `dtype` is that
    of the loss, its parameters, and `space`.
    """

    def __init__(self, tensors: FitTensors, space: GainSpace, prior: Prior, dtype: tf.DType) -> None:
        self._tensors, self._space, self._with_prior, self._dtype = tensors, space, prior == "sum", dtype
        self._bases = [tf.constant(basis.T, self._dtype) for basis in tensors.bases]
        self._parts = _make_parts(tensors)

    def summed(self, weights: tf.Tensor) -> tuple[tf.Tensor, ...]:
        """Return the weight of each coefficient in the sum of w F over baselines and channels; see `sum_prior`.

        Weights are (Nbls, Nfreqs), float64.
        """
        # The sum runs over visibilities as they were measured, also where the solver turned a baseline around.
        orientation = self._tensors.orientation
        of_parts = tf.stack([weights, weights if orientation is None else weights * orientation])
        return self.coefficients(self._tensors.sum_pairs_over_group(of_parts))

    def coefficients(self, models: tf.Tensor) -> tuple[tf.Tensor, ...]:
        """Return A^T F of each bucket for models (2, Nmodels, Nfreqs), float64; the transpose of `foreground_model`."""
        parts = zip(self._tensors.slices, self._tensors.bases, strict=True)
        return tuple(tf.cast(models[:, first:last] @ basis, self._dtype) for (first, last), basis in parts)

    def model(self, coefficients: Sequence[tf.Tensor]) -> tf.Tensor:
        """Return F on the baselines, (2, Nbls, Nfreqs), for the coefficients of each bucket; see `foreground_model`."""
        return self._tensors.to_baselines(tf.stack(foreground_model(coefficients, self._bases)))

    def _part_loss(self, part: Part, gains: tf.Tensor, coefficients: tuple[tf.Tensor, ...], data: FitData) -> tf.Tensor:
        """Return the likelihood of a part, for gains (2, Nants, Nfreqs) and the coefficients of its models."""
        first, last = part.baselines
        if data.model is not None:
            model = tf.unstack(data.model[:, first:last])
        else:
            model = foreground_model(coefficients, self._bases[slice(*part.buckets)])
            if self._tensors.model_index is not None:
                owner = self._tensors.model_index[first:last] - part.models[0]
                model = tuple(tf.gather(values, owner) for values in model)
        ends = self._tensors.ends.slice(first, last)
        return likelihood(ends, gains, model, data.visibilities[:, first:last], data.weights[first:last])

    def value(self, parameters: Parameters, data: FitData) -> tf.Tensor:
        """Return the likelihood, plus the sum prior where the problem has it."""
        gains = self._space.expand(parameters.gains)
        values = [
            self._part_loss(part, gains, parameters.coefficients[slice(*part.buckets)], data) for part in self._parts
        ]
        if self._with_prior and data.model is None:
            values.append(sum_prior(parameters.coefficients, data.summed, data.target))
        return tf.add_n(values)

    def value_and_gradient(self, parameters: Parameters, data: FitData) -> tuple[tf.Tensor, Parameters]:
        """Return the loss and its gradient, of the shape of the parameters."""
        gains = self._space.expand(parameters.gains)
        values, of_gains, of_coefficients = [], [], []
        # The gradient of each part by itself: that of their sum would keep all that the parts need until the end.
        for part in self._parts:
            coefficients = parameters.coefficients[slice(*part.buckets)]
            with tf.GradientTape() as tape:
                tape.watch([gains, coefficients])
                value = self._part_loss(part, gains, coefficients, data)
            slope, slopes = tape.gradient(value, [gains, coefficients])
            values.append(value)
            of_gains.append(slope)
            of_coefficients.extend(slopes)
        if self._with_prior and data.model is None:
            with tf.GradientTape() as tape:
                tape.watch(parameters.coefficients)
                values.append(sum_prior(parameters.coefficients, data.summed, data.target))
            slopes = tape.gradient(values[-1], parameters.coefficients)
            of_coefficients = [slope + more for slope, more in zip(of_coefficients, slopes, strict=True)]
        return tf.add_n(values), Parameters(self._space.reduce(tf.add_n(of_gains)), tuple(of_coefficients))
