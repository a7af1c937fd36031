"""A Gaussian prior on the foregrounds: its fit against dense matrices, its limits against fits that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tensorflow as tf
from test_calibration_loss import redundant_structure
from toy import BASIS, FREQUENCIES, complex_normal

from calstudy.calibrate import pairs
from calstudy.calibrate.basis import flat_wedge_root, make_basis
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, gain_products
from calstudy.calibrate.solvers.reduced import ReducedKernels

SIGMA = 0.05
OWN, SHARED = 0.7, 1.9


def prior_structure(toy, prior):
    """The toy's baselines, some of them turned around, by redundant groups unless all coefficients are their own."""
    structure = redundant_structure(toy)
    lengths = np.linalg.norm(
        toy.positions[structure.antennas[:, 1]] - toy.positions[structure.antennas[:, 0]], axis=1
    )
    if prior == "own":
        basis = make_basis(lengths, FREQUENCIES, BASIS, prior=True)
        return replace(FitStructure.per_baseline(structure.antennas, len(toy.positions), basis), prior=prior)
    longest = np.zeros(structure.basis.n_models)
    np.maximum.at(longest, structure.groups, lengths)
    return replace(structure, basis=make_basis(longest, FREQUENCIES, BASIS, prior=True), prior=prior)


@pytest.fixture(params=["own", "shared", "both"])
def problem(request, hexagon) -> CalibrationProblem:
    """Random data, weights with flags, and a sky model that is not redundant."""
    structure = prior_structure(hexagon, request.param)
    rng = np.random.default_rng(11)
    shape = (structure.n_baselines, structure.n_frequencies)
    weights = (rng.random(shape) > 0.1) * rng.uniform(0.5, 2, shape) / SIGMA**2
    sky = complex_normal(rng, shape) + hexagon.foregrounds
    data = sky + complex_normal(rng, shape)
    start = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    return CalibrationProblem(structure, data, weights, start, sky, deviations=(OWN, SHARED))


def dense_covariance(structure):
    """C of all samples, (Nbls Nfreqs) squared, for visibilities of which conjugated ones are turned back."""
    vectors = [None] * structure.basis.n_models
    for bucket in structure.basis.buckets:
        for index in bucket.members:
            vectors[index] = bucket.vectors
    n = structure.n_frequencies
    result = np.zeros((structure.n_baselines, n, structure.n_baselines, n))
    for p, group in enumerate(structure.groups):
        covariance = vectors[group] @ vectors[group].T
        if structure.prior in ("own", "both"):
            result[p, :, p] += OWN**2 * covariance
        if structure.prior in ("shared", "both"):
            for q in np.flatnonzero(structure.groups == group):
                result[p, :, q] += SHARED**2 * covariance
    return result.reshape(structure.n_baselines * n, -1)


def turned(structure, values):
    return np.where(structure.conjugated[:, None], values.conj(), values)


def dense_fit(problem, gains):
    """Loss and foregrounds by (N + G C G^H)^-1, with weights zero left out."""
    structure = problem.structure
    products = turned(structure, gain_products(gains, structure.antennas)).ravel()
    mean = turned(structure, problem.sky_model).ravel()
    data = turned(structure, problem.visibilities).ravel()
    used = problem.weights.ravel() > 0
    covariance = dense_covariance(structure)
    crossed = covariance[:, used] * products[used].conj()
    whole = products[used, None] * crossed[used] + np.diag(1 / problem.weights.ravel()[used])
    excess = (data - products * mean)[used]
    solved = np.linalg.solve(whole, excess)
    model = turned(structure, (mean + crossed @ solved).reshape(problem.weights.shape))
    return np.vdot(excess, solved).real, model


def projected(problem, gains, dtype=tf.float32):
    kernels = ReducedKernels(problem.structure, False, dtype)
    reduced = kernels.reduce(problem, gains)
    return kernels, reduced, kernels.project(reduced.gains, *reduced.data)


@pytest.fixture
def gains(problem):
    return 1 + 0.2 * complex_normal(np.random.default_rng(3), problem.initial_gains.shape)


def test_the_root_has_the_covariance_of_a_flat_wedge():
    channels, width = 64, 5.3
    covariance = flat_wedge_root(channels, width, 1e-13) @ flat_wedge_root(channels, width, 1e-13).T
    lag = np.subtract.outer(np.arange(channels), np.arange(channels))
    assert np.abs(covariance - np.sinc(2 * width / channels * lag)).max() < 1e-6


def test_loss_and_foregrounds_are_those_of_dense_matrices(problem, gains):
    kernels, reduced, projection = projected(problem, gains)
    loss, model = dense_fit(problem, gains)
    assert float(projection.loss) * reduced.loss_unit == pytest.approx(loss, rel=1e-9)
    found = kernels.tensors.unload(projection.model, reduced.scale)
    assert np.abs(found - model)[problem.weights > 0].max() < 1e-8 * np.abs(model).max()


def test_descent_is_the_gradient(problem, gains):
    _, reduced, projection = projected(problem, gains)
    eta = complex_normal(np.random.default_rng(7), gains.shape)
    slope = -2 * float(pairs.inner_product(projection.descent, pairs.to_pair(eta, tf.float64))) * reduced.loss_unit
    h = 1e-5
    above, below = (dense_fit(problem, gains * (1 + step * eta))[0] for step in (h, -h))
    assert slope == pytest.approx((above - below) / (2 * h), rel=1e-6)


def test_hessian_is_that_of_foregrounds_that_follow(problem, gains):
    """eta^H H eta' = change^H (N + G C G^H)^-1 change', with the change of the data at fixed foregrounds."""
    kernels, reduced, projection = projected(problem, gains, tf.float64)
    structure = problem.structure
    rng = np.random.default_rng(8)
    eta, other = complex_normal(rng, gains.shape), complex_normal(rng, gains.shape)
    image = kernels.projector.hessian_product(pairs.to_pair(eta, tf.float64), projection)
    products = gain_products(gains, structure.antennas)
    model = dense_fit(problem, gains)[1]

    def change(direction):
        relative = direction[structure.antennas[:, 0]] + direction[structure.antennas[:, 1]].conj()
        return replace(problem, visibilities=products * (problem.sky_model + model * relative))

    first, second = (turned(structure, change(x).visibilities - products * problem.sky_model) for x in (eta, other))
    used = problem.weights.ravel() > 0
    factors = turned(structure, products).ravel()[used]
    whole = factors[:, None] * dense_covariance(structure)[np.ix_(used, used)] * factors.conj()
    whole += np.diag(1 / problem.weights.ravel()[used])
    expected = np.vdot(second.ravel()[used], np.linalg.solve(whole, first.ravel()[used])).real
    found = float(pairs.inner_product(pairs.to_pair(other, tf.float64), image)) * reduced.loss_unit
    assert found == pytest.approx(expected, rel=1e-6)
