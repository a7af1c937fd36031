"""Weights 1/|g_a g_b|^2 of the fit's own gains: what is white in the gains does not reach the result.

Data V = g_a g_b* (F + N) with weights 1/|g_a g_b|^2 are data F + N with equal weights, whatever the gains are. So the
result of a fit that finds these weights by itself does not depend on them, while equal weights multiply the errors of
the sky model by |g_a g_b|^2.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, LARGE_HEX, complex_normal, make_toy, point_source_visibilities, scattered
from toy_data import SETTINGS, make_uvdata, sky_of, statuses

from calstudy.base.observation import Observation
from calstudy.base.visibilities import flag_cube, to_cube
from calstudy.calibrate import calamity
from calstudy.calibrate.basis import dpss_vectors
from calstudy.calibrate.calamity import make_solver
from calstudy.calibrate.calibrators import other_packages
from calstudy.calibrate.calibrators.least_squares import (
    Calamity,
    DelayWeighted,
    EmpiricalBayes,
    SkyBased,
    Unified,
)
from calstudy.calibrate.calibrators.other_packages import Skycal, Solved
from calstudy.calibrate.calibrators.redcal import Redcal
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.preparation import make_problem, prepare, problem_at
from calstudy.calibrate.problem import gain_products, gain_weights, weight_change
from calstudy.calibrate.records import Solve
from calstudy.calibrate.settings import BaselineRange, FlagWeights, GainWeights
from calstudy.calibrate.solvers.interface import Solution, WarmStart
from calstudy.calibrate.tangent_space import TangentSpace
from calstudy.power.delay import delay_transform

FLAT = FlagWeights()
TIGHT = GainWeights(tolerance=1e-6, passes=30)
FAR = np.abs(np.fft.fftshift(np.fft.fftfreq(FREQUENCIES.size, 400e3))) > 0.4e-6
"""Delays far beyond the horizon of arrays of 70 m."""
CALIBRATORS = {
    "sky-based": (SkyBased(), scattered(8)),
    "skycal": (Skycal(), scattered(8)),
    "redcal": (Redcal(), LARGE_HEX),
}
MISSING = 0.1
"""Part of the foregrounds' rms that the sky model lacks."""


def white_gains(n_antennas, seed=7):
    rng = np.random.default_rng(seed)
    return 1 + 0.1 * (
        rng.standard_normal((n_antennas, FREQUENCIES.size)) + 1j * rng.standard_normal((n_antennas, FREQUENCIES.size))
    )


def smooth_gains(n_antennas, seed=8):
    rng = np.random.default_rng(seed)
    powers = np.linspace(-1, 1, FREQUENCIES.size) ** np.arange(4)[:, None]
    return 1 + 0.05 * complex_normal(rng, (n_antennas, 4)) @ powers


@pytest.fixture(scope="module", params=list(CALIBRATORS))
def world(request):
    """A calibrator, a toy, and a sky model that lacks some sources."""
    calibrator, positions = CALIBRATORS[request.param]
    toy = make_toy(positions, noise=1e-5)
    lacking = point_source_visibilities(toy.vectors, np.random.default_rng(21), 50)
    lacking *= MISSING * np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2) / np.mean(np.abs(lacking) ** 2))
    return calibrator, toy, toy.foregrounds - lacking


def calibrated(calibrator, toy, gains, sky):
    """Return the result for data with some gains, and the residual on their scale far beyond the horizon."""
    toy = replace(toy, gains=gains)
    uvd = make_uvdata(toy, n_times=1)
    result = run_calibrator(calibrator, uvd, sky_of(uvd, sky))
    rows = np.isin(result.gains.ant_array, 10 + 2 * np.arange(len(toy.positions)))
    found = result.gains.gain_array[rows, :, 0, 0]
    products, true = (gain_products(values, toy.antennas) for values in (found, gains))
    residual = (to_cube(uvd)[0, :, :, 0] - products * sky) / true
    far = delay_transform(residual, FREQUENCIES, "blackman-harris")[:, FAR]
    return found, float(np.sqrt(np.mean(np.abs(far) ** 2)))


