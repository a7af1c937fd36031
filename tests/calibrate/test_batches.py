"""The ways that large arrays take to normal matrices and elementwise products, against the direct ones.

The plain elementwise products are tested against NumPy in test_calibration_loss.py and test_foreground_prior.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from toy import HEX, complex_normal, make_toy
from toy_structures import prior_structure, redundant_structure

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs, tensors
from calstudy.calibrate.basis import dpss_vectors
from calstudy.calibrate.batches import ALIKE, Vectors, column_products, product_span
from calstudy.calibrate.solvers.reduced import ReducedKernels

CHANNELS = 200


# Each way of `Vectors.normal`, by rows of both bases: a basis for each row; few rows of one basis; more rows than it
# has vectors, of both or of one; as many as there are channels.
@pytest.mark.parametrize("rows", [(1, 1), (ALIKE, ALIKE), (60, 60), (60, 10), (CHANNELS, CHANNELS), (10, CHANNELS)])
def test_normal_matrices_are_sums_over_channels(rows):
    short, long = dpss_vectors(CHANNELS, 4.0, 1e-12), dpss_vectors(CHANNELS, 6.0, 1e-12)
    assert ALIKE < short.shape[1] < long.shape[1] < 60
    bases = np.zeros((2, long.shape[1], CHANNELS))
    bases[0, : short.shape[1]], bases[1] = short.T, long.T
    index, widths = np.repeat([0, 1], rows), np.array([short.shape[1], long.shape[1]])
    curvature = np.random.default_rng(1).exponential(size=(sum(rows), CHANNELS))
    found = Vectors(bases, bases, widths, index).normal(tf.constant(curvature)).numpy()
    expected = np.einsum("rf,rvf,rwf->rvw", curvature, bases[index], bases[index])
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


# Vectors of a finite prior have norms down to 1e-5.
@pytest.mark.parametrize("least", [1.0, 1e-5])
def test_products_of_smooth_columns_span_little_more_than_both(least):
    short, long = dpss_vectors(CHANNELS, 4.0, 1e-12), dpss_vectors(CHANNELS, 6.0, 1e-12)
    short = short * np.geomspace(1, least, short.shape[1])
    span = product_span([(short, long)], tf.float64)
    # Band-limited sequences multiply to the sum of their bands, with more vectors for the edges.
    assert span.shape[1] < 1.5 * (short.shape[1] + long.shape[1])
    rows = np.random.default_rng(1).exponential(size=(50, CHANNELS))
    found = column_products(tf.constant(rows), tf.constant(short), tf.constant(long), span)
    expected = np.einsum("rf,fi,fj->rij", rows, short, long)
    norms = np.linalg.norm(short, axis=0)[:, None] * np.linalg.norm(long, axis=0)
    assert (np.abs(found - expected) / norms).max() < 1e-12


def test_products_of_columns_that_are_not_smooth_have_no_span_of_their_own():
    white = np.random.default_rng(1).standard_normal((CHANNELS, 40))
    assert product_span([(white, white)], tf.float64) is None


@pytest.fixture(scope="module")
def toy():
    return make_toy(HEX)


def make_problem(toy, case):
    """A problem with flags, and all that its kind of fit needs."""
    structure = {
        "frozen": lambda: toy.structure,
        "turned-and-shared": lambda: redundant_structure(toy),
        "prior": lambda: prior_structure(toy, "both"),
    }[case]()
    rng, shape = np.random.default_rng(2), toy.foregrounds.shape
    more = {"prior": {"deviations": (0.7, 1.9)}, "frozen": {"frozen": True}}.get(case, {})
    weights = rng.uniform(0.5, 2, shape) * (rng.random(shape) > 0.1)
    return toy.problem(structure, weights=weights, sky_model=toy.foregrounds, **more)


# Each kind of fit, and each precision of one of them: compilation takes seconds. One model per baseline gives the same
# products as models that some share, which are of all baselines; some are turned.
@pytest.mark.chain
@pytest.mark.parametrize(
    ("case", "dtype"),
    [
        ("prior", tf.float64),
        pytest.param("turned-and-shared", tf.float32, marks=pytest.mark.chain),
        *(("frozen", tf.float64), ("frozen", tf.float32)),
    ],
)
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
        blocks = [] if case == "frozen" else kernels.blocks(found)[2:]
        return (found.loss, tf.concat(found.model, 1), found.descent), (found.power(), *images, *blocks)

    plain = results()
    monkeypatch.setattr(tensors, "LEAST_FUSED", 1)
    # Loss, model and gradient are float64 always. They are made of 21 baselines and 64 channels.
    for ones, others, rounding in zip(plain, results(), (1e-10, 1e-10 if dtype == tf.float64 else 1e-4), strict=True):
        for one, other in zip(ones, others, strict=True):
            assert np.abs(one - other).max() < rounding * np.abs(one).max()
