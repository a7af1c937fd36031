"""A Gaussian prior on the foregrounds: its fit against dense matrices, its limits against fits that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hera_cal.datacontainer import DataContainer
from hera_cal.redcal import RedundantCalibrator
from hera_cal.skycal import refine_gains
from toy import BASIS, FREQUENCIES, HEX, complex_normal, make_toy, scattered
from toy_data import make_uvdata
from toy_structures import OWN, SHARED, dense_covariance, free_structure, prior_structure, redundant_structure, turned

from calstudy.base.tensorflow import tf
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate import pairs
from calstudy.calibrate.basis import Bucket, ForegroundBasis, flat_wedge_root, make_basis
from calstudy.calibrate.calibrators.least_squares import Calamity, DelayWeighted, SkyBased, Unified
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, gain_products
from calstudy.calibrate.settings import BasisSettings, FlagWeights, ForegroundPrior
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.solvers.reduced import ReducedKernels, compiled
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.realdata.settings import defaults

SIGMA = 0.05


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
    covariance = flat_wedge_root(channels, width) @ flat_wedge_root(channels, width).T
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


def solved(problem, tolerance=1e-13):
    """The fit, carried on far beyond what anybody needs."""
    return solve(problem, GaussNewton(tolerance=tolerance, max_steps=200))


def noisy(toy, structure, sky, deviations, seed=5):
    """A measurement with gains of 10 % and noise SIGMA, of which the sky model is `sky`."""
    rng = np.random.default_rng(seed)
    shape = (structure.n_baselines, structure.n_frequencies)
    products = gain_products(toy.gains, structure.antennas)
    data = products * (toy.foregrounds + SIGMA * complex_normal(rng, shape))
    weights = np.full(shape, SIGMA**-2)
    return CalibrationProblem(
        structure, data, weights, np.ones(toy.gains.shape, complex), sky, "none", deviations=deviations
    )


def spoiled(toy, fraction=0.06):
    """The toy's foregrounds with an error that is white within the delays of the basis."""
    rng = np.random.default_rng(9)
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    error = np.empty_like(toy.foregrounds)
    for bucket in make_basis(np.linalg.norm(toy.vectors, axis=1), FREQUENCIES, BASIS, prior=True).buckets:
        coefficients = complex_normal(rng, (bucket.members.size, bucket.vectors.shape[1]))
        error[bucket.members] = coefficients @ bucket.vectors.T
    return toy.foregrounds - fraction * rms * error


def test_a_vanishing_deviation_is_sky_based_calibration_by_hera_cal(toy):
    sky = spoiled(toy)
    problem = noisy(toy, free_structure(toy), sky, (1e-7, 1e-7))
    found = solved(problem)
    assert found.record.status == "converged", found.record.message
    ratio, weights, start = {}, {}, {}
    for row, (a, b) in enumerate(toy.antennas.tolist()):
        ratio[a, b, "nn"] = (problem.visibilities[row] / sky[row])[None]
        weights[a, b, "nn"] = (problem.weights[row] * np.abs(sky[row]) ** 2)[None]
    for antenna in range(len(toy.positions)):
        start[antenna, "Jnn"] = np.ones((1, FREQUENCIES.size), complex)
    refined, _ = refine_gains(DataContainer(ratio), DataContainer(weights), start, refine_tol=1e-12)
    gains = np.array([refined[antenna, "Jnn"][0] for antenna in range(len(toy.positions))])
    difference = gain_products(found.gains, toy.antennas) - gain_products(gains, toy.antennas)
    assert np.abs(difference).max() < 1e-6