def test_results_do_not_depend_on_the_gains(world):
    calibrator, toy, sky = world
    unity = np.ones_like(toy.gains)
    tight = calibrator.model_copy(update={"weights": TIGHT})
    reference, floor = calibrated(tight, toy, unity, sky)
    for gains in (white_gains(len(unity)), smooth_gains(len(unity))):
        found, far = calibrated(tight, toy, gains, sky)
        aligned = fix_phase(found / gains, reference)
        # Calibrators stop when gains change by 1e-8 to 1e-6.
        assert np.abs(aligned - reference).max() < 1e-4
        assert far == pytest.approx(floor, rel=0.05)


def test_equal_weights_throw_the_errors_of_the_sky_to_all_delays_and_own_weights_do_not(world):
    calibrator, toy, sky = world
    n_antennas = len(toy.positions)
    flat = calibrator.model_copy(update={"weights": FLAT})
    _, smooth = calibrated(flat, toy, smooth_gains(n_antennas), sky)
    _, white = calibrated(flat, toy, white_gains(n_antennas), sky)
    _, weighted = calibrated(calibrator, toy, white_gains(n_antennas), sky)
    assert white > 10 * smooth
    # With the tolerance of the default, 1e-4, of errors of a tenth.
    assert weighted < 1.2 * smooth


def test_passes_that_swing_settle_at_a_result_that_does_not_depend_on_the_gains(monkeypatch):
    """Where the sky model lacks much, a gain that is too small in one pass is too large in the next."""
    toy = make_toy(scattered(8), noise=1e-5)
    lacking = point_source_visibilities(toy.vectors, np.random.default_rng(21), 50)
    lacking *= 0.7 * np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2) / np.mean(np.abs(lacking) ** 2))
    sky, toy = toy.foregrounds, replace(toy, foregrounds=toy.foregrounds + lacking)
    found = []
    for gains in (np.ones_like(toy.gains), white_gains(len(toy.positions))):
        uvd = make_uvdata(replace(toy, gains=gains), n_times=1)
        result = run_calibrator(Skycal(weights=TIGHT), uvd, sky_of(uvd, sky))
        assert statuses(result) == ["converged"]
        rows = ~result.gains.flag_array.all(axis=(1, 2, 3))
        found.append(result.gains.gain_array[rows, :, 0, 0] / gains)
    # Weights settle to 1e-6, by a factor of two in a pass.
    assert np.abs(fix_phase(found[1], found[0]) - found[0]).max() < 1e-4
    monkeypatch.setattr(other_packages, "SLOW", np.inf)
    assert statuses(run_calibrator(Skycal(weights=TIGHT), uvd, sky_of(uvd, sky))) != ["converged"]


def left_of(calibrator, toy, signal):
    """Return what is left of a signal in the noise, by its delays, and the signal, (Nbls, Ndelays)."""
    left = []
    for change in (0, signal):
        uvd = make_uvdata(replace(toy, noise=toy.noise + change), n_times=1)
        left.append(to_cube(run_calibrator(calibrator, uvd, sky_of(uvd, toy.foregrounds)).residual)[0, :, :, 0])
    return (delay_transform(cube, FREQUENCIES, "blackman-harris") for cube in (left[1] - left[0], signal))


def test_what_is_left_of_a_signal_is_correlated_with_it_as_its_power_says():
    """With equal weights of the calibrated data the residual is a projection P of the signal: <Ps, s> is <Ps, Ps>."""
    toy = make_toy(scattered(8), noise=1e-3)
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    signal = 1e-4 * rms * complex_normal(np.random.default_rng(5), toy.foregrounds.shape)
    for weights, least, most in ((GainWeights(), 0, 1e-3), (FLAT, 3e-3, 1)):
        left, put = left_of(SkyBased(weights=weights), toy, signal)
        excess = np.sum(np.abs(left) ** 2 - (left.conj() * put).real, where=FAR) / np.sum(np.abs(put) ** 2, where=FAR)
        assert least < abs(excess) < most


