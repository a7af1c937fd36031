"""How far from the minimum a solver says that it stopped is the bias that it leaves in the cross power."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, complex_normal, make_toy, scattered

from calstudy.calibrate.agreement import Baselines, Realization, cross_power, ratio_over_antennas
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve, solve_warm, trace
from calstudy.calibrate.solvers.reduced import newton_decrement_at
from calstudy.calibrate.synthetic import Case, Simulation


@pytest.fixture(scope="module")
def pair():
    """Two noise realizations of ten antennas."""
    even = make_toy(scattered(10), noise=1e-3)
    rms = np.sqrt(np.mean(np.abs(even.noise) ** 2))
    return even, replace(even, noise=rms * complex_normal(np.random.default_rng(77), even.noise.shape))


@pytest.fixture(scope="module")
def baselines(pair):
    lengths = np.linalg.norm(pair[0].vectors, axis=1)
    return Baselines(pair[0].antennas, lengths, FREQUENCIES, buffer=150e-9)


def bias_of(pair, baselines, estimates):
    """Cross power of what is left in both over the power of white visibilities of 1 Jy, and its error."""
    left = []
    for toy, (gains, model) in zip(pair, estimates, strict=True):
        realization = Realization(toy.visibilities, toy.noise, gain_products(toy.gains, toy.antennas))
        left.append(realization.residual_without_noise(gain_products(gains, toy.antennas), model))
    unit = np.full(left[0].shape, 1.0 + 0j) * np.exp(2j * np.pi * np.random.default_rng(5).random(left[0].shape))
    return ratio_over_antennas(cross_power(*left, baselines), cross_power(unit, unit, baselines), baselines.antennas)


@pytest.mark.parametrize(
    ("solver", "steps"),
    [
        (GaussNewton(tolerance=0.02), (1, 2, 3, 4)),
        (Adamax(max_steps=1000, tolerance=0.0), (100, 300, 1000)),
    ],
    ids=["gauss-newton", "adamax"],
)
@pytest.mark.chain
def test_the_distance_from_the_minimum_is_the_bias(pair, baselines, solver, steps):
    paths = [trace(toy.problem(), solver, steps) for toy in pair]
    noise = np.mean(np.abs(pair[0].noise) ** 2)
    for even, odd in zip(*paths, strict=False):
        if even.n_steps not in steps:
            continue
        predicted = even.decrement_rms * odd.decrement_rms
        bias, error = bias_of(pair, baselines, [(even.gains, even.model), (odd.gains, odd.model)])
        # Not all that is left lies beyond the wedge, or is the same in both.
        assert bias - 3 * error < predicted
        if predicted > noise:
            assert bias > 0.1 * predicted
    assert [point.n_steps for point in paths[0]][: len(steps)] == list(steps)


def test_what_is_left_is_orthogonal_to_the_minimum(pair):
    """The power that the residual still holds is the loss that is still to go, to first order."""
    problem = pair[0].problem()
    early, late = trace(problem, GaussNewton(tolerance=1e-3), (4,))[0], solve(problem, GaussNewton(tolerance=1e-3))
    antennas = problem.structure.antennas
    before, after = (
        problem.visibilities - gain_products(found.gains, antennas) * found.model for found in (early, late)
    )
    going, power = (np.sum(problem.weights * np.abs(part) ** 2) for part in (before - after, before))
    fallen = 1 - late.record.loss_history[-1] / (power)
    assert going / power == pytest.approx(fallen, rel=0.25)
    assert early.newton_decrement == pytest.approx(fallen, rel=0.5)


@pytest.mark.chain
def test_every_solver_tells_how_far_it_is(pair):
    problem = pair[0].problem()
    for solver in (GaussNewton(), Adamax(max_steps=300)):
        solution = solve(problem, solver)
        # Gauss-Newton judges with the blocks of an earlier step, whose prediction is a little off.
        decrement = min(newton_decrement_at(problem, solution.gains), 1)
        assert solution.record.newton_decrement == pytest.approx(decrement, rel=0.1)
        residual = problem.visibilities / gain_products(solution.gains, pair[0].antennas) - solution.model
        rms = np.sqrt(solution.record.newton_decrement * np.mean(np.abs(residual) ** 2))
        assert solution.record.decrement_rms == pytest.approx(rms, rel=0.2)
        if solution.record.status == "converged":
            assert solution.record.newton_decrement < solver.tolerance


def test_a_loss_that_stands_still_short_of_the_minimum_has_not_converged(pair):
    solution = solve(pair[0].problem(), Adamax(learning_rate=0.1, max_steps=3000, tolerance=1e-6))
    assert solution.record.steps < 3000
    assert solution.record.status == "stalled"
    assert "a Gauss-Newton step would lower it" in solution.record.message


def drifting_bias(case, solver, integrations, warm_start):
    """Bias of even times odd over the noise power, all integrations together, and its error."""
    simulation = Simulation(case)
    structure = simulation.structure()
    first, second = simulation.antennas.T
    lengths = np.linalg.norm(simulation.positions[second] - simulation.positions[first], axis=1)
    baselines = Baselines(simulation.antennas, lengths, case.frequencies, buffer=100e-9)
    products = gain_products(simulation.gains, simulation.antennas)
    starts, power, reference = [None, None], 0.0, 0.0
    for integration in range(integrations):
        foregrounds = simulation.foregrounds(integration)
        left, noises = [], []
        for realization in (0, 1):
            problem = simulation.problem(integration, structure, realization)
            noises.append(problem.visibilities / products - foregrounds)
            solution, start = solve_warm(problem, solver, starts[realization])
            assert solution.record.status == "converged"
            starts[realization] = start if warm_start else None
            truth = Realization(problem.visibilities, noises[-1], products)
            fitted = gain_products(solution.gains, simulation.antennas)
            left.append(truth.residual_without_noise(fitted, solution.model))
        power = power + cross_power(*left, baselines)
        reference = reference + cross_power(noises[0], noises[0], baselines)
    return ratio_over_antennas(power, reference, simulation.antennas)


@pytest.mark.chain
@pytest.mark.parametrize("warm_start", [False, True], ids=["cold", "warm"])
def test_solutions_leave_nothing_in_common_wherever_they_start(warm_start):
    """Each integration from unity, or from the one before."""
    case = Case(antennas=12, channels=96, extent=60.0, noise=1e-3)
    bias, error = drifting_bias(case, GaussNewton(), 6, warm_start)
    assert abs(bias) < 3 * error + 1e-3
    assert error < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize(("warm_start", "integrations"), [(False, 3), (True, 16)], ids=["cold", "warm"])
def test_solutions_leave_nothing_in_common_at_the_scale_of_the_paper(warm_start, integrations):
    """An EoR of a tenth of the noise has a hundredth of its power."""
    bias, error = drifting_bias(Case(), GaussNewton(), integrations, warm_start)
    assert abs(100 * bias) < 3 * 100 * error + 0.01
    assert 100 * error < 0.05
