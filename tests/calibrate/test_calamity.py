"""From UVData to UVCal and back: conventions, flags, records, and inputs left alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pyuvdata.utils import uvcalibrate
from toy import HEX, make_toy, scattered
from toy_data import ONE_SOLVE, SETTINGS, make_uvdata, sky_of

from calstudy.base.visibilities import antenna_pairs, from_cube, to_cube
from calstudy.calibrate.calibrators.least_squares import Calamity, CalamityRedundant, SkyBased
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import AdamaxSettings, FlagWeights, GaussNewtonSettings


def products(result, polarization=0):
    """g_a g_b* of a fit, shape (Ntimes, Nbls, Nfreqs)."""
    first, second = np.searchsorted(result.gains.ant_array, antenna_pairs(result.model)).T
    gains = result.gains.gain_array[..., polarization]
    return (gains[first] * gains[second].conj()).transpose(2, 0, 1)


def fitted(result, polarization=0):
    """The data without noise according to a fit, g g* F, shape (Ntimes, Nbls, Nfreqs)."""
    return products(result, polarization) * to_cube(result.model)[..., polarization]


def assert_same_fit(one, other, toy):
    """Two solves of the same data fit them alike to much less than the noise.

    They need not be the same to the last digit: along directions that the data hardly see, rounding decides where a
    solve stops, which moves single gains by several percent and what is fitted by a few hundredths of the noise.
    """
    noise = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    assert np.sqrt(np.mean(np.abs(one - other) ** 2)) < 0.1 * noise


@pytest.fixture(scope="module")
def data(toy):
    return make_uvdata(toy)


@pytest.fixture(scope="module")
def result(data):
    return run_calibrator(SETTINGS, data)


def test_products_follow_pyuvdatas_conventions(data, result):
    gains = result.gains
    assert gains.gain_convention == "divide"
    assert gains.gain_array.shape == (8, 64, 3, 1)
    assert not gains.flag_array.any()
    gains.check()
    raw = data.copy()
    raw.vis_units, raw.pol_convention = "uncalib", None
    calibrated = uvcalibrate(raw, gains, inplace=False)
    expected = to_cube(result.model) + to_cube(result.residual)
    assert np.abs(to_cube(calibrated) - expected).max() < 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize(("prior", "unit", "convention"), [("sky-model", "Jy", "avg"), ("gains", "uncalib", None)])
def test_calibrated_data_have_the_unit_of_what_fixes_their_scale(toy, data, prior, unit, convention):
    raw, sky = data.copy(), sky_of(data, toy.foregrounds)
    raw.vis_units, raw.pol_convention, sky.pol_convention = "uncalib", None, "avg"
    found = run_calibrator(Calamity(prior=prior, solver=GaussNewtonSettings(max_steps=1)), raw, sky)
    assert (found.gains.gain_scale, found.gains.pol_convention) == (unit, convention)
    for uvd in (found.model, found.residual):
        assert (uvd.vis_units, uvd.pol_convention) == (unit, convention)
        uvd.check()


def test_residual_is_at_the_noise(toy, result):
    truth, noise = toy.foregrounds, np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    residual = to_cube(result.residual)[..., 0]
    assert np.sqrt(np.mean(np.abs(residual) ** 2)) < noise
    error = fitted(result)[0] - gain_products(toy.gains, toy.antennas) * truth
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < noise


def test_records_tell_each_solve(data, result):
    assert [record.integration for record in result.solutions] == [0, 1, 2]
    assert {record.status for record in result.solutions} == {"converged"}
    summary = json.loads(json.dumps(result.summary()))
    assert summary["by_status"] == {"converged": 3}
    first, *warm = summary["records"]
    assert first["last_loss"] < 1e-3 * first["first_loss"]
    assert all(record["last_loss"] <= record["first_loss"] < 2 * first["last_loss"] for record in warm)


def test_inputs_are_not_mutated(toy):
    data, sky = make_uvdata(toy, 1), make_uvdata(toy, 1)
    data.flag_array[0, 5] = True
    data.data_array[0, 5] = np.nan
    before, sky_before = data.copy(), sky.copy()
    run_calibrator(SETTINGS, data, sky)
    assert np.array_equal(data.data_array, before.data_array, equal_nan=True)
    assert np.array_equal(data.flag_array, before.flag_array)
    assert sky == sky_before


def test_flags_are_carried_and_have_no_influence(toy):
    data = make_uvdata(toy, 3)
    pairs = antenna_pairs(data)
    flags = data.flag_array.reshape(3, -1, 64)
    flags[1] = True
    flags[:, (pairs == 14).any(1)] = True
    flags[:, :, 7] = True
    flags[0, 4, 30:35] = True
    spoiled = data.copy()
    spoiled.data_array[spoiled.flag_array] = 1e6
    spoiled.data_array[0, 7] = np.nan
    result, again = run_calibrator(SETTINGS, data), run_calibrator(SETTINGS, spoiled)
    used = ~flags
    assert_same_fit(fitted(result)[used], fitted(again)[used], toy)
    assert np.isfinite(again.gains.gain_array).all()
    assert not again.residual.data_array[data.flag_array].any()
    assert [record.status for record in result.solutions] == ["converged", "skipped", "converged"]
    assert "flagged" in result.solutions[1].message
    assert np.array_equal(result.residual.flag_array, data.flag_array)
    gain_flags = result.gains.flag_array[..., 0]
    dead = list(result.gains.ant_array).index(14)
    assert gain_flags[:, :, 1].all()
    assert gain_flags[dead].all()
    assert gain_flags[:, 7].all()
    assert not np.delete(np.delete(gain_flags[:, :, [0, 2]], 7, 1), dead, 0).any()


@pytest.mark.parametrize("calibrator", [Calamity, pytest.param(CalamityRedundant, marks=pytest.mark.chain)])
def test_flagged_edges_of_the_band_are_as_if_it_had_no_such_channels(calibrator):
    # Sequences of the whole band would let foregrounds follow smooth gains that all antennas share: gains then differ
    # by a tenth after two steps. Further steps amplify rounding along directions that data hardly see.
    solver = GaussNewtonSettings(tolerance=1e-9, max_steps=2, precision="double")
    settings = calibrator(basis=SETTINGS.basis, solver=solver)
    toy, band = make_toy(HEX), np.arange(3, 62)
    data = make_uvdata(toy, 1)
    inside = run_calibrator(settings, data.select(freq_chans=band, inplace=False)).gains.gain_array
    data.flag_array[:, np.delete(np.arange(64), band)] = True
    flagged = run_calibrator(settings, data).gains.gain_array[:, band]
    np.testing.assert_allclose(flagged, inside, rtol=1e-4)


def test_restricted_gains_between_flagged_edges_are_as_if_there_were_no_such_channels():
    # 18 sequences of 48 channels; 21 of 64, cut at the edges, would let the fit follow more of the noise. The phase of
    # smooth gains that all antennas share is hardly determined, so that products are compared.
    solver = GaussNewtonSettings(tolerance=1e-9, max_steps=10, precision="double")
    settings = SkyBased(gain_delay="200 ns", weights=FlagWeights(), solver=solver)
    toy, band = make_toy(HEX), np.arange(8, 56)
    data = make_uvdata(toy, 1)
    sky = from_cube(data, toy.foregrounds[None, :, :, None])
    parts = [uvd.select(freq_chans=band, inplace=False) for uvd in (data, sky)]
    inside = run_calibrator(settings, *parts).gains.gain_array[:, :, 0, 0]
    data.flag_array[:, np.delete(np.arange(64), band)] = True
    flagged = run_calibrator(settings, data, sky).gains
    found, expected = (gain_products(gains, toy.antennas) for gains in (flagged.gain_array[:, band, 0, 0], inside))
    # The fits are the same up to rounding; with sequences of all channels products differ by up to 0.2.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_band_that_is_too_narrow_between_flagged_edges_is_skipped(toy):
    data = make_uvdata(toy, 2)
    data.flag_array.reshape(2, -1, 64)[0, :, 4:] = True
    result = run_calibrator(SETTINGS, data)
    assert [record.status for record in result.solutions] == ["skipped", "converged"]
    assert "fills all 4 channels" in result.solutions[0].message


def test_sky_model_sets_the_scale(toy, data):
    truth = from_cube(data, np.repeat(toy.foregrounds[None, :, :, None], 3, 0))
    louder = from_cube(data, 4 * to_cube(truth))
    result = run_calibrator(SETTINGS, data, truth)
    quadruple = run_calibrator(SETTINGS, data, louder)
    for fit, sky in ((result, truth), (quadruple, louder)):
        total, expected = fit.model.data_array.sum(), sky.data_array.sum()
        assert total.real * expected.real + total.imag * expected.imag == pytest.approx(abs(total) ** 2, rel=1e-3)
    # The gains of two solves differ by more than their scale, along directions that the data hardly see.
    ratio = np.linalg.norm(quadruple.gains.gain_array) / np.linalg.norm(result.gains.gain_array)
    assert ratio == pytest.approx(0.5, rel=1e-2)
    assert_same_fit(fitted(result), fitted(quadruple), toy)


def test_polarizations_are_solved_independently(toy, result):
    both = make_uvdata(toy, 1, polarizations=(-5, -6))
    solved = run_calibrator(SETTINGS, both)
    assert [record.polarization for record in solved.solutions] == [-5, -6]
    assert list(solved.gains.jones_array) == [-5, -6]
    alone = run_calibrator(SETTINGS, both.select(polarizations=[-6], inplace=False))
    # The second starts from where it would by itself, not from the solution of the first, and ends with the same fit.
    assert solved.solutions[1].loss_history[0] == pytest.approx(alone.solutions[0].loss_history[0], rel=1e-9)
    assert_same_fit(fitted(alone), fitted(solved, 1), toy)


def test_redundant_modelling_of_a_perfect_hexagon():
    toy = make_toy(HEX, noise=1e-3)
    settings = CalamityRedundant(basis=SETTINGS.basis)
    result = run_calibrator(settings, make_uvdata(toy, 2))
    model = to_cube(result.model)[0, :, :, 0]
    same = np.linalg.norm(toy.vectors - toy.vectors[0], axis=1) < 0.1
    assert same.sum() > 1
    assert np.allclose(model[same], model[0], rtol=1e-12, atol=0)
    assert {record.status for record in result.solutions} == {"converged"}


def test_autocorrelations_are_left_out_unless_asked_for():
    # Without them the structure is that of the other tests, which is compiled.
    toy = make_toy(scattered(8), autos=True)
    data = make_uvdata(toy, 1)
    assert run_calibrator(SETTINGS, data).model.Nbls == 28
    result = run_calibrator(SETTINGS.model_copy(update={"autos": True}), data)
    assert result.model.Nbls == 36
    noise = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    assert np.sqrt(np.mean(np.abs(result.residual.data_array) ** 2)) < noise


def test_not_converging_is_recorded_not_raised(data):
    settings = ONE_SOLVE.model_copy(update={"solver": GaussNewtonSettings(max_steps=1)})
    result = run_calibrator(settings, data)
    assert {record.status for record in result.solutions} == {"max-steps"}
    assert not result.gains.flag_array.any()


@pytest.mark.chain
def test_adamax_is_one_setting_away(data):
    settings = ONE_SOLVE.model_copy(update={"solver": AdamaxSettings(name="adamax", max_steps=100)})
    ticks = []
    result = run_calibrator(settings, data, progress=lambda done, total: ticks.append((done, total)))
    assert ticks == [(1, 3), (2, 3), (3, 3)]
    assert all(record.steps == 100 for record in result.solutions)


def test_bad_data_are_refused_in_one_sentence(toy, data):
    broken = data.copy()
    broken.data_array[3, 4] = np.nan
    with pytest.raises(ValueError, match="1 unflagged visibilities are not finite, the first on baseline"):
        run_calibrator(SETTINGS, broken)
    with pytest.raises(ValueError, match="sky model must have"):
        run_calibrator(SETTINGS, data, make_uvdata(toy, 2))
    with pytest.raises(ValueError, match="no autocorrelations"):
        run_calibrator(SETTINGS.model_copy(update={"autos": True}), data)
    crossed = data.copy()
    crossed.polarization_array = np.array([-7])
    with pytest.raises(ValueError, match="polarizations: xy; calibration takes xx, yy"):
        run_calibrator(SETTINGS, crossed)
