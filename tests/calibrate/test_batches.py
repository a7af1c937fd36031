"""The ways that large arrays take to normal matrices and elementwise products, against the direct ones.

The plain elementwise products are tested against NumPy in test_calibration_loss.py and test_foreground_prior.py.
"""

from __future__ import annotations

import numpy as np
import pytest
import tensorflow as tf
from test_calibration_loss import redundant_structure
from test_foreground_prior import prior_structure
from test_joint_basis import block_diagonal
from toy import HEX, complex_normal, make_toy

from calstudy.calibrate import elementwise, pairs
from calstudy.calibrate.basis import dpss_vectors
from calstudy.calibrate.batches import ALIKE, ColumnProducts, Vectors, product_span
from calstudy.calibrate.solvers.reduced import ReducedKernels

CHANNELS = 200


# Each way of `Vectors.normal`: a basis for each row; few rows of one basis; more rows than it has vectors.
@pytest.mark.parametrize("rows", [1, ALIKE, 60])
def test_normal_matrices_are_sums_over_channels(rows):
    short, long = dpss_vectors(CHANNELS, 4.0, 1e-12), dpss_vectors(CHANNELS, 6.0, 1e-12)
    assert ALIKE < short.shape[1] < long.shape[1] < 60
    bases = np.zeros((2, long.shape[1], CHANNELS))
    bases[0, : short.shape[1]], bases[1] = short.T, long.T
    index, widths = np.repeat([0, 1], rows), np.array([short.shape[1], long.shape[1]])
    curvature = np.random.default_rng(1).exponential(size=(2 * rows, CHANNELS))
    found = Vectors(bases, bases, widths, index).normal(tf.constant(curvature)).numpy()
    expected = np.einsum("rf,rvf,rwf->rvw", curvature, bases[index], bases[index])
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


def test_products_of_smooth_columns_span_little_more_than_both():
    short, long = dpss_vectors(CHANNELS, 4.0, 1e-12), dpss_vectors(CHANNELS, 6.0, 1e-12)
    span = product_span([(short, long)], tf.float64)
    # Band-limited sequences multiply to the sum of their bands, with more vectors for the edges.
    assert span.shape[1] < 1.5 * (short.shape[1] + long.shape[1])
    products = (short[:, :, None] * long[:, None, :]).reshape(CHANNELS, -1)
    assert np.abs(products - span @ (span.T @ products)).max() < 1e-14
    rows = np.random.default_rng(1).standard_normal((50, CHANNELS))
    for basis in (span, np.eye(CHANNELS)):
        found = ColumnProducts(short, long, basis, np.dtype(float)).apply(tf.constant(rows))
        expected = np.einsum("rf,fi,fj->rij", rows, short, long)
        assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


def test_products_of_columns_that_are_not_smooth_have_no_span_of_their_own():
    white = np.random.default_rng(1).standard_normal((CHANNELS, 30))
    np.testing.assert_array_equal(product_span([(white, white)], tf.float64), np.eye(CHANNELS))


@pytest.fixture(scope="module")
def toy():
    return make_toy(HEX)


def make_problem(toy, case):
    """A problem with flags, and all that its kind of fit needs."""
    structure = {
        "per-baseline": lambda: toy.structure,
        "frozen": lambda: toy.structure,
        "turned-and-shared": lambda: redundant_structure(toy),
        "joint": lambda: block_diagonal(toy.structure),
        "prior": lambda: prior_structure(toy, "both"),
    }[case]()
    rng, shape = np.random.default_rng(2), toy.foregrounds.shape
    more = {"prior": {"deviations": (0.7, 1.9)}, "frozen": {"frozen": True}}.get(case, {})
    weights = rng.uniform(0.5, 2, shape) * (rng.random(shape) > 0.1)
    return toy.problem(structure, weights=weights, sky_model=toy.foregrounds, **more)


@pytest.mark.parametrize("case", ["per-baseline", "frozen", "turned-and-shared", "joint", "prior"])
@pytest.mark.parametrize("dtype", [tf.float64, tf.float32])
def test_fused_products_are_the_plain_ones(toy, case, dtype, monkeypatch):
    problem = make_problem(toy, case)
    rng = np.random.default_rng(3)
    eta, gains = complex_normal(rng, toy.gains.shape), toy.gains * (1 + 0.1 * complex_normal(rng, toy.gains.shape))

    def results():
        kernels = ReducedKernels(problem.structure, case == "frozen", dtype)
        reduced = kernels.reduce(problem, gains)
        found = kernels.project(reduced.gains, *reduced.data)
        direction = pairs.to_pair(eta, dtype)
        images = (
            kernels.projector.hessian_product(direction, found),
            kernels.projector.curvature_descent(direction, found),
        )
        return (found.loss, tf.concat(found.model, 1), found.descent), (found.power(), *images)

    plain = results()
    monkeypatch.setattr(elementwise, "LEAST_FUSED", 1)
    # Loss, model and gradient are float64 always. They are made of 21 baselines and 64 channels.
    for ones, others, rounding in zip(plain, results(), (1e-10, 1e-10 if dtype == tf.float64 else 1e-4), strict=True):
        for one, other in zip(ones, others, strict=True):
            assert np.abs(one - other).max() < rounding * np.abs(one).max()
