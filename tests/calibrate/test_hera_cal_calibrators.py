"""hera_cal's calibrators: exact where they must be, wrong where they are known to be, and honest about either."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hera_cal.redcal import RedundantCalibrator
from toy import HEX, LARGE_HEX, complex_normal, make_toy, scattered, turned
from toy_data import errors, make_uvdata, sky_of, statuses

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.calibrators import redcal
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.calibrators.other_packages import Skycal
from calstudy.calibrate.calibrators.redcal import Redcal
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.settings import FlagWeights

EXACT = 1e-7
"""Of noiseless fits, which stop when gains change by 1e-8."""
CASES = {"redcal": (Redcal(), LARGE_HEX), "skycal": (Skycal(), scattered(8))}


@pytest.fixture(scope="module", params=list(CASES))
def case(request):
    calibrator, positions = CASES[request.param]
    return calibrator, make_toy(positions, noise=0.0)


def test_noiseless_gains_are_exact(case):
    calibrator, toy = case
    toy = turned(toy)
    uvd = make_uvdata(toy, n_times=1, polarizations=(-5, -6))
    result = run_calibrator(calibrator, uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["converged"] * 2
    for polarization in (0, 1):
        # Data of the toys' polarizations differ by 1e-4 in amplitude, and so do gains by half of that.
        size = abs(to_cube(uvd)[0, ..., polarization] / toy.visibilities).mean() ** 0.5
        found = errors(result, replace(toy, gains=size * toy.gains), polarization=polarization)
        assert np.abs(found).max() < EXACT
    rms = np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    assert np.abs(result.residual.data_array).max() < 10 * EXACT * rms
    total = result.gains.gain_array[~result.gains.flag_array.all(axis=(1, 2, 3))].sum(axis=0)
    assert np.abs(total.imag).max() < 1e-10
    assert total.real.min() > 0


def test_flags_have_no_influence_and_gains_without_data_are_flagged(case):
    calibrator, toy = case
    uvd = make_uvdata(toy, n_times=1)
    cube, flags = to_cube(uvd).copy(), np.zeros(to_cube(uvd).shape, bool)
    dead = (toy.antennas == 3).any(axis=1)
    flags[:, dead] = True
    flags[:, :, 10:12] = True
    # Antenna 5 lacks a channel, and one sample in fifty is flagged on its own.
    flags[:, (toy.antennas == 5).any(axis=1), 20] = True
    flags |= np.random.default_rng(1).random(flags.shape) < 0.02
    cube[flags] = 1e6
    uvd = from_cube(uvd, cube)
    uvd.flag_array = flags.reshape(uvd.data_array.shape)
    # Sky models may be anything where the data are flagged.
    sky = sky_of(uvd, np.where(flags[0, :, :, 0], np.nan, toy.foregrounds))
    result = run_calibrator(calibrator, uvd, sky)
    found = errors(
        result, replace(toy, gains=toy.gains * abs(to_cube(uvd)[0, 7, 0, 0] / toy.visibilities[7, 0]) ** 0.5)
    )
    expected = np.zeros(found.shape, bool)
    expected[3], expected[:, 10:12], expected[5, 20] = True, True, True
    np.testing.assert_array_equal(np.isnan(found), expected)
    assert np.nanmax(np.abs(found)) < EXACT
    assert statuses(result) == ["converged"]


def test_integrations_that_share_their_gains(case):
    calibrator, toy = case
    uvd = make_uvdata(toy, n_times=5)
    # The third has no data, the last is a group of its own.
    uvd.flag_array[2 * uvd.Nbls : 3 * uvd.Nbls] = True
    shared = calibrator.model_copy(update={"integrations_per_solve": 2})
    result = run_calibrator(shared, uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["converged"] * 3
    gains = result.gains.gain_array
    np.testing.assert_array_equal(gains[:, :, 0], gains[:, :, 1])
    assert np.abs(errors(result, toy, 0)).max() < 1e-3
    # A gain that integrations share is flagged where there are no data, by every calibrator.
    present = np.isin(result.gains.ant_array, uvd.ant_1_array)
    assert result.gains.flag_array[:, :, 2].all()
    assert not result.gains.flag_array[present][:, :, [0, 1, 3, 4]].any()


def test_skycal_is_sky_based_calibration_of_several_integrations(toy):
    rng = np.random.default_rng(2)
    uvd = make_uvdata(toy, n_times=3)
    cube = to_cube(uvd) + 0.05 * np.abs(toy.foregrounds).mean() * complex_normal(rng, to_cube(uvd).shape)
    uvd = from_cube(uvd, cube)
    wrong = toy.foregrounds + 0.1 * np.abs(toy.foregrounds).mean() * complex_normal(rng, toy.foregrounds.shape)
    ours = SkyBased.model_validate({"integrations_per_solve": 3, "solver": {"precision": "double", "tolerance": 1e-13}})
    found = [
        run_calibrator(settings, uvd, sky_of(uvd, wrong)).gains.gain_array[:, :, 0, 0]
        for settings in (Skycal(integrations_per_solve=3), ours)
    ]
    assert np.abs(fix_phase(*found) - found[1]).max() < 1e-6


def test_logcal_pulls_weak_antennas_up_and_omnical_does_not():
    """E ln |V + n| > ln |V|, more so where V is small: the amplitudes of weak antennas come out too large.

    So it is for noise that is the same on all baselines, whose inverse variances are equal weights. Of noise that is
    received with the sky weak antennas have no more than others.
    """
    toy = make_toy(LARGE_HEX, noise=0.0)
    weak = np.arange(len(LARGE_HEX)) % 2 == 1
    toy = replace(toy, gains=np.where(weak, 0.5, 1.0)[:, None] * np.exp(1j * np.angle(toy.gains)))
    uvd = make_uvdata(toy, n_times=2)
    noise = 0.3 * np.sqrt(np.mean(np.abs(toy.foregrounds) ** 2))
    cube = to_cube(uvd) + noise * complex_normal(np.random.default_rng(3), to_cube(uvd).shape)
    uvd = from_cube(uvd, cube)
    ratios, scatter = {}, {}
    for steps in (("logcal", "abscal"), ("logcal", "omnical", "abscal")):
        result = run_calibrator(Redcal(steps=steps, weights=FlagWeights()), uvd, sky_of(uvd, toy.foregrounds))
        rows = np.isin(result.gains.ant_array, 10 + 2 * np.arange(len(weak)))
        amplitude = np.abs(result.gains.gain_array[rows, :, :, 0])
        ratio = amplitude[weak].mean(axis=0) / amplitude[~weak].mean(axis=0)
        ratios[steps[1]], scatter[steps[1]] = ratio.mean(), ratio.std() / np.sqrt(ratio.size)
    assert ratios["abscal"] > 0.5 + 10 * scatter["abscal"]
    assert ratios["abscal"] - 0.5 > 5 * abs(ratios["omnical"] - 0.5)


def test_cells_with_the_same_weights_are_solved_together(monkeypatch):
    """With and without, logcal of noisy data is the same: here with four sets of baselines that are not flagged."""
    toy = make_toy(LARGE_HEX, noise=0.05)
    uvd = make_uvdata(toy, n_times=2)
    flags = np.zeros(to_cube(uvd).shape, bool)
    flags[:, 4, 20:40] = True
    flags[1, 7:12, 30:] = True
    uvd.flag_array = flags.reshape(uvd.data_array.shape)
    found, calls = {}, []
    true = RedundantCalibrator.logcal
    monkeypatch.setattr(RedundantCalibrator, "logcal", lambda *args, **more: (calls.append(1), true(*args, **more))[1])
    for cells in (redcal.CELLS_OF_A_SET, 10**9):
        monkeypatch.setattr(redcal, "CELLS_OF_A_SET", cells)
        calibrator = Redcal(steps=("firstcal", "logcal"), weights=FlagWeights())
        result = run_calibrator(calibrator, uvd, sky_of(uvd, toy.foregrounds))
        found[cells] = result.gains.gain_array
    assert len(calls) == 4 + 1
    together, apart = found.values()
    np.testing.assert_allclose(together, apart, rtol=1e-10)


def test_omnical_is_that_of_hera_cal(monkeypatch):
    """Of noisy data, with unequal weights, it takes the same steps to the same gains."""
    toy = make_toy(HEX, noise=1e-2)
    uvd, found = make_uvdata(toy), {}
    for make in (redcal._calibrator, RedundantCalibrator):
        monkeypatch.setattr(redcal, "_calibrator", make)
        result = run_calibrator(Redcal(), uvd, sky_of(uvd, toy.foregrounds))
        found[make] = result.gains.gain_array, [solution.steps for solution in result.solutions]
    (ours, our_steps), (theirs, their_steps) = found.values()
    assert our_steps == their_steps
    np.testing.assert_allclose(ours, theirs, rtol=1e-10)


def test_a_pass_after_one_that_converged_starts_from_its_gains(monkeypatch):
    """All steps of every pass lead to the same gains: here with baselines that are redundant to some percent."""
    toy = make_toy(LARGE_HEX, noise=0.0)
    uvd = make_uvdata(toy, n_times=2)
    cube = to_cube(uvd) * (1 + 0.03 * complex_normal(np.random.default_rng(8), to_cube(uvd).shape))
    uvd, sky = from_cube(uvd, cube), sky_of(uvd, toy.foregrounds)
    found, firsts = {}, {}
    true = RedundantCalibrator.firstcal
    for again in (redcal.AGAIN, redcal.STEPS):
        calls = []
        monkeypatch.setattr(redcal, "AGAIN", again)
        monkeypatch.setattr(
            RedundantCalibrator,
            "firstcal",
            lambda *args, calls=calls, **more: (calls.append(1), true(*args, **more))[1],
        )
        result = run_calibrator(Redcal(), uvd, sky)
        assert statuses(result) == ["converged"] * 2
        assert result.solutions[0].diagnostics["passes"] > 1
        found[again], firsts[again] = result.gains.gain_array, len(calls)
    # Omnical stops when gains change by 1e-8, with 0.3 of each step.
    np.testing.assert_allclose(found[redcal.STEPS], found[("omnical", "abscal")], rtol=0, atol=1e-6)
    assert firsts[("omnical", "abscal")] == 2 < firsts[redcal.STEPS]


def test_abscal_turns_the_sky_to_where_the_model_has_it():
    """Sources that the model has elsewhere by one angle are a phase gradient of the gains, which redundancy allows."""
    toy = make_toy(LARGE_HEX, noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    gradient = 0.02 * np.array([0.8, 0.6, 0.0])
    model = toy.foregrounds * np.exp(1j * (toy.vectors @ gradient))[:, None]
    result = run_calibrator(Redcal(), uvd, sky_of(uvd, model))
    assert statuses(result) == ["converged"]
    expected = toy.gains * np.exp(1j * (toy.positions @ gradient))[:, None]
    size = abs(to_cube(uvd)[0, ..., 0] / toy.visibilities).mean() ** 0.5
    assert np.abs(errors(result, replace(toy, gains=size * expected))).max() < EXACT
    # The data fit perfectly, with gains that are wrong by a tenth and more.
    assert np.abs(result.residual.data_array).max() < 1e-5 * np.abs(model).max()
    assert np.abs(fix_phase(expected, toy.gains) - toy.gains).mean() > 0.1


def test_without_abscal_a_phase_gradient_and_the_amplitude_stay_open():
    toy = make_toy(LARGE_HEX, noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    result = run_calibrator(Redcal(steps=("logcal", "omnical")), uvd, sky_of(uvd, toy.foregrounds))
    rows = np.isin(result.gains.ant_array, 10 + 2 * np.arange(len(toy.positions)))
    ratio = result.gains.gain_array[rows, :, 0, 0] / toy.gains
    np.testing.assert_allclose(np.abs(ratio / ratio[:1]), 1, atol=EXACT)
    design = np.column_stack([toy.positions[:, :2], np.ones(len(toy.positions))])
    phases = np.unwrap(np.angle(ratio / ratio[:1]), axis=0)
    fitted = design @ np.linalg.lstsq(design, phases, rcond=None)[0]
    assert np.abs(np.exp(1j * (phases - fitted)) - 1).max() < EXACT
    assert np.abs(np.abs(ratio) - 1).max() > 1e-3


def test_statuses_are_those_of_the_fits():
    toy = make_toy(LARGE_HEX, noise=0.0)
    uvd = make_uvdata(toy, n_times=2)
    cube = to_cube(uvd) * (1 + 0.1 * complex_normal(np.random.default_rng(4), to_cube(uvd).shape))
    uvd, sky = from_cube(uvd, cube), sky_of(uvd, toy.foregrounds)
    result = run_calibrator(Redcal(max_steps=10), uvd, sky)
    assert statuses(result) == ["max-steps"] * 2
    assert "did not converge within 10 steps" in result.solutions[0].message
    result = run_calibrator(Skycal(max_steps=1), uvd, sky)
    assert statuses(result) == ["failed"] * 2
    assert result.gains.flag_array.all()
    uvd.flag_array[: uvd.Nbls] = True
    # A single row of antennas is left in the second integration: nothing ties its amplitudes together.
    kept = np.isin(toy.antennas, [0, 1, 2]).all(axis=1)
    uvd.flag_array[uvd.Nbls :][~kept] = True
    result = run_calibrator(Redcal(), uvd, sky)
    assert statuses(result) == ["skipped", "failed"]
    assert "do not tie" in result.solutions[1].message


@pytest.mark.parametrize("calibrator", [Redcal(), Skycal()])
def test_a_sky_model_is_needed(calibrator, hexagon):
    with pytest.raises(InputError, match="needs a sky model"):
        run_calibrator(calibrator, make_uvdata(hexagon))


def test_arrays_that_are_not_redundant_are_refused(toy, hexagon):
    uvd = make_uvdata(toy)
    with pytest.raises(InputError, match=r"leave 8 amplitudes and 8 phases of 8 antennas open .* not redundant enough"):
        run_calibrator(Redcal(), uvd, sky_of(uvd, toy.foregrounds))
    assert Redcal().refusal(Observation(make_uvdata(hexagon)), True) is None
    # Two hexagons far apart, with nothing between that repeats: each is redundant, and they know nothing of each other.
    far = make_toy(np.concatenate([HEX, 1.3 * HEX + [300, 100, 0]]), noise=0.0)
    reason = Redcal().refusal(Observation(make_uvdata(far, n_times=1)), True)
    assert reason is not None
    assert "leave 2 amplitudes and 6 phases of 14 antennas" in reason


@pytest.mark.parametrize(
    ("steps", "told"), [(["omnical", "logcal"], "in this order"), (["lincal"], "lincal"), ([], "at least 1")]
)
def test_steps_that_make_no_sense_are_refused(steps, told):
    with pytest.raises(ValueError, match=told):
        Redcal.model_validate({"steps": steps})