@pytest.mark.parametrize("part", [0, 0.7], ids=["no mean", "mean"])
def test_a_huge_deviation_is_calamity(toy, part):
    """The loss at any gains is that of free foregrounds, if the sky model has nothing beyond the modelled delays."""
    structure = free_structure(toy)
    sky_model = np.empty_like(toy.foregrounds)
    for bucket in toy.basis.buckets:
        sky_model[bucket.members] = part * toy.foregrounds[bucket.members] @ bucket.vectors @ bucket.vectors.T
    problem = noisy(toy, structure, sky_model, (1e12, 1e12))
    free = replace(problem, structure=toy.structure, deviations=(np.inf, np.inf))
    at = 1 + 0.1 * complex_normal(np.random.default_rng(2), toy.gains.shape)
    losses = []
    for case in (problem, free):
        _, reduced, projection = projected(case, at)
        losses.append(float(projection.loss) * reduced.loss_unit)
    # Relative to the loss of no foregrounds at all, whose rounding this is.
    assert abs(losses[0] - losses[1]) < 1e-12 * np.sum(problem.weights * np.abs(problem.visibilities) ** 2)


def test_free_shared_foregrounds_are_omnical_by_hera_cal(hexagon):
    """With one coefficient for every channel of a redundant group; free of what redundancy cannot know."""
    structure = redundant_structure(hexagon)
    channels = ForegroundBasis(
        (Bucket(None, np.arange(structure.basis.n_models), np.eye(FREQUENCIES.size)),),
        structure.basis.n_models,
        FREQUENCIES.size,
    )
    structure = replace(structure, basis=channels)
    turned_foregrounds = hexagon.foregrounds.copy()
    odd = np.arange(len(turned_foregrounds)) % 2 == 1
    turned_foregrounds[odd] = turned_foregrounds[odd].conj()
    toy = replace(hexagon, foregrounds=turned_foregrounds)
    problem = noisy(toy, structure, None, (np.inf, np.inf))
    found = solved(problem)
    keys = [
        (int(b), int(a), "nn") if back else (int(a), int(b), "nn")
        for (a, b), back in zip(structure.antennas, structure.conjugated, strict=True)
    ]
    cube = turned(structure, problem.visibilities)
    data = DataContainer({key: cube[row][None] for row, key in enumerate(keys)})
    weights = DataContainer({key: problem.weights[row][None] for row, key in enumerate(keys)})
    groups = [[keys[row] for row in np.flatnonzero(structure.groups == g)] for g in range(structure.basis.n_models)]
    calibrator = RedundantCalibrator(groups)
    _, first = calibrator.logcal(data)
    _, solution = calibrator.omnical(data, first, wgts=weights, conv_crit=1e-14, maxiter=5000)
    model = turned(structure, gain_products(found.gains, structure.antennas) * found.model)
    theirs = np.array([solution.model_bl(key)[0] for key in keys])
    assert np.linalg.norm(model - theirs) < 1e-6 * np.linalg.norm(theirs)


def test_the_loss_is_that_of_delay_weights(toy):
    """Byrne (2023, ApJ 943, 117) weights the delay modes of V / G - m with their inverse variances.

    On modes that are periodic in the band, and gains that are phases only, that is the loss of a finite prior.
    """
    n, deviation = FREQUENCIES.size, 0.8
    delays = np.fft.fftfreq(n)
    inside = np.abs(delays) <= 5 / n
    angle = 2 * np.pi * np.outer(np.arange(n), np.arange(1, 6)) / n
    modes = np.column_stack([np.ones(n), np.sqrt(2) * np.cos(angle), np.sqrt(2) * np.sin(angle)]) / np.sqrt(11)
    basis = ForegroundBasis((Bucket(None, np.arange(len(toy.antennas)), modes),), len(toy.antennas), n)
    structure = replace(FitStructure.per_baseline(toy.antennas, len(toy.positions), basis), prior="own")
    problem = noisy(toy, structure, spoiled(toy), (deviation, deviation))
    at = np.exp(1j * np.random.default_rng(4).normal(size=toy.gains.shape))
    _, reduced, projection = projected(problem, at)
    excess = problem.visibilities / gain_products(at, toy.antennas) - problem.sky_model
    spectrum = np.fft.fft(excess, axis=1) / np.sqrt(n)
    variance = SIGMA**2 + np.where(inside, deviation**2 * n / 11, 0)
    expected = np.sum(np.abs(spectrum) ** 2 / variance)
    assert float(projection.loss) * reduced.loss_unit == pytest.approx(expected, rel=1e-9)


