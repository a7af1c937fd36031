"""Both solvers, smooth gains, frozen skies and solves of several integrations reach the minima they must."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, complex_normal, make_toy, scattered
from toy_structures import in_the_span, product_error

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.basis import dpss_vectors, gain_vectors
from calstudy.calibrate.problem import flag_weights, gain_products, repeat_structure
from calstudy.calibrate.projection import Projector
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve, solve_warm
from calstudy.calibrate.tensors import FitTensors, GainSpace


@pytest.mark.chain
def test_solvers_meet_where_no_direction_is_flat():
    """Foregrounds with as much of every sequence keep gains and foregrounds apart: there is but one minimum."""
    toy = make_toy(scattered(8))
    foregrounds = np.empty_like(toy.foregrounds)
    rng = np.random.default_rng(3)
    for bucket in toy.basis.buckets:
        shape = (bucket.members.size, bucket.vectors.shape[1])
        foregrounds[bucket.members] = complex_normal(rng, shape) @ bucket.vectors.T
    noise = 1e-3 * np.sqrt(np.mean(np.abs(foregrounds) ** 2)) * complex_normal(rng, foregrounds.shape)
    flat = replace(toy, foregrounds=foregrounds, noise=noise)
    problem = flat.problem(prior="none")
    best, other = solve(problem, GaussNewton(tolerance=1e-5)), descended(problem, 2000)
    assert other.record.loss_history.min() == pytest.approx(best.record.loss_history.min(), rel=2e-4)


def descended(problem, steps, precision="double"):
    """Adamax at falling rates, each from where the one before ended: at a constant one it jitters."""
    warm = None
    for rate in (2e-2, 2e-3, 2e-4):
        solver = Adamax(learning_rate=rate, max_steps=steps, tolerance=0.0, precision=precision)
        solution, warm = solve_warm(problem, solver, warm)
    return solution


def smooth_toy(delay=400e-9):
    """Gains in the span of sequences up to a delay."""
    toy = make_toy(scattered(8))
    vectors = gain_vectors(FREQUENCIES, delay)
    rng = np.random.default_rng(21)
    gains = 1 + 0.3 * complex_normal(rng, (8, vectors.shape[1])) @ vectors.T
    return replace(toy, gains=gains), vectors


def test_coordinates_of_smooth_gains_are_adjoint():
    toy, vectors = smooth_toy()
    space, gains = GainSpace(vectors, tf.float64), pairs.to_pair(toy.gains, tf.float64)
    rng = np.random.default_rng(22)
    c = pairs.to_pair(complex_normal(rng, (8, vectors.shape[1])), tf.float64)
    y = pairs.to_pair(complex_normal(rng, toy.gains.shape), tf.float64)
    left = float(pairs.inner_product(space.expand_relative(c, gains), y))
    assert left == pytest.approx(float(pairs.inner_product(c, space.reduce_relative(y, gains))), rel=1e-12)
    change = pairs.to_complex(space.expand_relative(c, gains)) * toy.gains
    assert np.abs(change - pairs.to_complex(c) @ vectors.T).max() < 1e-12


@pytest.mark.parametrize("solver", ["gauss-newton", "adamax"])
@pytest.mark.chain
def test_smooth_gains_stay_smooth_and_fit_as_well(solver):
    toy, vectors = smooth_toy()
    problem = toy.problem(replace(toy.structure, gain_vectors=vectors), prior="none")
    adamax = solver == "adamax"
    solution = descended(problem, 2500, "single") if adamax else solve(problem, GaussNewton(tolerance=1e-4))
    outside = solution.gains - solution.gains @ vectors @ vectors.T
    assert np.abs(outside).max() < 1e-5
    used = solve(toy.problem(), GaussNewton()).record.loss_history[-1]
    noise = np.sum(problem.weights * np.abs(gain_products(toy.gains, toy.antennas) * toy.noise) ** 2)
    assert used < solution.record.loss_history.min() < 1.1 * noise


def test_a_frozen_sky_gives_the_true_gains(quiet):
    sky = in_the_span(quiet)
    data = gain_products(quiet.gains, quiet.antennas) * sky
    problem = quiet.problem(visibilities=data, sky_model=sky, frozen=True)
    for solution, limit in ((solve(problem, GaussNewton()), 1e-5), (descended(problem, 1000), 1e-3)):
        assert product_error(problem, solution) < limit
        assert np.abs(solution.model - sky).max() < 1e-12 * np.abs(sky).max()
        turned = solution.gains * np.exp(-1j * np.angle(np.sum(solution.gains * quiet.gains.conj(), axis=0)))
        assert np.abs(turned - quiet.gains).max() < 10 * limit


def test_a_frozen_problem_needs_a_sky(toy):
    with pytest.raises(ValueError, match="sky_model: is needed"):
        toy.problem(frozen=True)


def joint_problem(toys):
    """Integrations of the same gains under different skies, stacked."""
    first = toys[0]
    structure = repeat_structure(first.structure, len(toys))
    data = np.concatenate([gain_products(first.gains, toy.antennas) * (toy.foregrounds + toy.noise) for toy in toys])
    return first.problem(structure, visibilities=data, weights=flag_weights(np.zeros(data.shape, bool)))


def test_joint_solves_share_gains_and_lose_less_of_the_noise():
    positions = scattered(8)
    toys = [make_toy(positions, seed=seed) for seed in (1, 2, 3)]
    toys = [replace(toy, gains=toys[0].gains) for toy in toys]
    solution = solve(joint_problem(toys), GaussNewton())
    assert solution.record.status == "converged", solution.record.message
    assert solution.gains.shape == toys[0].gains.shape
    products = np.tile(gain_products(solution.gains, toys[0].antennas), (3, 1))
    true = np.tile(gain_products(toys[0].gains, toys[0].antennas), (3, 1))
    data = true * np.concatenate([toy.foregrounds + toy.noise for toy in toys])
    joint = np.mean(np.abs(data - products * solution.model) ** 2)
    alone = []
    for toy in toys:
        problem = toy.problem()
        one = solve(problem, GaussNewton())
        alone.append(np.mean(np.abs(problem.visibilities - gain_products(one.gains, toy.antennas) * one.model) ** 2))
    assert joint > 1.2 * np.mean(alone)


def test_pieces_of_any_size_give_the_same_projection():
    # Ten baselines: each piece is a part of the graph that has to be compiled.
    toy = make_toy(scattered(5))
    structure = toy.structure
    gains = pairs.to_pair(toy.gains, tf.float64)
    eta = pairs.to_pair(toy.gains - 1, tf.float32)
    results, images = [], []
    for piece in (1, 3, 1024):
        tensors = FitTensors(replace(structure, models_at_once=piece))
        data = tensors.load(toy.problem(), tf.float64)
        projector = Projector(structure, tensors)
        results.append(projector.project(gains, data.visibilities, data.weights))
        images.append(projector.hessian_product(eta, results[-1]))
    assert len(results[0].parts[0].roots) > len(results[2].parts[0].roots)
    for image in images[:2]:
        assert np.abs(image - images[2]).max() < 1e-5 * np.abs(images[2]).max()
    for other in results[:2]:
        # The pieces are matrices of other shapes, which a processor may add up in another order. Loss and descent come
        # from residuals a thousand times smaller than the data, where the rounding of 1e-16 is that much larger.
        assert float(other.loss) == pytest.approx(float(results[2].loss), rel=1e-9)
        (one,), (whole,) = other.model, results[2].model
        assert np.abs(one - whole).max() < 1e-9 * np.abs(whole).max()
        assert np.abs(other.descent - results[2].descent).max() < 1e-9 * np.abs(results[2].descent).max()


@pytest.mark.chain
def test_gaps_in_frequency_are_flagged_channels(toy):
    from toy import BASIS

    from calstudy.calibrate.basis import make_basis
    from calstudy.calibrate.problem import FitStructure

    present = np.ones(64, bool)
    present[[10, 11, 30, 31, 32, 33, 50]] = False
    lengths = np.linalg.norm(toy.vectors, axis=1)
    gappy = FitStructure.per_baseline(toy.antennas, 8, make_basis(lengths, FREQUENCIES[present], BASIS))
    flags = np.broadcast_to(~present, toy.foregrounds.shape)
    whole = solve(toy.problem(weights=flag_weights(flags)), GaussNewton(tolerance=1e-4))
    problem = toy.problem(
        gappy,
        visibilities=toy.visibilities[:, present],
        weights=flag_weights(flags)[:, present],
        initial_gains=np.ones((8, present.sum()), complex),
    )
    part = solve(problem, GaussNewton(tolerance=1e-4))
    assert part.record.status == whole.record.status == "converged", (part.record.message, whole.record.message)
    # Sixty steps that bring 1e-4 each end at losses that differ by up to 1e-3, as rounding decides.
    assert part.record.loss_history[-1] == pytest.approx(whole.record.loss_history[-1], rel=1e-2)
    product = gain_products(part.gains, toy.antennas) * part.model
    expected = (gain_products(whole.gains, toy.antennas) * whole.model)[:, present]
    # A tenth of the noise, which is 1e-3 of the foregrounds.
    assert np.linalg.norm(product - expected) < 1e-4 * np.linalg.norm(expected)


def test_gains_prior_keeps_the_size_of_the_first_gains(toy):
    start = 1.7 * np.ones(toy.gains.shape, complex)
    solution = solve(toy.problem(prior="gains", initial_gains=start), GaussNewton())
    assert np.exp(np.mean(np.log(np.abs(solution.gains)))) == pytest.approx(1.7, rel=1e-9)


def test_wide_delays_leave_gains_free():
    assert gain_vectors(FREQUENCIES, 2e-6).shape == (64, 64)
    assert gain_vectors(FREQUENCIES, 200e-9).shape[1] < 40
    assert dpss_vectors(64, 64 * 400e3 * 200e-9).shape[0] == 64


def test_a_partly_flagged_baseline_does_not_slow_the_default_solver(toy):
    """Channels flagged at the edge of the band leave foregrounds undetermined there.

    The default number of steps is enough. How many of them it takes is decided by rounding along directions of next to
    no curvature, where each step brings little: 21 on one processor, 33 on another, both at the same minimum.
    """
    flags = np.zeros(toy.foregrounds.shape, bool)
    flags[5, :7] = True
    flags[11, 50:] = True
    problem = toy.problem(weights=flag_weights(flags))
    solution = solve(problem, GaussNewton())
    assert solution.record.status == "converged", solution.record.message
    assert solution.record.newton_decrement < GaussNewton().tolerance
    products = gain_products(toy.gains, toy.antennas)
    assert solution.record.loss_history[-1] < np.sum(problem.weights * np.abs(products * toy.noise) ** 2)
    # All that many more steps bring is the 5 % of the noise that such directions hold.
    patient = solve(problem, GaussNewton(tolerance=1e-4, max_steps=500))
    assert patient.record.status == "converged", patient.record.message
    assert solution.record.loss_history[-1] < 1.05 * patient.record.loss_history[-1]