def test_a_signal_at_all_delays_leaks_into_the_wedge_with_equal_weights_alone():
    """Foreground models that are fitted with weights white in frequency follow what is far beyond the wedge."""
    toy = make_toy(scattered(8), noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    # Half of the delays that all models have, 100 ns.
    wedge = dpss_vectors(FREQUENCIES.size, 50e-9 * np.ptp(FREQUENCIES), 1e-12)
    signal = complex_normal(np.random.default_rng(6), toy.foregrounds.shape)
    leak = {}
    for weights in (GainWeights(), FLAT):
        settings = SETTINGS.model_copy(update={"weights": weights})
        problem = problem_at(prepare(Observation(uvd), settings), settings, slice(0, 1), 0, toy.gains)
        tangent = TangentSpace.at(problem, toy.gains, toy.foregrounds)
        left = tangent.without_foregrounds(tangent.roots * signal) / tangent.roots
        leak[weights.kind] = np.sum(np.abs(left @ wedge) ** 2) / np.sum(np.abs(signal @ wedge) ** 2)
    assert leak["gains"] < 1e-6
    # By the scatter of |g_a g_b|^2, 0.28 squared, from all delays.
    assert leak["flags"] == pytest.approx(8 * 0.1**2, rel=0.5)


def test_weights_that_run_away_leave_the_result_of_equal_weights():
    """With a signal to noise of one in every sample, gains by channel are too noisy to make weights."""
    toy = make_toy(scattered(8), noise=1.0)
    uvd = make_uvdata(toy, n_times=1)
    sky = sky_of(uvd, toy.foregrounds)
    weighted, equal = (run_calibrator(SkyBased(weights=weights), uvd, sky) for weights in (GainWeights(), FLAT))
    (record,) = weighted.solutions
    assert record.status == "max-steps"
    assert "the result is that of equal weights" in record.message
    assert np.array_equal(weighted.gains.gain_array, equal.gains.gain_array)


def test_weights_that_run_away_leave_the_deviation_that_equal_weights_estimate():
    """Not the one that the first pass starts from."""
    noise, toy = 0.6, make_toy(scattered(8), noise=0.6)
    uvd = make_uvdata(toy, n_times=1)
    sky = sky_of(uvd, toy.foregrounds * np.where(np.arange(len(toy.foregrounds)) % 2, 1.5, 0.5)[:, None])
    level = noise * np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    prior = {"mean": "sky-model", "deviation": "estimated", "noise": f"{level} Jy"}
    weighted, equal = (
        run_calibrator(EmpiricalBayes(weights=weights, foreground_prior=prior), uvd, sky)
        for weights in (GainWeights(), FLAT)
    )
    ((record,), (flat,)) = weighted.solutions, equal.solutions
    assert record.status == "max-steps"
    assert "the result is that of equal weights" in record.message
    assert record.diagnostics["deviation"] == pytest.approx(flat.diagnostics["deviation"], rel=1e-3)
    assert record.diagnostics["deviation_error"][0] == pytest.approx(flat.diagnostics["deviation_error"][0], rel=0.1)
    assert np.allclose(weighted.gains.gain_array, equal.gains.gain_array, rtol=1e-3)


@pytest.mark.chain
def test_weights_that_run_away_leave_nothing_to_the_next_integration():
    """Each integration starts from the one before, whose gains, lost in noise, must not decide its weights."""
    toy = make_toy(scattered(8), noise=0.4)
    uvd = make_uvdata(toy, n_times=3)
    sky = sky_of(uvd, toy.foregrounds)
    weighted, equal = (
        run_calibrator(Calamity(weights=weights, prior="sky-model"), uvd, sky) for weights in (GainWeights(), FLAT)
    )
    assert [record.status for record in weighted.solutions] == ["max-steps"] * 3
    assert np.allclose(weighted.gains.gain_array, equal.gains.gain_array, rtol=1e-6)


def test_weights_keep_their_mean_and_samples_without_weight():
    rng = np.random.default_rng(2)
    weights = rng.uniform(0.5, 2, (3, 5, 8))
    weights[0, 1, 3:5] = 0
    products = 1 + 0.3 * complex_normal(rng, weights.shape)
    found = gain_weights(weights, products)
    assert np.array_equal(found == 0, weights == 0)
    assert np.allclose(found.sum(axis=(1, 2)), weights.sum(axis=(1, 2)))
    ratio = (found * np.abs(products) ** 2 / np.where(weights > 0, weights, 1))[weights > 0]
    assert np.allclose(ratio[:38], ratio[0])
    # A sample whose gains vanish does not have all the weight.
    products[0, 0, 0] = 1e-6
    assert gain_weights(weights, products)[0, 0, 0] < 0.9 * weights[0].sum()
    # Smooth changes do not count, white ones by their rms.
    smooth = weights * (1 + 0.1 * np.linspace(0, 1, 8))
    assert weight_change(smooth, weights) < 0.02
    many = np.ones((40, 400))
    assert weight_change(many * (1 + 0.01 * rng.standard_normal(many.shape)), many) == pytest.approx(0.01, rel=0.05)


def test_problems_at_a_solution_have_its_weights():
    toy = make_toy(scattered(5))
    uvd = make_uvdata(toy, n_times=1)
    settings = SETTINGS.model_copy(update={"weights": GainWeights()})
    prepared = prepare(Observation(uvd), settings)
    flat, found = (
        make_problem(prepared, settings, slice(0, 1), 0),
        problem_at(prepared, settings, slice(0, 1), 0, toy.gains),
    )
    assert np.ptp(flat.weights) < 1e-12
    product = found.weights * np.abs(gain_products(toy.gains, toy.antennas)) ** 2
    assert np.allclose(product, product[0, 0])


@pytest.mark.parametrize("name", ["sky-based", "skycal"])
def test_baselines_out_of_range_have_no_influence_and_are_calibrated(name):
    calibrator, positions = CALIBRATORS[name]
    toy = make_toy(positions, noise=0.0)
    lengths = np.linalg.norm(toy.vectors, axis=1)
    short = np.median(lengths)
    chosen = calibrator.model_copy(update={"baselines": BaselineRange(longest=f"{short} m")})
    uvd = make_uvdata(toy, n_times=1)
    wrong = np.where((lengths > short)[:, None], 3j * toy.foregrounds, toy.foregrounds)
    result = run_calibrator(chosen, uvd, sky_of(uvd, wrong))
    assert not result.residual.flag_array.any()
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    residual = to_cube(result.residual)[0, :, :, 0]
    assert np.abs(residual[lengths <= short]).max() < 1e-5 * rms
    scale = np.mean(np.abs(residual[lengths > short] / (toy.foregrounds * (1 - 3j))[lengths > short]))
    assert scale == pytest.approx(1, abs=1e-3)


def test_baselines_of_the_length_of_an_end_have_weight():
    """28 m of a hexagon are 27.9999.. or 28.00..01 m."""
    lengths, antennas = np.array([14, 28 - 1e-9, 28, 28 + 1e-9, 42]), np.array([[0, 1]] * 5)
    for ends in ({"shortest": "14 m", "longest": "28 m"}, {"shortest": "28 m", "longest": "42 m"}):
        factors = BaselineRange(**ends).factors(lengths, antennas)
        assert factors[1] == factors[2] == factors[3] == 1
        assert factors.sum() == 4


@pytest.mark.parametrize("name", ["sky-based", "skycal"])
def test_antennas_without_any_weight_in_a_taper_are_flagged(name):
    """Their gains would stay where they start: nothing that they change is seen in the loss."""
    calibrator, positions = CALIBRATORS[name]
    far = np.vstack([positions, [[400.0, 0.0, 0.0]]])
    toy = make_toy(far, noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    tapered = calibrator.model_copy(update={"baselines": BaselineRange(taper="60 m")})
    result = run_calibrator(tapered, uvd, sky_of(uvd, toy.foregrounds))
    last = (toy.antennas == len(positions)).any(axis=1)
    flags = flag_cube(result.residual)[0, :, :, 0]
    assert flags[last].all()
    assert not flags[~last].any()
    residual = to_cube(result.residual)[0, :, :, 0]
    assert np.abs(residual[~last]).max() < 1e-5 * np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))


