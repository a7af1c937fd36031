"""Products with foreground vectors, and of gains, models and data: the ways that large arrays take against the direct.

The direct ways are NumPy here; the plain products of `calstudy.calibrate.projection` are tested against NumPy in
test_calibration_loss.py.
"""

from __future__ import annotations

import numpy as np
import pytest
import tensorflow as tf
from toy import complex_normal, make_toy, scattered

from calstudy.calibrate import batches, pairs, projection
from calstudy.calibrate.basis import dpss_vectors
from calstudy.calibrate.batches import Vectors, span_of, span_of_products
from calstudy.calibrate.projection import FrozenForegrounds, Projector
from calstudy.calibrate.tensors import FitTensors

CHANNELS = 200


@pytest.mark.parametrize("half_bandwidth", [4.0, 12.0])
def test_products_of_vectors_span_twice_their_band(half_bandwidth):
    basis = dpss_vectors(CHANNELS, half_bandwidth, 1e-12)
    span = span_of_products(basis)
    # Slepian's count for twice the band, and a few sequences for each edge, as the basis itself has.
    assert span.shape[1] <= 2 * basis.shape[1] + 10
    products = (basis[:, :, None] * basis[:, None, :]).reshape(CHANNELS, -1)
    left = products - span @ (span.T @ products)
    assert np.abs(left).max() < 1e-14 * np.abs(products).max() * CHANNELS


def test_products_that_span_nearly_all_channels_are_of_no_use():
    assert span_of_products(dpss_vectors(CHANNELS, 40.0, 1e-12)) is None
    # Foregrounds that are free in each channel: vectors without a channel in common have no product.
    assert span_of_products(np.eye(CHANNELS)) is None


# Rows of one basis: fewer than its vectors, and more; with and without what their products span.
@pytest.mark.parametrize("rows", [3, 60])
@pytest.mark.parametrize("narrow", [True, False])
def test_normal_matrices_are_sums_over_channels(rows, narrow):
    short, long = dpss_vectors(CHANNELS, 4.0, 1e-12), dpss_vectors(CHANNELS, 6.0, 1e-12)
    bases = np.zeros((2, long.shape[1], CHANNELS))
    bases[0, : short.shape[1]], bases[1] = short.T, long.T
    # The longer basis alone does not span the edges of the shorter one.
    span = span_of_products(span_of([short, long], tf.float64)) if narrow else None
    index = np.repeat([0, 1], rows)
    widths = np.array([short.shape[1], long.shape[1]])
    curvature = np.random.default_rng(1).exponential(size=(2 * rows, CHANNELS))
    found = Vectors(bases, bases, widths, index, span).normal(tf.constant(curvature)).numpy()
    expected = np.einsum("rf,rvf,rwf->rvw", curvature, bases[index], bases[index])
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.fixture(scope="module")
def toy():
    return make_toy(scattered(6))


def results(toy, frozen):
    """Projection, Gauss-Newton product and curvature at gains with errors, as NumPy arrays."""
    problem, structure = toy.problem(), toy.structure
    tensors = FitTensors(structure)
    data = tensors.load(problem, tf.float64)
    arguments = [pairs.to_pair(toy.gains, tf.float64), data.visibilities, data.weights]
    if frozen:
        projector = FrozenForegrounds(tensors, tf.float64)
        arguments.append(tensors.load_model(toy.foregrounds, data.scale, tf.float64))
    else:
        projector = Projector(structure, tensors, tf.float64)
    found = projector.project(*arguments)
    eta = pairs.to_pair(complex_normal(np.random.default_rng(2), toy.gains.shape), tf.float64)
    images = projector.hessian_product(eta, found), projector.curvature_descent(eta, found)
    return [value.numpy() for value in (found.loss, found.model, found.descent, found.curvature, *images)]


@pytest.mark.parametrize("frozen", [False, True])
def test_fused_products_are_the_plain_ones(toy, frozen, monkeypatch):
    plain = results(toy, frozen)
    monkeypatch.setattr(projection, "LEAST_FUSED", 1)
    for one, other in zip(plain, results(toy, frozen), strict=True):
        # Descent and loss come from residuals a thousand times smaller than the data.
        assert np.abs(one - other).max() < 1e-10 * np.abs(one).max()


def test_the_projection_by_the_span_of_products_is_the_same(toy, monkeypatch):
    direct = results(toy, frozen=False)
    # The toy's bands are too wide for their products to span little of them.
    monkeypatch.setattr(batches, "NARROW", 1.0)
    monkeypatch.setattr(batches, "ALIKE", 0)
    for one, other in zip(direct, results(toy, frozen=False), strict=True):
        assert np.abs(one - other).max() < 1e-8 * np.abs(one).max()
