"""Tensors of a fit: their order, sums and copies between antennas, baselines and models, products, and gains.

Inside the solvers, baselines are sorted by foreground model and models by bucket, so that each bucket is a slice. A
baseline that has the conjugate of its model is reversed: its antennas are swapped and its visibility is conjugated.
Later operations do not depend on the orientation.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.batches import Batch, make_batches
from calstudy.calibrate.problem import CalibrationProblem, FitStructure


class SortedData(NamedTuple):
    """The data of one problem, in the solvers' order and orientation.

    Visibilities, (2, Nbls, Nfreqs), are divided by their weighted rms, `scale`; weights are those of the problem.
    """

    visibilities: tf.Tensor
    weights: tf.Tensor
    scale: float


class Ends(NamedTuple):
    """Antennas a and b of some baselines, each (Nbls,), int32."""

    first: tf.Tensor
    second: tf.Tensor

    def slice(self, start: int, end: int) -> Ends:
        """Return the antennas of a range of baselines."""
        return Ends(self.first[start:end], self.second[start:end])

    def gain_products(self, gains: tf.Tensor) -> tf.Tensor:
        """Return g_a g_b* of the baselines, (2, Nbls, Nfreqs), for gains (2, Nants, Nfreqs)."""
        first, second = (tf.gather(gains, index, axis=1) for index in self)
        return pairs.conjugate_multiply(second, first)

    def relative_change(self, eta: tf.Tensor) -> tf.Tensor:
        """Return eta_a + eta_b*: the first-order relative change of g_a g_b* when g becomes g (1 + eta)."""
        (a_real, a_imaginary), (b_real, b_imaginary) = (tf.unstack(tf.gather(eta, index, axis=1)) for index in self)
        return tf.stack([a_real + b_real, a_imaginary - b_imaginary])

    def sum_over_antenna(self, values: tf.Tensor, n_antennas: int) -> tf.Tensor:
        """Add baselines to a, their conjugates to b: the transpose of `relative_change`, of (2, Nbls, Nfreqs)."""
        (a_real, b_real), (a_imaginary, b_imaginary) = (
            [tf.math.unsorted_segment_sum(part, index, n_antennas) for index in self] for part in tf.unstack(values)
        )
        return tf.stack([a_real + b_real, a_imaginary - b_imaginary])


class FitTensors:
    """Index tensors of one `FitStructure`.

    `shared` says whether any baselines share a model; `model_index`, that of each baseline, (Nbls,), ascending, is None
    if none do. `slices` are the models of each bucket, and `bases` their vectors, (Nfreqs, Nvec). `batches` of models
    are processed one after the other: the temporary arrays of one bound the memory, and the size of compiled graphs
    grows with their number. `orientation` is 1, or -1 for reversed baselines, (Nbls, 1); None if there are none.
    """

    def __init__(self, structure: FitStructure) -> None:
        buckets = structure.basis.buckets
        position = np.argsort(np.concatenate([bucket.members for bucket in buckets]))[structure.groups]
        self._order = np.argsort(position, kind="stable")
        self._conjugated = structure.conjugated[self._order]
        pairs_sorted = structure.antennas[self._order]
        pairs_sorted = np.where(self._conjugated[:, None], pairs_sorted[:, ::-1], pairs_sorted)
        self.n_antennas = structure.n_antennas
        self.n_baselines = structure.n_baselines
        self.n_frequencies = structure.n_frequencies
        self.n_models = structure.basis.n_models
        self.ends = Ends(*(tf.constant(index, tf.int32) for index in pairs_sorted.T))
        self.shared = self.n_models < self.n_baselines
        self.model_index = tf.constant(position[self._order], tf.int32) if self.shared else None
        sizes = [bucket.members.size for bucket in buckets]
        self.slices = list(pairwise(np.cumsum([0, *sizes]).tolist()))
        self.bases = [bucket.vectors for bucket in buckets]
        # The first baseline of each model, and one past the last of all.
        self._baseline_edges = np.searchsorted(position[self._order], np.arange(self.n_models + 1))
        self.batches = make_batches(self.bases, sizes, self._baseline_edges, structure.models_at_once)
        self.orientation = np.where(self._conjugated, -1.0, 1.0)[:, None] if self._conjugated.any() else None

    def load(self, problem: CalibrationProblem, dtype: tf.DType) -> SortedData:
        """Return the problem's data as tensors of `dtype`."""
        visibilities, weights = problem.visibilities[self._order], problem.weights[self._order]
        scale = float(np.sqrt(np.sum(weights * np.abs(visibilities) ** 2) / np.sum(weights)))
        return SortedData(self.load_model(problem.visibilities, scale, dtype), tf.constant(weights, dtype), scale)

    def ordered(self, weights: np.ndarray) -> tf.Tensor:
        """Return weights of the problem's baselines, (Nbls, Nfreqs), in the solvers' order, in double precision."""
        return tf.constant(weights[self._order], tf.float64)

    def load_model(self, model: np.ndarray, scale: float, dtype: tf.DType) -> tf.Tensor:
        """Return a model as a tensor in the solvers' order and orientation, (2, Nbls, Nfreqs); the inverse of `unload`.

        The model, (Nbls, Nfreqs), and `scale`, by which it is divided, are in the unit of the data.
        """
        values = model[self._order] / scale
        return pairs.to_pair(np.where(self._conjugated[:, None], values.conj(), values), dtype)

    def unload(self, model: Sequence[tf.Tensor], scale: float) -> np.ndarray:
        """Return a model in the problem's order and orientation, (Nbls, Nfreqs), times `scale`.

        The parts of the model follow each other, and are (2, N, Nfreqs) each.
        """
        sorted_model = scale * np.concatenate([pairs.to_complex(part) for part in model])
        result = np.empty_like(sorted_model)
        result[self._order] = np.where(self._conjugated[:, None], sorted_model.conj(), sorted_model)
        return result

    def owner(self, batch: Batch) -> np.ndarray:
        """Return the position in a batch of the model of each of its baselines, ascending, (Nbls,)."""
        start, end = batch.models
        return np.repeat(np.arange(end - start), np.diff(self._baseline_edges[start : end + 1]))

    def baselines_of(self, model: int) -> tuple[int, int]:
        """Return the first baseline of a model, and one past its last."""
        return int(self._baseline_edges[model]), int(self._baseline_edges[model + 1])

    def of_models(self, values: tf.Tensor) -> tf.Tensor:
        """Select the first baseline of each model: (2, Nbls, Nfreqs) to (2, Nmodels, Nfreqs)."""
        return values if self.model_index is None else tf.gather(values, self._baseline_edges[:-1], axis=1)

    def to_baselines(self, model: tf.Tensor) -> tf.Tensor:
        """Copy each model to its baselines: (2, Nmodels, Nfreqs) to (2, Nbls, Nfreqs)."""
        return model if self.model_index is None else tf.gather(model, self.model_index, axis=1)

    def sum_over_group(self, values: tf.Tensor) -> tf.Tensor:
        """Add up the baselines of each model, (2, Nbls, Nfreqs) to (2, Nmodels, Nfreqs); transposes `to_baselines`."""
        if self.model_index is None:
            return values
        return tf.stack([tf.math.segment_sum(part, self.model_index) for part in tf.unstack(values)])


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
        """Return F* (y - D x) summed by antenna, for a weighted change y and the response x of the foregrounds."""
        left = change if answer is None else change - curvature * answer
        return ends.sum_over_antenna(pairs.conjugate_multiply(model, left), self._n_antennas)


class GainSpace:
    """Coordinates of the gains: pairs (2, Nants, Nfreqs) themselves, or coefficients (2, Nants, Ngain) of a basis.

    Solvers iterate on relative changes eta of the gains, g (1 + eta). A basis B changes coordinates, eta = (c B^T) / g.

    The basis is orthonormal, (Nfreqs, Ngain), or None for no restriction. `dtype` is that of all tensors.
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