def test_the_scale_of_a_wide_prior_is_corrected_by_the_sky_model():
    """Without it, log |g g*| is too large by about the square of what the sky model lacks; with it, as sky-based."""
    toy = make_toy(scattered(14))
    missing, rms = 0.2, np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    problem = noisy(toy, free_structure(toy), spoiled(toy, missing), (missing * rms, 0.0))
    cases = {
        "none": problem,
        "sky-model": replace(problem, prior="sky-model"),
        "sky-based": replace(problem, structure=toy.structure, frozen=True, deviations=(np.inf, np.inf)),
    }
    excess = {}
    for name, case in cases.items():
        ratio = gain_products(solve(case, GaussNewton()).gains, toy.antennas) / gain_products(toy.gains, toy.antennas)
        excess[name] = np.mean(np.log(np.abs(ratio)))
    assert 0.5 * missing**2 < excess["none"] - excess["sky-based"] < 2.5 * missing**2
    assert abs(excess["sky-model"] - excess["sky-based"]) < 0.25 * missing**2


def wide_prior(hexagon, prior, own, shared, noise=1e-3) -> CalibrationProblem:
    """A sky model that is off by 6 %, whose errors the prior allows, with noise relative to the foregrounds."""
    structure = prior_structure(hexagon, prior)
    rms = np.sqrt(np.mean(np.abs(hexagon.foregrounds) ** 2))
    turned_foregrounds = turned(structure, hexagon.foregrounds)
    rng = np.random.default_rng(6)
    data = gain_products(hexagon.gains, structure.antennas) * (
        turned_foregrounds + noise * rms * complex_normal(rng, turned_foregrounds.shape)
    )
    weights = np.full(data.shape, (noise * rms) ** -2)
    start = np.ones(hexagon.gains.shape, complex)
    sky = turned_foregrounds + 0.06 * rms * complex_normal(rng, (len(data), 1))
    return CalibrationProblem(structure, data, weights, start, sky, deviations=(own * rms, shared * rms))


@pytest.mark.parametrize(("prior", "own", "shared"), [("own", 1.0, 0.0), ("both", 0.05, 0.1)])
@pytest.mark.chain
def test_wide_priors_converge_to_the_minimum(hexagon, prior, own, shared):
    """The curvature that the prior gives to smooth gains is a millionth of that of the data, and is not damped away.

    The default solver is held against a fit in double precision that is carried on much further. A hundredth of the
    noise is what the minimum may be missed by: near the wedge, more would be of the size of an EoR.
    """
    problem = wide_prior(hexagon, prior, own, shared)
    found = solve(problem, GaussNewton(tolerance=1e-5))
    assert found.record.status == "converged", found.record.message
    further = solve(problem, GaussNewton(tolerance=1e-6, max_steps=300, precision="double"))
    assert found.record.loss_history[-1] < 1.01 * further.record.loss_history[-1]


def test_priors_are_followed_where_single_precision_misses_their_curvature(hexagon):
    """With noise of a ten-thousandth, fits in single precision alone end at 100 steps with 1.7 times the least loss."""
    problem = wide_prior(hexagon, "both", 0.05, 0.1, noise=1e-4)
    found = solve(problem, GaussNewton(tolerance=1e-5)).record
    assert found.status == "converged", found.message
    # chi^2 of complex samples, each with a mean of one, less what gains and foregrounds follow.
    assert found.loss_history[-1] < problem.visibilities.size