def noisy(seed: int) -> np.ndarray:
    """Return gains that are lost in noise."""
    return 10.0 ** np.random.default_rng(seed).normal(size=(8, 64)).astype(complex)


@pytest.mark.parametrize(("fails", "kept", "status"), [("second", "equal", "max-steps"), ("equal", "first", "stalled")])
def test_where_weights_run_away_and_a_pass_fails(monkeypatch, fails, kept, status):
    """Solves are stubs, whose gains are lost in noise but with equal weights."""
    toy = make_toy(scattered(8), noise=0.1)
    uvd = make_uvdata(toy, n_times=1)
    settings = Calamity(weights=GainWeights(), prior="gains")
    problem = make_problem(prepare(Observation(uvd), settings), settings, slice(0, 1), 0)
    start = noisy(0)
    equal = problem.weighted_by(np.ones_like(toy.gains)).weights
    calls = []

    def stub(current, solver, warm, anew, repeated):
        is_equal = np.array_equal(current.weights, equal)
        calls.append("equal" if is_equal else "pass")
        failing = (fails == "equal") if is_equal else (fails == "second" and calls.count("pass") == 2)
        gains = np.ones_like(start) if is_equal else noisy(len(calls))
        losses, ended = np.array([1.0, 0.5]), "failed" if failing else "converged"
        record = Solve(ended, "", steps=1, loss_history=losses, seconds=0.0, cpu_seconds=0.0)
        return Solution(gains, problem.visibilities, record), warm, anew

    monkeypatch.setattr(calamity, "_solve", stub)
    found = calamity._Passes(settings, make_solver(settings), (0, 0)).solve(problem, WarmStart(start, None), None)
    assert calls[-1] == "equal"
    assert found.solution.record.status == status
    assert np.array_equal(found.solution.gains, np.ones_like(start) if kept == "equal" else noisy(1))


