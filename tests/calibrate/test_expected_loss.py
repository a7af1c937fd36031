"""What a fit is expected to leave of a small signal, against brute force, against itself, and against injection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, HEX, complex_normal, make_toy, scattered
from toy_structures import dense_covariance, prior_structure, redundant_structure, turned

from calstudy.calibrate.basis import gain_vectors
from calstudy.calibrate.expected_loss import DelayModes, expected_transfer, linear_response
from calstudy.calibrate.problem import flag_weights, gain_products
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import WarmStart, solve_warm
from calstudy.calibrate.solvers.reduced import ReducedKernels

MODES = DelayModes(FREQUENCIES)


def brute_force(problem, gains, model):
    """<f|1 - P|f> / <f|f> from the tangent vectors of every real unknown, gains and coefficients, by an SVD."""
    structure = problem.structure
    antennas, shape = structure.antennas, model.shape
    products = gain_products(gains, antennas)
    roots = np.sqrt(problem.weights)
    tangents = []
    vectors = np.eye(shape[1]) if structure.gain_vectors is None else structure.gain_vectors
    for unit in (1, 1j):
        for antenna in range(structure.n_antennas):
            for vector in vectors.T:
                change = np.zeros_like(gains)
                change[antenna] = unit * vector
                first, second = antennas.T
                moved = change[first] * gains[second].conj() + gains[first] * change[second].conj()
                tangents.append(roots * moved * model)
        for bucket in structure.basis.buckets:
            for index in bucket.members:
                for vector in bucket.vectors.T:
                    moved = np.zeros(shape, complex)
                    for p in np.flatnonzero(structure.groups == index):
                        moved[p] = (np.conj(unit) if structure.conjugated[p] else unit) * vector
                    tangents.append(roots * products * moved)
    # The phases of g_a g_b* turn the plane of each sample, which isotropic signals do not see.
    turned = np.array(tangents) * (np.abs(products) / products)
    matrix = np.concatenate([turned.real.reshape(len(turned), -1), turned.imag.reshape(len(turned), -1)], axis=1)
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True).clip(1e-300)
    _, singular, right = np.linalg.svd(matrix, full_matrices=False)
    space = right[singular > 1e-7 * singular[0]].reshape(-1, 2, *shape)
    real, imaginary = (MODES.amplitudes(space[:, part]) for part in (0, 1))
    power = np.sum(np.abs(real + 1j * imaginary) ** 2, axis=0) / 2
    norm = np.sum(MODES.weights**2 * (problem.weights > 0), axis=1)[:, None]
    return 1 - power / np.where(norm > 0, norm, np.nan)


def in_the_basis(toy, structure, seed=2):
    """Foregrounds with as much of every sequence, so that no gain comes close to what foregrounds can do."""
    rng = np.random.default_rng(seed)
    model = np.empty(toy.foregrounds.shape, complex)
    for bucket in structure.basis.buckets:
        for index in bucket.members:
            spectrum = bucket.vectors @ complex_normal(rng, (bucket.vectors.shape[1],))
            for p in np.flatnonzero(structure.groups == index):
                model[p] = spectrum.conj() if structure.conjugated[p] else spectrum
    return model


def case(kind):
    """A problem of one kind, with the gains and model of its solution."""
    toy = make_toy(HEX if kind == "redundant" else scattered(5), noise=0.0)
    structure = redundant_structure(toy) if kind == "redundant" else toy.structure
    flags = np.zeros(toy.foregrounds.shape, bool)
    gains = toy.gains
    if kind == "flags":
        flags[2, 10:14] = flags[4] = flags[:, 40] = True
    if kind.endswith("smooth gains"):
        vectors = gain_vectors(FREQUENCIES, 400e-9)
        structure = replace(structure, gain_vectors=vectors)
        gains = 1 + 0.3 * complex_normal(np.random.default_rng(1), (5, vectors.shape[1])) @ vectors.T
    model = in_the_basis(toy, structure)
    data = gain_products(gains, structure.antennas) * model
    return toy.problem(structure, visibilities=data, weights=flag_weights(flags)), gains, model


KINDS = ["any gains", "flags", "smooth gains", "redundant"]


@pytest.mark.chain
@pytest.mark.parametrize("kind", KINDS)
def test_exact_diagonal_is_that_of_the_projector_on_all_tangent_vectors(kind):
    problem, gains, model = case(kind)
    found = expected_transfer(problem, gains, model, MODES)
    brute = brute_force(problem, gains, model)
    # Smooth gains times foregrounds come close to other foregrounds: there the solver's damping matters a little.
    assert np.allclose(
        found.transfer, brute, rtol=0, atol=1e-2 if kind.endswith("smooth gains") else 5e-4, equal_nan=True
    )
    assert np.isnan(found.transfer).all(axis=1).sum() == (kind == "flags")
    assert np.nanmax(brute) - np.nanmin(brute) > 0.5
    total = found.transfer + found.foregrounds + found.gains
    assert np.nanmax(np.abs(total - 1)) < 1e-12
    assert not np.nan_to_num(found.error).any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.chain
def test_random_probes_agree_with_the_exact_diagonal_within_their_errors(kind):
    problem, gains, model = case(kind)
    exact = expected_transfer(problem, gains, model, MODES)
    probed = expected_transfer(problem, gains, model, MODES, probes=64)
    known = np.isfinite(exact.transfer)
    pull = ((probed.transfer - exact.transfer) / probed.error)[known]
    assert 0.8 < np.std(pull) < 1.25
    assert abs(np.mean(pull)) < 0.3
    assert np.mean(probed.error[known]) < 0.08


def prior_case(prior):
    """A hexagon with a finite prior whose deviation lies between noise and foregrounds, and the solution."""
    toy = make_toy(HEX, noise=0.0)
    structure = prior_structure(toy, prior)
    sky = turned(structure, toy.foregrounds)
    shape, rms = sky.shape, np.sqrt(np.mean(np.abs(sky) ** 2))
    flags = np.zeros(shape, bool)
    flags[2, 10:14] = flags[:, 40] = True
    deviations = (0.02 * rms, 0.1 * rms)
    problem = toy.problem(
        structure,
        visibilities=gain_products(toy.gains, structure.antennas) * sky,
        weights=np.where(flags, 0, (0.01 * rms) ** -2),
        sky_model=sky,
        deviations=deviations,
    )
    return problem, toy.gains, sky


def dense_residual_power(problem, gains, model):
    """<f|M^2|f> / <f|f> with M = W - W J (J^T W J)^-1 J^T W and W = (1 + C)^-1, the whitened covariance of all samples.

    With a Gaussian prior, the foregrounds are those of a Wiener filter, which leaves (1 + C)^-1 y.
    """
    structure, shape = problem.structure, model.shape
    n = shape[0] * shape[1]
    antennas, used = structure.antennas, problem.weights.ravel() > 0
    roots = np.sqrt(problem.weights) * np.abs(gain_products(gains, antennas))
    # Real and imaginary part of the sample of a turned baseline are those of the conjugate.
    sign = np.where(structure.conjugated, -1.0, 1.0)[:, None] * np.ones(shape)
    columns = []
    for unit in (1, 1j):
        for antenna in range(structure.n_antennas):
            for channel in range(shape[1]):
                change = np.zeros(gains.shape, complex)
                change[antenna, channel] = unit
                moved = roots * model * (change[antennas[:, 0]] + change[antennas[:, 1]].conj())
                columns.append(np.concatenate([moved.real.ravel(), (sign * moved.imag).ravel()]))
    jacobian = np.array(columns).T
    own, shared = problem.deviations
    covariance = dense_covariance(structure, own, shared)
    covariance *= np.outer(roots.ravel(), roots.ravel())
    both = np.zeros((2 * n, 2 * n))
    both[:n, :n] = both[n:, n:] = covariance
    whitened = np.linalg.inv(np.eye(2 * n) + both)
    image = whitened @ jacobian
    left = whitened - image @ np.linalg.pinv(jacobian.T @ image, rcond=1e-10, hermitian=True) @ image.T
    left[:, ~np.tile(used, 2)] = 0
    phases = MODES.amplitudes(np.eye(shape[1])).T
    found, norm = np.empty((shape[0], MODES.delay.size)), np.sum(MODES.weights**2 * used.reshape(shape), axis=1)
    for p in range(shape[0]):
        rows = slice(p * shape[1], (p + 1) * shape[1])
        # f* x = f* (Re x + i Im x), of what is left of white noise in all samples.
        real, imaginary = left[:n][rows], sign[p, 0] * left[n:][rows]
        response = phases @ real + 1j * (phases @ imaginary)
        found[p] = np.sum(np.abs(response) ** 2, axis=1) / 2 / norm[p]
    return found


@pytest.mark.chain
@pytest.mark.parametrize(
    "prior", [*(pytest.param(prior, marks=pytest.mark.slow) for prior in ("own", "shared")), "both"]
)
def test_a_finite_prior_leaves_what_the_dense_posterior_mean_leaves(prior):
    problem, gains, model = prior_case(prior)
    found = expected_transfer(problem, gains, model, MODES)
    dense = dense_residual_power(problem, gains, model)
    assert np.allclose(found.transfer, dense, rtol=0, atol=2e-4)
    assert np.max(dense) - np.min(dense) > 0.5
    inside = np.abs(MODES.delay) < 50e-9
    # Between keeping the delays of the foregrounds, as a complete sky model does, and giving them up.
    assert 0.01 < np.mean(dense[:, inside]) < 0.5
    probed = expected_transfer(problem, gains, model, MODES, probes=64)
    pull = (probed.transfer - found.transfer) / probed.error
    assert 0.8 < np.std(pull) < 1.25
    assert abs(np.mean(pull)) < 0.3


def test_far_from_the_foregrounds_gains_take_their_share_of_the_degrees_of_freedom():
    problem, gains, model = case("any gains")
    found = expected_transfer(problem, gains, model, MODES)
    n_antennas = len(gains)
    far = np.abs(MODES.delay) > 600e-9
    share = (2 * n_antennas - 1) / (n_antennas * (n_antennas - 1))
    assert np.mean(found.gains[:, far]) == pytest.approx(share, abs=0.02)


def test_injected_signals_are_left_as_expected():
    problem, gains, model = case("any gains")
    expected = expected_transfer(problem, gains, model, MODES).transfer
    rng, start = np.random.default_rng(8), WarmStart(gains, None)
    products = gain_products(gains, problem.structure.antennas)
    response, injected = np.zeros(expected.shape), np.zeros(expected.shape)
    for _ in range(40):
        signal = 1e-4 * complex_normal(rng, model.shape)
        measured = replace(problem, visibilities=products * (model + signal), prior="none", initial_gains=gains)
        solution = solve_warm(measured, GaussNewton(tolerance=1e-4), start)[0]
        left = measured.visibilities / gain_products(solution.gains, problem.structure.antennas) - solution.model
        response += np.abs(MODES.amplitudes(left)) ** 2
        injected += np.abs(MODES.amplitudes(signal)) ** 2
    for low, high in ((200e-9, 300e-9), (300e-9, 450e-9), (450e-9, 800e-9), (800e-9, 2e-6)):
        chosen = (np.abs(MODES.delay) >= low) & (np.abs(MODES.delay) < high)
        ratio = response[:, chosen].sum() / injected[:, chosen].sum()
        assert ratio == pytest.approx(np.mean(expected[:, chosen]), abs=0.03)


def test_linear_response_of_a_frozen_sky_has_the_baselines_that_gains_are_not_fitted_to():
    problem, gains, model = case("any gains")
    weights = problem.weights * (np.arange(len(model)) % 3 > 0)[:, None]
    problem = replace(problem, sky_model=model, frozen=True, weights=weights)
    signal = 1e-3 * complex_normal(np.random.default_rng(8), model.shape)
    left = linear_response(problem, gains, model, signal)
    data = gain_products(gains, problem.structure.antennas) * (model + signal)
    measured = replace(problem, visibilities=data, prior="none", initial_gains=gains)
    solution = solve_warm(measured, GaussNewton(tolerance=1e-6, max_steps=30), WarmStart(gains, None))[0]
    found = data / gain_products(solution.gains, problem.structure.antennas) - model
    for baselines in (np.ones(len(model), bool), weights.any(axis=1), ~weights.any(axis=1)):
        difference, size = found[baselines] - left[baselines], left[baselines]
        assert np.sqrt(np.mean(np.abs(difference) ** 2) / np.mean(np.abs(size) ** 2)) < 0.02
    # Gains add what they fit elsewhere to the baselines without weight.
    assert np.mean(np.abs(left[~weights.any(axis=1)]) ** 2) > np.mean(np.abs(signal) ** 2)


@pytest.mark.parametrize("kind", ["any gains", "redundant", "frozen"])
def test_linear_response_is_what_fits_of_data_with_a_signal_leave(kind):
    problem, gains, model = case("redundant" if kind == "redundant" else "any gains")
    if kind == "frozen":
        problem = replace(problem, sky_model=model, frozen=True)
    rng = np.random.default_rng(8)
    signal = 1e-3 * complex_normal(rng, model.shape)
    left = linear_response(problem, gains, model, signal)
    products = gain_products(gains, problem.structure.antennas)
    measured = replace(problem, visibilities=products * (model + signal), prior="none", initial_gains=gains)
    solution = solve_warm(measured, GaussNewton(tolerance=1e-6, max_steps=30), WarmStart(gains, None))[0]
    found = measured.visibilities / gain_products(solution.gains, problem.structure.antennas) - solution.model
    # Where foregrounds and gains are nearly degenerate a fit in single precision stops before its minimum, and terms of
    # second order are of the order of the signal, 1e-3.
    assert np.sqrt(np.mean(np.abs(found - left) ** 2) / np.mean(np.abs(left) ** 2)) < 0.02
    assert 0.1 < np.mean(np.abs(left) ** 2) / np.mean(np.abs(signal) ** 2) < 0.9
    # It is a projection where foregrounds are free, and leaves everything a second time, but for the solver's damping.
    again = linear_response(problem, gains, model, left)
    assert np.sqrt(np.mean(np.abs(again - left) ** 2) / np.mean(np.abs(left) ** 2)) < 0.02


def test_what_cannot_be_estimated_is_refused():
    problem, gains, model = case("any gains")
    with pytest.raises(ValueError, match="at least 2"):
        expected_transfer(problem, gains, model, MODES, probes=1)


def test_a_frozen_sky_leaves_the_foreground_delays():
    problem, gains, model = case("any gains")
    frozen = replace(problem, sky_model=model, frozen=True)
    found = expected_transfer(frozen, gains, model, MODES)
    assert not found.foregrounds.any()
    probed = expected_transfer(frozen, gains, model, MODES, probes=64)
    assert np.std((probed.transfer - found.transfer) / probed.error) < 1.25


@pytest.mark.parametrize("sigma", [0.0, 0.03, 0.1])
def test_gains_that_are_white_in_frequency_leak_the_signal_into_the_wedge(sigma):
    """The fit weights channels by |g_a g_b*|^2, whose relative variance is 8 sigma^2.

    The calibrated residual, without these weights, is therefore not orthogonal to the foreground sequences: what is
    left of the signal beyond them leaks in with that part of its power, uncorrelated with the signal that was there.
    """
    toy = make_toy(scattered(8), noise=0.0)
    kernels, inside = ReducedKernels(toy.structure), np.abs(MODES.delay) < 30e-9
    left, put_in, crossed = np.zeros(10), np.zeros(10), np.zeros(10)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        gains = 1 + sigma * np.sqrt(2) * complex_normal(rng, toy.gains.shape)
        signal = complex_normal(rng, toy.foregrounds.shape)
        problem = toy.problem(visibilities=gain_products(gains, toy.antennas) * signal, initial_gains=gains)
        reduced = kernels.reduce(problem, gains)
        model = kernels.tensors.unload(kernels.project(reduced.gains, *reduced.data).model, reduced.scale)
        residual, true = (MODES.amplitudes(values)[:, inside] for values in (signal - model, signal))
        left[seed], put_in[seed] = np.sum(np.abs(residual) ** 2), np.sum(np.abs(true) ** 2)
        crossed[seed] = np.sum((residual * true.conj()).real)
    sequences = np.mean([bucket.vectors.shape[1] for bucket in toy.basis.buckets for _ in bucket.members])
    beyond = 1 - sequences / FREQUENCIES.size
    # One draw of the gains scatters by 0.22 of it: ten are averaged, and three standard errors allowed.
    assert left.sum() / put_in.sum() == pytest.approx(8 * sigma**2 * beyond, rel=0.21, abs=1e-4)
    assert abs(crossed.sum() / put_in.sum()) < 0.01
