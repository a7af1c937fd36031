"""The deviation of the foregrounds' prior that a fit finds itself, against dense likelihoods and known sky models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.linalg import solve_triangular
from toy import HEX, complex_normal, make_toy, scattered
from toy_data import make_uvdata
from toy_structures import dense_covariance, free_structure, prior_structure, turned

from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube
from calstudy.calibrate import calamity
from calstudy.calibrate.calibrators.least_squares import DelayWeighted, SkyBased
from calstudy.calibrate.deviation import estimate
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.preparation import prepare, problem_at
from calstudy.calibrate.problem import CalibrationProblem, gain_products
from calstudy.calibrate.settings import START_DEVIATION, ForegroundPrior
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve

NOISE = 1e-3
"""Standard deviation of the noise over the rms of the foregrounds."""
ESTIMATED = DelayWeighted(foreground_prior={"deviation": "estimated"})


def errors_of_sky(structure, own, shared, seed):
    """Errors of a sky model with the covariance of the prior, (Nbls, Nfreqs)."""
    rng, found = np.random.default_rng(seed), np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    for bucket in structure.basis.buckets:
        for index in bucket.members:
            members = np.flatnonzero(structure.groups == index)
            drawn = complex_normal(rng, (members.size + 1, bucket.vectors.shape[1])) @ bucket.vectors.T
            found[members] = own * drawn[1:] + shared * drawn[0]
    return turned(structure, found)


def measured(positions, prior, deviations, seed, level=NOISE):
    """Data of a toy with inverse variances for weights, and a sky model with errors of some size, from far off."""
    toy = make_toy(positions, noise=0.0, seed=seed)
    rng = np.random.default_rng(seed)
    structure = prior_structure(toy, prior) if positions is HEX else replace(free_structure(toy), prior=prior)
    # The structure may turn baselines of the toy around.
    flipped = np.any(structure.antennas != toy.antennas, axis=1)[:, None]
    foregrounds = np.where(flipped, toy.foregrounds.conj(), toy.foregrounds)
    rms = np.sqrt(np.mean(np.abs(foregrounds) ** 2))
    products = gain_products(toy.gains, structure.antennas)
    data = products * (foregrounds + level * rms * complex_normal(rng, foregrounds.shape))
    sky = foregrounds + rms * errors_of_sky(structure, *deviations, 100 + seed)
    weights, unity = 1 / np.abs(level * rms * products) ** 2, np.ones(toy.gains.shape, complex)
    problem = CalibrationProblem(structure, data, weights, unity, sky, "none", deviations=(1.0, 1.0))
    return problem.with_fractions((START_DEVIATION, START_DEVIATION))


def settled(problem, seed=0):
    """The problem with the deviations that it finds, its solution and the estimate."""
    solver = GaussNewton(tolerance=1e-5)
    for _ in range(12):
        solution = solve(problem, solver)
        found = estimate(problem, solution.gains, solution.model, (seed,))
        if found.settled:
            return problem, solution, found
        problem = replace(problem.with_fractions(found.deviations), initial_gains=solution.gains)
    raise AssertionError("the deviations do not settle")


@pytest.mark.parametrize(
    ("positions", "prior", "deviations"),
    [
        (scattered(7), "own", (0.003, 0.0)),
        (scattered(7), "own", (0.3, 0.0)),
        (HEX, "both", (0.01, 0.05)),
    ],
)
@pytest.mark.chain
def test_the_size_of_the_errors_of_a_sky_model_is_found(positions, prior, deviations):
    pulls = []
    for seed in range(1, 5):
        _, _, found = settled(measured(positions, prior, deviations, seed), seed)
        for value, true, error in zip(found.deviations, deviations, found.error, strict=True):
            if true:
                assert error < 0.15
                # Fractions are of the rms of the sky model, with its errors.
                pulls.append(np.log(value / true * np.sqrt(1 + sum(np.square(deviations)))) / error)
    assert abs(np.mean(pulls)) < 3 / np.sqrt(len(pulls))
    # Of fewer than ten draws.
    assert np.std(pulls) < 2


class DenseLikelihood:
    """The logarithm of the likelihood about a solution, with the gains integrated over, by dense matrices."""

    def __init__(self, problem, solution):
        self.problem, self.structure = problem, problem.structure
        products = gain_products(solution.gains, self.structure.antennas)
        self.roots = (np.sqrt(problem.weights) * np.abs(products)).ravel()
        data = turned(self.structure, problem.visibilities / products - problem.sky_model).ravel()
        self.data = np.concatenate([(self.roots * data).real, (self.roots * data).imag])
        self.jacobian = np.stack(list(self.columns(turned(self.structure, solution.model))), axis=1)

    def columns(self, model):
        structure = self.structure
        for turn in (1, 1j):
            for antenna in range(structure.n_antennas):
                sides = [(column == antenna)[:, None] for column in structure.antennas.T]
                slope = turned(structure, turn * sides[0] + np.conj(turn) * sides[1]) * model
                for channel in range(structure.n_frequencies):
                    change = np.zeros(model.shape, complex)
                    change[:, channel] = slope[:, channel]
                    column = self.roots * change.ravel()
                    yield np.concatenate([column.real, column.imag])

    def at(self, fractions):
        n, deviations = self.roots.size, self.problem.with_fractions(fractions).deviations
        covariance = dense_covariance(self.structure, *deviations) * self.roots * self.roots[:, None]
        lower = np.linalg.cholesky(covariance + np.eye(n))

        def whitened(values):
            return np.concatenate(
                [solve_triangular(lower, values[:n], lower=True), solve_triangular(lower, values[n:], lower=True)]
            )

        jacobian, data = whitened(self.jacobian), whitened(self.data)
        normal = jacobian.T @ jacobian
        # The phases of all gains together change nothing. They are fixed by a prior that is the same for all fractions.
        phases = np.zeros((len(normal) // 2, self.structure.n_frequencies))
        phases[np.arange(len(phases)), np.arange(len(phases)) % self.structure.n_frequencies] = 1
        normal[len(phases) :, len(phases) :] += self.scale * phases @ phases.T
        half = np.linalg.cholesky(normal)
        absorbed = solve_triangular(half, jacobian.T @ data, lower=True)
        determinants = 2 * np.sum(np.log(np.diag(lower))) + np.sum(np.log(np.diag(half)))
        return -(data @ data - absorbed @ absorbed) - determinants

    @property
    def scale(self):
        return float(np.mean(np.sum(self.jacobian**2, axis=0)))


@pytest.mark.chain
def test_the_deviations_are_the_most_likely_ones():
    problem, solution, found = settled(measured(HEX, "both", (0.01, 0.05), 2))
    likelihood, best, error = DenseLikelihood(problem, solution), np.log(found.deviations), np.array(found.error)
    steps = [error * row for row in np.eye(2)]
    middle, up, down = likelihood.at(found.deviations), [], []
    for step in steps:
        up.append(likelihood.at(tuple(np.exp(best + step))))
        down.append(likelihood.at(tuple(np.exp(best - step))))
    slopes, curvatures = (np.array(up) - np.array(down)) / 2, 2 * middle - np.array(up) - np.array(down)
    # In units of errors: traces of four probes have one of 0.5.
    assert np.all(np.abs(slopes / curvatures) < 1.5)
    # Errors include the correlation of both.
    assert np.all(curvatures > 0.7)
    assert curvatures.min() < 1.5


def test_a_sky_model_without_errors_is_sky_based_calibration():
    """No deviation that noise does not hide is found, and gains are those of a fit that takes the model for true."""
    toy = make_toy(scattered(8), noise=NOISE)
    uvd = make_uvdata(toy, n_times=1)
    sky = from_cube(uvd, toy.foregrounds[None, :, :, None])
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    # Of a sample of the data, in which it has been multiplied by the gains.
    noise = NOISE * rms * np.sqrt(np.mean(np.abs(gain_products(toy.gains, toy.antennas)) ** 2))
    result = run_calibrator(ESTIMATED, uvd, sky, noise=noise)
    (record,) = result.solutions
    assert record.status == "converged"
    assert record.diagnostics["deviation"][0] < 0.1 * NOISE
    known = run_calibrator(SkyBased(), uvd, sky)
    difference = result.gains.gain_array - known.gains.gain_array
    # Errors of the gains by the noise are 4e-4.
    assert np.sqrt(np.mean(np.abs(difference) ** 2)) < 1e-4


def test_a_level_that_is_not_there_vanishes_and_leaves_the_other_at_its_maximum():
    problem, solution, found = settled(measured(HEX, "both", (0.03, 0.0), 2))
    # Shared errors are those of three baselines each; below a tenth of the own ones they are hidden.
    assert found.deviations[1] < 0.3 * 0.03
    assert found.error[1] is None or found.error[1] > 0.5
    likelihood = DenseLikelihood(problem, solution)
    own, step = np.log(found.deviations[0]), found.error[0]
    values = [likelihood.at((float(np.exp(own + turn * step)), found.deviations[1])) for turn in (-1, 0, 1)]
    slope, curvature = (values[2] - values[0]) / 2, 2 * values[1] - values[0] - values[2]
    assert abs(slope / curvature) < 1.5


@pytest.mark.chain
def test_levels_that_are_the_same_do_not_end_in_an_error():
    """Without redundant baselines own and shared errors are one, and their powers add up."""
    for seed in (1, 2):
        _, _, found = settled(measured(scattered(7), "both", (0.02, 0.02), seed), seed)
        together = np.hypot(*found.deviations)
        assert together == pytest.approx(np.hypot(0.02, 0.02), rel=0.2)


def test_units_of_the_data_do_not_matter():
    problem, solution, _ = settled(measured(scattered(7), "own", (0.03, 0.0), 1))
    found = estimate(problem, solution.gains, solution.model, (1,))
    unit = 1e-26
    fields = {"visibilities": problem.visibilities * unit, "sky_model": problem.sky_model * unit}
    small = replace(
        problem, **fields, weights=problem.weights / unit**2, deviations=tuple(unit * np.array(problem.deviations))
    )
    again = estimate(small, solution.gains, solution.model * unit, (1,))
    assert again.deviations[0] == pytest.approx(found.deviations[0], rel=1e-3)
    assert again.error[0] == pytest.approx(found.error[0], rel=1e-2)


def test_a_deviation_far_above_the_noise_is_found():
    """Single precision does not resolve it; probes are in double precision then."""
    _, _, found = settled(measured(scattered(7), "own", (0.03, 0.0), 1, level=1e-5), 1)
    assert abs(np.log(found.deviations[0] / 0.03)) < 3 * found.error[0]


def test_the_problem_of_a_solution_has_the_deviations_that_were_found():
    """What is computed of a finished fit, as its linear response, takes them from the record of the solve."""
    toy = make_toy(scattered(6), noise=NOISE)
    uvd = make_uvdata(toy, n_times=1)
    sky = from_cube(uvd, 1.05 * toy.foregrounds[None, :, :, None])
    noise = NOISE * float(np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2)))
    result = run_calibrator(ESTIMATED, uvd, sky, noise=noise)
    (record,) = result.solutions
    gains = result.gains.gain_array[:, :, 0, 0]
    prepared = prepare(Observation(uvd), ESTIMATED, Assumed(Observation(sky), noise=noise))
    problem = problem_at(prepared, ESTIMATED, slice(0, 1), 0, gains, record)
    assert problem.fractions[0] == pytest.approx(record.diagnostics["deviation"][0])
    # The residual is at the minimum for these: coefficients and gains that the data determine do not move.
    again = solve(replace(problem, initial_gains=gains), GaussNewton(tolerance=1e-5))
    assert again.record.loss_history[-1] > 0.99 * again.record.loss_history[0]


def test_rough_passes_lead_to_the_deviation_and_the_minimum_of_exact_ones(monkeypatch):
    problem = measured(HEX, "both", (0.1, 0.2), 3)
    exact = GaussNewton(tolerance=1e-6)
    settings = DelayWeighted(
        foreground_prior={"deviation": "estimated", "shared_deviation": "estimated"},
        solver={"name": "gauss-newton", "tolerance": exact.tolerance},
    )
    rough = calamity._Passes(settings, exact, (1, 2)).solve(problem, None, None)
    monkeypatch.setattr(calamity, "SEARCH_TOLERANCE", exact.tolerance)
    fine = calamity._Passes(settings, exact, (1, 2)).solve(problem, None, None)
    assert rough.solution.record.steps < fine.solution.record.steps
    assert rough.solution.record.newton_decrement < exact.tolerance
    # The estimates' own errors are some percent.
    assert rough.deviations == pytest.approx(fine.deviations, rel=0.01)
    losses = [found.solution.record.loss_history[-1] for found in (rough, fine)]
    # A deviation that is off by a hundredth of itself changes the loss by its share of the prior's.
    assert losses[0] == pytest.approx(losses[1], rel=0.01)


def test_one_level_cannot_be_estimated_beside_a_fixed_one():
    with pytest.raises(ValidationError, match="must be 'estimated' or 0"):
        ForegroundPrior(mean="sky-model", deviation=0.1, shared_deviation="estimated")
    with pytest.raises(ValidationError, match="need `mean: sky-model`"):
        ForegroundPrior(mean="none", deviation="estimated")