def test_singular_blocks_of_the_preconditioner_do_not_keep_a_fit_from_converging(hexagon, monkeypatch):
    """In single precision rounding decides whether they can be inverted; here they cannot with little damping."""
    problem = wide_prior(hexagon, "own", 1.0, 0.0)
    expected = solve(problem, GaussNewton(tolerance=1e-5)).record
    kernels = compiled(problem.structure)
    inverted = kernels.inverse

    def inverse(blocks, damping, gains):
        return inverted(blocks, damping if damping > 5e-6 else kernels.scalar(np.nan), gains)

    monkeypatch.setattr(kernels, "inverse", inverse)
    found = solve(problem, GaussNewton(tolerance=1e-5)).record
    assert found.status == "converged", found.message
    assert found.loss_history[-1] < 1.001 * expected.loss_history[-1]


@pytest.mark.chain
def test_refused_steps_are_the_exception_in_curved_valleys():
    """Where damping that was raised is lowered again at once, every third step is refused."""
    simulation = Simulation(Case(antennas=12, channels=96, noise=NOISE))
    lengths = np.linalg.norm(np.diff(simulation.positions[simulation.antennas], axis=1)[:, 0], axis=1)
    basis = make_basis(lengths, simulation.case.frequencies, BasisSettings(delay_step="50 ns"), prior=True)
    structure = replace(FitStructure.per_baseline(simulation.antennas, 12, basis), prior="own")
    sky = simulation.foregrounds(0)
    rms = np.sqrt(np.mean(np.abs(sky) ** 2))
    data = simulation.problem(0, simulation.structure()).visibilities
    weights, start = np.full(data.shape, (NOISE * rms) ** -2), np.ones(simulation.gains.shape, complex)
    problem = CalibrationProblem(structure, data, weights, start, sky, deviations=(rms, np.inf))
    found = solve(problem, GaussNewton(tolerance=1e-5))
    assert found.record.status == "converged", found.record.message
    refused = np.diff(found.record.loss_history) == 0
    assert refused.mean() < 0.15


NOISE, ROUNDING = 1e-3, 3e-8
"""Noise over the foregrounds that the prior is told, and the residual at which a fit is at rounding."""


@pytest.mark.parametrize(
    ("calibrator", "positions", "exact"),
    [
        (SkyBased(), scattered(8), 10 * ROUNDING),
        # Smooth gains are known to the residual times deviation over noise.
        (DelayWeighted(), scattered(8), 10 * ROUNDING * 0.1 / NOISE),
        (Unified(), HEX, 10 * ROUNDING * 0.1 / NOISE),
    ],
    ids=["sky-based", "delay-weighted", "unified"],
)
def test_noiseless_gains_are_exact_with_the_true_sky_model(calibrator, positions, exact):
    """The calibrators as they are by default, on data that their sky model explains."""
    toy = make_toy(positions, noise=0.0)
    if not isinstance(calibrator, SkyBased):
        rms = float(np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2)))
        prior = calibrator.foreground_prior.model_copy(update={"noise": NOISE * rms})
        calibrator = calibrator.model_copy(update={"foreground_prior": prior})
    uvd = make_uvdata(toy, n_times=1, polarizations=(-5,))
    sky = from_cube(uvd, np.broadcast_to(toy.foregrounds[None, :, :, None], to_cube(uvd).shape))
    result = run_calibrator(calibrator, uvd, sky)
    assert [record.status for record in result.solutions] == ["converged"]
    # The data that are made of a toy differ from it in amplitude.
    true = np.sqrt(np.abs(to_cube(uvd)[0, ..., 0] / toy.visibilities).mean()) * toy.gains
    assert np.abs(fix_phase(result.gains.gain_array[..., 0, 0], true) - true).max() < exact


def test_a_partial_solver_block_keeps_what_the_calibrator_has_of_its_own():
    """A tolerance of 1e-3 leaves more than the EoR near the wedge with a finite prior."""
    for given in ("gauss-newton", {"name": "gauss-newton", "max_steps": 500}, defaults(True)["solver"]):
        assert DelayWeighted.model_validate({"solver": given}).solver.tolerance == 1e-5
        assert Unified.model_validate({"solver": given}).solver.tolerance == 1e-5
        assert Calamity.model_validate({"solver": given}).solver.tolerance == 1e-3
    assert (
        DelayWeighted.model_validate({"solver": {"name": "gauss-newton", "tolerance": 1e-6}}).solver.tolerance == 1e-6
    )