@pytest.mark.parametrize("spread", [1.0, 0.1])
def test_a_later_pass_of_another_package_that_fails_takes_no_gains_away(monkeypatch, spread):
    """Weights that run away give the gains of equal weights; others those of the pass before."""
    toy = make_toy(scattered(8), noise=0.1)
    uvd = make_uvdata(toy, n_times=1)
    gains = toy.gains * 10.0 ** (spread * np.random.default_rng(1).normal(size=toy.gains.shape))
    passes = []

    def stub(self, measured, groups, before=None):
        passes.append(before)
        if before is None:
            return Solved(gains[..., None].copy(), [Solve("converged", "", seconds=0.0, cpu_seconds=0.0)])
        return Solved(np.full((*gains.shape, 1), np.nan + 0j), [Solve("failed", "", seconds=0.0, cpu_seconds=0.0)])

    monkeypatch.setattr(Skycal, "solve", stub)
    result = run_calibrator(Skycal(), uvd, sky_of(uvd, toy.foregrounds))
    assert len(passes) > 1
    assert statuses(result) == ["max-steps"]
    rows = np.isin(result.gains.ant_array, 10 + 2 * np.arange(len(toy.positions)))
    np.testing.assert_allclose(np.abs(result.gains.gain_array[rows, :, 0, 0]), np.abs(gains))
    assert not result.gains.flag_array[rows].any()


@pytest.mark.parametrize("calibrator", [SkyBased, Skycal])
def test_a_range_that_cuts_the_array_is_refused(calibrator):
    """Nothing tells the phase between two stations whose baselines are left out."""
    stations = np.concatenate([scattered(4), np.add(scattered(4), [300.0, 0.0, 0.0])])
    frame = Observation(make_uvdata(make_toy(stations), n_times=1))
    assert calibrator().refusal(frame, True) is None
    cut = calibrator(baselines=BaselineRange(longest="150 m"))
    assert "leave 2 parts of the array unconnected" in cut.refusal(frame, True)


@pytest.mark.parametrize("calibrator", [DelayWeighted, EmpiricalBayes, Unified])
def test_a_solver_without_a_name_is_the_calibrators_own(calibrator):
    for solver in ({"max_steps": 50}, {"name": "gauss-newton", "max_steps": 50}):
        found = calibrator.model_validate({"solver": solver}).solver
        assert (found.tolerance, found.max_steps) == (1e-5, 50)
