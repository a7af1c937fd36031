"""Solvers reach the same minimum, reproduce noiseless data, and say when they did not converge."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy import complex_normal, make_toy, scattered
from toy_structures import in_the_span, product_error, redundant_structure

from calstudy.base.tensorflow import tf
from calstudy.calibrate import calamity
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.degeneracy import fix_degeneracies, fix_phase, model_scale, sky_model_slope
from calstudy.calibrate.problem import CalibrationProblem, flag_weights, gain_products
from calstudy.calibrate.settings import BasisSettings, GainWeights, GaussNewtonSettings
from calstudy.calibrate.solvers import reduced
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import WarmStart, solve, solve_warm
from calstudy.calibrate.solvers.preconditioners import coupled_inverse
from calstudy.calibrate.solvers.reduced import compiled
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.array_layouts.geometric import GOLOMB_MARKS


@pytest.fixture(scope="module")
def converged(toy):
    problem = toy.problem()
    return problem, solve(problem, GaussNewton(tolerance=3e-4, max_steps=100))


def test_gauss_newton_converges(converged):
    _, solution = converged
    assert solution.record.status == "converged", solution.record.message
    assert (np.diff(solution.record.loss_history) <= 0).all()
    assert solution.record.steps == solution.record.loss_history.size - 1


@pytest.mark.chain
def test_adamax_descends_to_the_same_minimum(converged):
    problem, best = converged
    from_unity = solve(problem, Adamax(learning_rate=3e-3, max_steps=8000, precision="double"))
    lowest = best.record.loss_history[-1]
    assert 0.99 * lowest < from_unity.record.loss_history.min() < 1.2 * lowest
    slower = Adamax(learning_rate=1e-4, max_steps=3000, precision="double")
    onwards, _ = solve_warm(problem, slower, WarmStart(best.gains, None))
    assert onwards.record.loss_history.min() == pytest.approx(lowest, rel=0.02)


def test_noiseless_data_are_reproduced(quiet):
    antennas = quiet.antennas
    problem = quiet.problem(visibilities=gain_products(quiet.gains, antennas) * in_the_span(quiet))
    solution = solve(problem, GaussNewton(max_steps=500))
    # Far below any noise; the minimum is zero, which single precision does not reach.
    assert solution.record.usable
    assert product_error(problem, solution) < 1e-5


def test_solution_at_the_truth_is_exact(quiet):
    problem = quiet.problem(
        visibilities=gain_products(quiet.gains, quiet.antennas) * in_the_span(quiet), initial_gains=quiet.gains
    )
    assert product_error(problem, solve(problem, GaussNewton())) < 1e-10
    assert product_error(problem, solve(problem, Adamax(max_steps=1))) < 1e-5
    assert product_error(problem, solve(problem, Adamax(max_steps=1, precision="double"))) < 1e-10


@pytest.mark.parametrize(
    "solver",
    [GaussNewton(max_steps=1), Adamax(max_steps=1), Adamax(max_steps=70)],
    ids=lambda s: repr(s)[:20],
)
def test_not_converging_is_a_status_with_a_sentence(toy, solver):
    solution = solve(toy.problem(), solver)
    assert solution.record.status == "max-steps"
    assert "not converged" in solution.record.message
    assert solution.record.steps == solver.max_steps
    assert solution.record.usable


def test_divergence_is_reported_as_failure(toy):
    solution = solve(toy.problem(), Adamax(learning_rate=1e30, max_steps=100))
    assert solution.record.status == "failed"
    assert not solution.record.usable
    assert "not finite" in solution.record.message


@pytest.mark.chain
def test_best_parameters_are_kept(toy):
    problem = toy.problem(prior="none")
    solution = solve(problem, Adamax(learning_rate=0.3, max_steps=6, precision="double"))
    losses = solution.record.loss_history
    assert losses.min() < losses[-1]
    residual = problem.visibilities - gain_products(solution.gains, toy.antennas) * solution.model
    assert np.sum(problem.weights * np.abs(residual) ** 2) == pytest.approx(losses.min(), rel=1e-9)


def test_the_published_rule_stops_at_the_first_two_equal_losses(toy):
    # At this rate some steps change the loss by less than single precision resolves.
    problem, settings = toy.problem(), {"learning_rate": 1e-8, "max_steps": 100}
    fixed = solve(problem, Adamax(**settings, tolerance=0.0))
    published = solve(problem, Adamax(**settings, stop="published", keep="last"))
    # The loss before the first step does not count; one more step is made from the second of the equal losses.
    equal = 1 + np.flatnonzero(np.diff(fixed.record.loss_history[1:]) == 0)
    assert equal.size > 0
    assert published.record.steps == equal[0] + 2
    losses = published.record.loss_history
    np.testing.assert_array_equal(losses, fixed.record.loss_history[: losses.size])
    # Single precision happens to round two losses to the same value, far from the minimum.
    assert published.record.status == "stalled"
    assert "two consecutive losses" in published.record.message


def test_a_fixed_number_of_steps_is_neither_converged_nor_called_too_few(toy):
    solution = solve(toy.problem(), Adamax(max_steps=120, tolerance=0.0))
    assert (solution.record.status, solution.record.steps) == ("max-steps", 120)
    assert "fixed number" in solution.record.message
    assert solution.record.usable


def test_the_last_parameters_are_returned_where_asked_for(toy):
    problem = toy.problem(prior="none")
    solution = solve(problem, Adamax(learning_rate=0.3, max_steps=6, precision="double", keep="last"))
    assert solution.record.loss_history.min() < solution.record.loss_history[-1]
    residual = problem.visibilities - gain_products(solution.gains, toy.antennas) * solution.model
    assert np.sum(problem.weights * np.abs(residual) ** 2) == pytest.approx(solution.record.loss_history[-1], rel=1e-9)


def test_warm_start_needs_fewer_steps_for_the_same_minimum(toy):
    problem, solver = toy.problem(), GaussNewton()
    _, warm = solve_warm(problem, solver)
    other = make_toy(scattered(8), seed=2)
    moved = CalibrationProblem(
        problem.structure,
        problem.visibilities + 1e-3 * other.foregrounds,
        problem.weights,
        problem.initial_gains,
    )
    again = solve_warm(moved, solver, warm)[0]
    fresh = solve(moved, solver)
    assert again.record.status == fresh.record.status == "converged"
    assert again.record.steps < fresh.record.steps
    assert again.record.loss_history[-1] == pytest.approx(fresh.record.loss_history[-1], rel=2e-2)


@pytest.mark.parametrize("solver", [GaussNewton(), Adamax(max_steps=20)], ids=lambda s: type(s).__name__)
def test_flagged_samples_have_no_influence(toy, solver):
    rng = np.random.default_rng(11)
    flags = rng.random(toy.foregrounds.shape) < 0.1
    flags[:, 20] = True
    flags[3] = True
    flags[:, 40:46] = True
    flags[(toy.antennas == 5).any(1)] = True
    structure, weights = toy.structure, flag_weights(flags)
    spoiled = np.where(flags, rng.choice([np.nan, 1e9, -3j], flags.shape), toy.visibilities)
    problems = [toy.problem(structure, weights=weights, visibilities=data) for data in (toy.visibilities, spoiled)]
    assert np.array_equal(problems[0].visibilities, problems[1].visibilities)
    clean, dirty = (solve(problem, solver) for problem in problems)
    assert clean.record.usable
    assert clean.record.loss_history[-1] < 0.1 * clean.record.loss_history[0]
    # One flagged sample of 1e9 would change everything. Rounding, which need not be the same in both solves, moves what
    # is fitted by a few hundredths of the noise, along directions of next to no curvature.
    used = weights > 0
    fits = [(gain_products(found.gains, toy.antennas) * found.model)[used] for found in (clean, dirty)]
    noise = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    assert np.sqrt(np.mean(np.abs(fits[0] - fits[1]) ** 2)) < 0.1 * noise
    assert dirty.record.loss_history[-1] == pytest.approx(clean.record.loss_history[-1], rel=0.05)
    assert np.isfinite(dirty.gains).all()
    assert np.isfinite(dirty.model).all()


@pytest.mark.parametrize("solver", [GaussNewton(max_steps=300), Adamax(max_steps=3000)], ids=lambda s: type(s).__name__)
def test_redundant_models_are_recovered(hexagon, solver):
    per_baseline = hexagon.structure
    structure = redundant_structure(hexagon)
    foregrounds = in_the_span(hexagon)
    turned = (structure.antennas[:, 0] != per_baseline.antennas[:, 0])[:, None]
    foregrounds = np.where(turned, foregrounds.conj(), foregrounds)
    problem = hexagon.problem(structure, visibilities=gain_products(hexagon.gains, structure.antennas) * foregrounds)
    solution = solve(problem, solver)
    limit = 1e-5 if isinstance(solver, GaussNewton) else 3e-3
    assert product_error(problem, solution) < limit
    models = np.where(structure.conjugated[:, None], solution.model.conj(), solution.model)
    for group in range(structure.basis.n_models):
        members = models[structure.groups == group]
        assert np.allclose(members, members[0], rtol=1e-12, atol=0)


@given(
    scale=st.floats(0.1, 10),
    phase=st.lists(st.floats(-np.pi, np.pi), min_size=64, max_size=64),
    prior=st.sampled_from(["sum", "post-hoc"]),
)
@settings(max_examples=30, deadline=None)
def test_degeneracies_do_not_touch_data_and_are_always_fixed_alike(scale, phase, prior):
    toy = make_toy(scattered(4))
    problem = toy.problem(prior=prior)
    gains, model = fix_degeneracies(toy.gains, toy.foregrounds, problem)
    moved_gains = toy.gains / np.sqrt(scale) * np.exp(1j * np.array(phase))
    again_gains, again_model = fix_degeneracies(moved_gains, toy.foregrounds * scale, problem)
    products = gain_products(gains, toy.antennas)
    assert np.allclose(products * model, gain_products(toy.gains, toy.antennas) * toy.foregrounds, rtol=1e-12, atol=0)
    residual = toy.visibilities / products - model
    again = toy.visibilities / gain_products(again_gains, toy.antennas) - again_model
    assert np.abs(residual - again).max() < 1e-11 * np.abs(model).max()
    assert np.allclose(gains, again_gains, rtol=1e-11, atol=0)


def test_scale_and_band_shape_of_the_gains_are_those_that_were_put_in(quiet):
    """Gains too large by sqrt(1.2 b): the calibrated data are the sky over 1.2 b; a channel without data is unknown."""
    band = 1 + 0.1 * np.cos(np.linspace(0, 3, 64))
    problem = quiet.problem(sky_model=quiet.foregrounds)
    problem.weights[:, 7] = 0
    slope, shape = sky_model_slope(quiet.gains * np.sqrt(1.2 * band), problem)
    power = np.sum(problem.weights * np.abs(quiet.foregrounds) ** 2, axis=0)
    mean = np.sum(power / band) / np.sum(power)
    assert slope == pytest.approx(mean / 1.2, rel=1e-12)
    assert np.isnan(shape[7])
    np.testing.assert_allclose(np.delete(shape, 7), np.delete(1 / band / mean, 7), rtol=1e-12)


def test_a_sky_model_of_zero_has_no_slope_and_no_scale(quiet):
    problem = quiet.problem(sky_model=np.zeros_like(quiet.foregrounds), prior="sky-model")
    slope, shape = sky_model_slope(quiet.gains, problem)
    assert slope == 0
    assert np.isnan(shape).all()
    with pytest.raises(ValueError, match="not correlated with the sky model"):
        fix_degeneracies(quiet.gains, quiet.foregrounds, problem)


@pytest.mark.chain
def test_errors_of_the_models_do_not_average_out_of_their_sum():
    """The scale by the paper's prior scatters with the gains, far more than by a regression on the same sky model.

    The sum of the visibilities is small beside that of their moduli, and the errors of a model are smooth. With six
    draws of gains the scatters are 0.027 and 0.0014 here; their ratio is uncertain by a factor of two.
    """
    toy, scales = make_toy(3 * scattered(10)), []
    for seed in range(6):
        gains = 1 + 0.1 * complex_normal(np.random.default_rng(seed), toy.gains.shape)
        problem = replace(toy, gains=gains).problem(sky_model=toy.foregrounds, prior="none")
        solution = solve(problem, GaussNewton())
        true, fitted = (gain_products(values, toy.antennas) for values in (gains, solution.gains))
        unknown = np.vdot(true, fitted).real / np.vdot(true, true).real
        priors = (replace(problem, prior=prior) for prior in ("sum", "sky-model"))
        scales.append([model_scale(solution.gains, solution.model, prior) / unknown for prior in priors])
    by_sum, by_regression = np.std(scales, axis=0)
    assert by_sum > 4 * by_regression


def test_residual_does_not_know_where_the_solver_drifted(converged):
    """Gains of the solver before fixing, moved along the nulls, give the same loss."""
    problem, solution = converged
    drifted = solution.gains * 1.3 * np.exp(2j * np.linspace(0, 1, 64))
    moved = CalibrationProblem(problem.structure, problem.visibilities, problem.weights, drifted, prior="none")
    again = solve(moved, GaussNewton(max_steps=1))
    assert again.record.loss_history[0] == pytest.approx(solution.record.loss_history[-1], rel=1e-9)


def test_fixed_gains_have_the_phase_of_the_reference(toy):
    fixed = fix_phase(toy.gains * np.exp(1j * np.linspace(0, 9, 64)), np.ones_like(toy.gains))
    assert np.abs(fixed.sum(0).imag).max() < 1e-12
    assert fixed.sum(0).real.min() > 0


def test_sum_prior_is_at_its_minimum(converged):
    problem, solution = converged

    def prior(scale):
        return abs(scale * np.sum(problem.weights * solution.model) - problem.prior_target) ** 2

    assert prior(1) <= min(prior(0.999), prior(1.001))
    opposite = CalibrationProblem(
        problem.structure, problem.visibilities, problem.weights, problem.initial_gains, -solution.model
    )
    assert solve(opposite, GaussNewton(max_steps=3)).record.status == "failed"


def test_structures_are_compiled_once_for_the_same_content(toy):
    same, other = toy.structure, make_toy(scattered(8, seed=4)).structure
    assert same == toy.structure
    assert hash(same) == hash(toy.structure)
    assert same != other
    assert compiled(same) is compiled(toy.structure)
    assert compiled(same, False) is compiled(toy.structure)


def test_adamax_is_compiled_once_for_all_learning_rates(toy):
    slow, fast = (Adamax(learning_rate=rate).init(toy.problem()).kernels for rate in (1e-3, 1e-2))
    assert slow is fast


def test_bad_problems_are_refused_in_one_sentence(toy):
    with pytest.raises(ValueError, match="weights"):
        toy.problem(weights=-np.ones(toy.foregrounds.shape))
    with pytest.raises(ValueError, match="visibilities: not finite"):
        toy.problem(visibilities=np.full(toy.foregrounds.shape, np.nan))
    with pytest.raises(ValueError, match="nothing to calibrate"):
        toy.problem(weights=np.zeros(toy.foregrounds.shape))
    with pytest.raises(ValueError, match="initial_gains"):
        toy.problem(initial_gains=np.zeros(toy.gains.shape))


@pytest.mark.parametrize(
    ("gained", "predicted", "converged"),
    [
        (math.inf, 9e-4, True),
        (math.inf, 1.1e-3, False),
        (1e-1, 9e-4, True),
        (2e-3, 9e-4, False),
        (2e-3, 5e-4, True),
        (9e-4, 9.5e-4, True),
        (1e-1, 2e-3, False),
    ],
)
def test_a_plateau_is_not_taken_for_the_minimum(toy, gained, predicted, converged):
    """A geometric series from the last step to the next must end within the tolerance, unless both are below it."""
    solver = GaussNewton(tolerance=1e-3)
    state = replace(solver.init(toy.problem()), history=(2.0, 1.0), gained=gained, predicted=predicted)
    verdict = solver.terminate(state)
    assert (verdict is not None and verdict.status == "converged") == converged


@pytest.mark.chain
def test_double_precision_goes_on_where_single_precision_stops(quiet):
    """Exact data: the only minimum is zero."""
    problem = quiet.problem(visibilities=gain_products(quiet.gains, quiet.antennas) * in_the_span(quiet))
    single = solve(problem, GaussNewton(max_steps=500))
    double = solve(problem, GaussNewton(max_steps=500, precision="double"))
    assert single.record.status == "stalled", single.record.message
    assert double.record.status == "converged", double.record.message
    assert double.record.loss_history[-1] < 0.1 * single.record.loss_history[-1]
    # What single precision leaves is 1e-6 of the data and more.
    assert product_error(problem, double) < 2e-9


def test_double_precision_says_that_it_has_not_converged(quiet):
    """Little noise and few steps: the loss can still fall, and the status says so."""
    rng = np.random.default_rng(4)
    rms = np.sqrt(np.mean(np.abs(quiet.foregrounds) ** 2))
    noisy = quiet.foregrounds + 1e-6 * rms * complex_normal(rng, quiet.foregrounds.shape)
    problem = quiet.problem(visibilities=gain_products(quiet.gains, quiet.antennas) * noisy)
    few = solve(problem, GaussNewton(max_steps=12, precision="double"))
    more = solve(problem, GaussNewton(max_steps=40, precision="double"))
    assert more.record.loss_history[-1] < 0.9 * few.record.loss_history[-1]
    assert few.record.status == "max-steps"


def golomb(**case):
    """An array without redundancy, and the structure of its fit."""
    marks = np.array(GOLOMB_MARKS[9])
    full = Case(antennas=9, channels=64, first=150e6, band=64 * 300e3, **case)
    simulation = Simulation(full, 3.0 * np.column_stack([marks, 0 * marks, 0 * marks]))
    return simulation, simulation.structure(BasisSettings(delay_step="100 ns"))


@pytest.mark.parametrize("noise", [1e-4, 1e-6])
@pytest.mark.chain
def test_single_precision_says_where_it_does_not_reach(noise):
    """An array without redundancy and little noise: `converged` would be a tenth and more above the minimum."""
    simulation, structure = golomb(noise=noise)
    problem = simulation.problem(0, structure)
    single = solve(problem, GaussNewton())
    further = solve(problem, GaussNewton(precision="double", max_steps=60))
    assert single.record.status == "stalled"
    assert "precision: double" in single.record.message
    fall = 1 - further.record.loss_history[-1] / single.record.loss_history[-1]
    # What is predicted is what steps would bring at first; it is a lower limit.
    assert 0.01 < single.record.newton_decrement < fall


@pytest.mark.chain
def test_a_solve_from_which_another_starts_is_not_checked():
    """The check says what a fit cannot reach. It does not change where the iteration ends."""
    simulation, structure = golomb(noise=1e-6)
    problem = simulation.problem(0, structure)
    checked, last, repeated = (
        solve_warm(problem, GaussNewton(), None, asked)[0] for asked in (None, lambda gains: False, lambda gains: True)
    )
    assert checked.record.status == last.record.status == "stalled"
    assert repeated.record.status == "converged"
    for other in (last, repeated):
        np.testing.assert_allclose(other.gains, checked.gains, rtol=1e-6)


@pytest.mark.chain
@pytest.mark.parametrize("passes", [2, 10])
def test_the_last_pass_of_weights_is_checked(passes):
    """Passes with weights of own gains end with the status of a fit with these weights, settled or not."""
    simulation, structure = golomb(noise=1e-6)
    settings = Calamity(weights=GainWeights(passes=passes), solver=GaussNewtonSettings())
    found = calamity._Passes(settings, GaussNewton(), (0, 0)).solve(simulation.problem(0, structure), None, None)
    assert found.solution.record.diagnostics["passes"] > 1
    assert found.solution.record.status == "stalled", found.solution.record.message


@pytest.mark.chain
def test_warm_starts_say_what_cold_ones_say():
    """One step from the solution before is enough for the loss, but not for the directions that damping hides."""
    simulation, structure = golomb(noise=1e-5, eor=1e-4)
    first, warm = solve_warm(simulation.problem(0, structure), GaussNewton())
    problem = simulation.problem(1, structure)
    found, cold = solve_warm(problem, GaussNewton(), warm)[0], solve(problem, GaussNewton())
    assert first.record.status == cold.record.status == found.record.status == "stalled"
    # Different points of the same valley: twice leaves room. Too few conjugate gradients would say a tenth of it.
    assert 0.5 < found.record.newton_decrement / cold.record.newton_decrement < 2


def test_integrations_that_all_stall_are_not_all_solved_twice(monkeypatch):
    """A solve from unity after the first that stalled shows that there is nothing to be gained by another."""
    simulation, structure = golomb(noise=1e-5, eor=1e-4)
    starts = []

    def counted(problem, solver, warm=None, repeated=None):
        starts.append(warm)
        return solve_warm(problem, solver, warm, repeated)

    monkeypatch.setattr(calamity, "solve_warm", counted)
    warm, anew = None, True
    for integration in range(3):
        problem = simulation.problem(integration, structure)
        solution, warm, anew = calamity._solve(problem, GaussNewton(), warm, anew)
        assert solution.record.status == "stalled"
    # The first integration, and the second once more.
    assert sum(start is None for start in starts) == 2


def jacobian(problem, gains):
    """Residual of the best foregrounds, and its derivative in real and imaginary parts of eta, by QR; real arrays."""
    structure, (n_antennas, n_frequencies) = problem.structure, gains.shape
    residual = np.empty(problem.visibilities.shape, complex)
    derivative = np.zeros((*residual.shape, 2, n_antennas, n_frequencies), complex)
    for bucket in structure.basis.buckets:
        for p in bucket.members:
            a, b = structure.antennas[p]
            product = gains[a] * gains[b].conj()
            orthonormal, _ = np.linalg.qr(product[:, None] * bucket.vectors)
            absorb = orthonormal @ orthonormal.conj().T
            residual[p] = problem.visibilities[p] - absorb @ problem.visibilities[p]
            change = np.diag(problem.visibilities[p] - residual[p])
            change = change - absorb @ change
            derivative[p, :, :, a] += np.stack([change, 1j * change], axis=1)
            derivative[p, :, :, b] += np.stack([change, -1j * change], axis=1)
    flat = derivative.reshape(residual.size, -1)
    return np.concatenate([residual.real, residual.imag], None), np.concatenate([flat.real, flat.imag])


@pytest.mark.chain
def test_derivatives_of_gains_that_foregrounds_can_follow_are_not_rounding():
    """Where singular values are tiny, the rounding of the residual has a larger part that foregrounds absorb."""
    small = make_toy(scattered(6), noise=0.0)
    problem = small.problem(visibilities=gain_products(small.gains, small.antennas) * in_the_span(small))
    gains = solve(problem, GaussNewton(max_steps=40, precision="double")).gains
    kernels = compiled(problem.structure, False, tf.float64, thorough=True)
    reduced = kernels.reduce(problem, gains)
    found = np.ravel(kernels.project(reduced.gains, *reduced.data).descent)
    residual, derivative = jacobian(problem, gains)
    _, singular, directions = np.linalg.svd(derivative, full_matrices=False)
    # The unit of the loss, and an order of real and imaginary parts that is the same.
    expected = derivative.T @ residual * problem.weights.flat[0] / reduced.loss_unit
    tiny = (singular < 1e-7 * singular[0]) & (singular > 3e-9 * singular[0])
    assert tiny.sum() > 5
    error, value = directions[tiny] @ (found - expected), directions[tiny] @ expected
    assert np.linalg.norm(error) < 1e-3 * np.linalg.norm(value)


@pytest.mark.chain
def test_warm_starts_in_double_precision_go_on_as_far_as_cold_ones():
    """With little noise both go on in double precision, with geodesic acceleration."""
    small, rng = make_toy(scattered(6), noise=0.0), np.random.default_rng(3)
    rms = np.sqrt(np.mean(np.abs(small.foregrounds) ** 2))
    problems = []
    for _ in range(2):
        sky = in_the_span(small) + 1e-6 * rms * complex_normal(rng, small.foregrounds.shape)
        problems.append(small.problem(visibilities=gain_products(small.gains, small.antennas) * sky))
    solver = GaussNewton(max_steps=60, precision="double")
    _, warm = solve_warm(problems[0], solver)
    found, cold = solve_warm(problems[1], solver, warm)[0], solve(problems[1], solver)
    assert found.record.loss_history[-1] < 1.05 * cold.record.loss_history[-1]


def test_what_double_precision_leaves_is_not_said_to_be_nothing():
    """Between the rounding of single precision and its own, the decrement is that of double precision."""
    small = make_toy(scattered(6), noise=0.0)
    problem = small.problem(visibilities=gain_products(small.gains, small.antennas) * in_the_span(small))
    found = solve(problem, GaussNewton(max_steps=30, precision="double"))
    assert found.record.status == "max-steps"
    assert found.record.newton_decrement > 1e-3
    assert found.record.decrement_rms > 0


@pytest.mark.chain
def test_a_spoiled_preconditioner_is_not_taken_for_the_minimum(monkeypatch):
    """Blocks that rounding has left indefinite promise nothing in a check of convergence."""
    small = make_toy(scattered(6), noise=1e-5)
    calls = []

    def spoiled(blocks, ends, damping):
        calls.append(damping)
        inverse = coupled_inverse(blocks, ends, damping)
        return inverse._replace(factor=inverse.factor * math.nan) if len(calls) == 1 else inverse

    monkeypatch.setattr(reduced, "coupled_inverse", spoiled)
    problem, solver = small.problem(), GaussNewton(max_steps=40, precision="double")
    found = solve(problem, solver)
    monkeypatch.undo()
    assert len(calls) > 1
    assert found.record.loss_history[-1] < 1.5 * solve(problem, solver).record.loss_history[-1]