def test_a_solve_whose_sky_model_is_zero_is_skipped_with_the_reason():
    data = make_uvdata(make_toy(scattered(5)), 2)
    sky = data.copy()
    sky.data_array[sky.time_array == sky.time_array[0]] = 0
    calibrator = DelayWeighted(foreground_prior=ForegroundPrior(mean="sky-model", deviation=0.1))
    first, second = run_calibrator(calibrator, data, sky, noise=1e-3).solutions
    assert (first.status, second.status) == ("skipped", "converged")
    assert "the sky model is zero" in first.message


@pytest.fixture(scope="module")
def changing():
    """Two integrations and polarizations of a hexagon, with other foregrounds, noise and flags in each; a sky model."""
    toy = make_toy(HEX)
    data = make_uvdata(toy, 2, polarizations=(-5, -6))
    rng = np.random.default_rng(31)
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    drift = np.exp(1j * rng.uniform(0, 6, (2, len(toy.antennas), 1, 2)))
    sky = toy.foregrounds[None, :, :, None] * drift
    shape = (2, len(toy.antennas), FREQUENCIES.size, 2)
    gains = gain_products(toy.gains, toy.antennas)[None, :, :, None]
    measured = from_cube(data, gains * (sky + NOISE * rms * complex_normal(rng, shape)))
    measured.flag_array = (rng.random(shape) < 0.1).reshape(measured.flag_array.shape)
    model = from_cube(data, sky * (1 + 0.05 * complex_normal(rng, (2, len(toy.antennas), 1, 2))))
    return toy, measured, model, NOISE * rms


@pytest.mark.chain
@pytest.mark.parametrize("calibrator", [DelayWeighted, Unified], ids=["delay-weighted", "unified"])
def test_integrations_and_polarizations_have_priors_of_their_own(changing, calibrator):
    """What is solved after another integration, from its gains, is what is solved by itself, to the tolerance.

    Of one pass: weights from the gains take several, and each moves by the tolerance.
    """
    calibrator = calibrator(weights=FlagWeights())
    _, data, model, sigma = changing
    together = run_calibrator(calibrator, data, model, noise=sigma)
    assert {record.status for record in together.solutions} <= {"converged", "stalled"}
    times = np.unique(data.time_array)
    part = {"times": times[1:], "polarizations": [-6]}
    alone = run_calibrator(
        calibrator, data.select(**part, inplace=False), model.select(**part, inplace=False), noise=sigma
    )
    found = together.residual.select(**part, inplace=False)
    used = ~alone.residual.flag_array
    assert np.array_equal(used, ~found.flag_array)
    excess = (found.data_array - alone.residual.data_array)[used]
    # A tolerance of 1e-5 leaves some 0.3 % of the noise.
    assert np.sqrt(np.mean(np.abs(excess) ** 2)) < 0.03 * sigma


@pytest.mark.chain
def test_integrations_that_are_solved_together_know_their_gains_better(changing):
    toy, data, model, sigma = changing
    true = gain_products(toy.gains, toy.antennas)
    errors = []
    for count in (1, 2):
        calibrator = DelayWeighted(integrations_per_solve=count)
        gains = run_calibrator(calibrator, data, model, noise=sigma).gains.gain_array[..., 0]
        products = np.stack([gain_products(gains[:, :, t], toy.antennas) for t in range(2)])
        errors.append(np.sqrt(np.median(np.abs(products / true - 1) ** 2)))
    # The errors of the sky model differ between the integrations, and so does the noise: 0.71 of the error is expected.
    assert errors[1] < 0.85 * errors[0]
