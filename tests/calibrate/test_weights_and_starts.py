"""Weights and first gains from data and files, and what happens when they do not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyuvdata import UVFlag
from toy import FREQUENCIES, complex_normal, make_toy, scattered
from toy_data import ONE_SOLVE, SETTINGS, errors, make_uvdata, sky_of, statuses

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_pairs, to_cube
from calstudy.calibrate.calibrators.least_squares import DelayWeighted, SkyBased
from calstudy.calibrate.calibrators.other_packages import Measured, Skycal
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.preparation import starting_gains
from calstudy.calibrate.problem import gain_products, gain_weights
from calstudy.calibrate.settings import AutoWeights, FileStart, FileWeights, FlagWeights, ForegroundPrior, SampleWeights
from calstudy.calibrate.weights import inverse_variances, make_weights
from calstudy.realdata.noise import radiometer_variance, sample_noise


def everything(data):
    return np.ones(data.Nbls, bool)


@pytest.fixture(scope="module")
def result(toy):
    return run_calibrator(SETTINGS, make_uvdata(toy, 2))


def test_flag_weights_are_the_papers(toy):
    data = make_uvdata(toy, 2)
    data.flag_array[3, :9] = True
    weights = make_weights(Observation(data), everything(data), FlagWeights())
    assert np.allclose(weights[weights > 0], 1 / (28 * 64), rtol=1e-12)
    assert (weights == 0).sum() == 9


def test_sample_weights_follow_the_counts(toy):
    data = make_uvdata(toy, 1)
    data.nsample_array[4] = 3
    data.nsample_array[5] = 0
    weights = make_weights(Observation(data), everything(data), SampleWeights(kind="nsamples"))[0, :, :, 0]
    assert np.allclose(weights[4], 3 * weights[0])
    assert (weights[5] == 0).all()
    assert weights[np.arange(28) != 5].mean() == pytest.approx(1 / (28 * 64))


@pytest.mark.parametrize("calibrator", [SkyBased, Skycal])
def test_integrations_that_share_gains_keep_their_weights(calibrator):
    """One of a hundred measurements beside a single one: the gains are at least as good as by the first alone."""
    toy = make_toy(scattered(6), noise=0.1)
    data, rng = make_uvdata(toy, 2), np.random.default_rng(3)
    sky = sky_of(data, toy.foregrounds)
    counts = np.array([1.0, 100.0])[:, None, None, None]
    clean = gain_products(toy.gains, toy.antennas)[None, :, :, None] * to_cube(sky)
    scale = 0.1 * np.sqrt(np.mean(np.abs(clean) ** 2))
    data.data_array = (clean + scale * complex_normal(rng, clean.shape) / np.sqrt(counts)).reshape(
        data.data_array.shape
    )
    data.nsample_array[:] = np.broadcast_to(counts, clean.shape).reshape(data.nsample_array.shape)
    weights = make_weights(Observation(data), everything(data), SampleWeights(kind="nsamples"), [slice(0, 2)])
    assert weights[1].sum() / weights[0].sum() == pytest.approx(100)
    assert weights.sum() == pytest.approx(2)
    rms = []
    for together in (1, 2):
        settings = calibrator(weights=SampleWeights(kind="nsamples"), integrations_per_solve=together)
        rms.append(np.sqrt(np.mean(np.abs(errors(run_calibrator(settings, data, sky), toy, integration=1)) ** 2)))
    assert rms[1] < 1.02 * rms[0]


def test_weights_by_gains_of_a_group_keep_those_of_its_integrations():
    toy = make_toy(scattered(5))
    frame = Observation(make_uvdata(toy, 2))
    weights = np.ones((2, *toy.foregrounds.shape)) * np.array([1.0, 100.0])[:, None, None]
    measured = Measured(frame, weights, weights, weights)
    found = measured.weighted_by(toy.gains[..., None], [slice(0, 2)]).weights
    np.testing.assert_allclose(found[1], 100 * found[0])
    assert found.sum() == pytest.approx(weights.sum())


def test_auto_weights_are_inverse_variances():
    toy = make_toy(scattered(5), autos=True)
    data = make_uvdata(toy, 2)
    pairs = antenna_pairs(data)
    cross = pairs[:, 0] != pairs[:, 1]
    weights = make_weights(Observation(data), cross, AutoWeights(kind="autos"))
    power = {int(a): to_cube(data)[:, row].real for row, (a, b) in enumerate(pairs) if a == b}
    expected = np.stack([1 / (power[int(a)] * power[int(b)]) for a, b in pairs[cross]], axis=1)
    ratio = weights / expected
    assert np.allclose(ratio, ratio[:, :1, :1], rtol=1e-10)
    settings = SETTINGS.model_copy(update={"weights": AutoWeights(kind="autos")})
    lacking = make_uvdata(make_toy(scattered(5)), 1)
    with pytest.raises(InputError, match="'autos' needs autocorrelations, which the data lack for antenna"):
        run_calibrator(settings, lacking)


@pytest.fixture
def measured():
    """Data with autocorrelations, uneven numbers of samples, none in places, and half an autocorrelation flagged."""
    data = make_uvdata(make_toy(scattered(5), autos=True), 2)
    pairs = antenna_pairs(data)
    rng = np.random.default_rng(12)
    shape = (2, data.Nbls, data.Nfreqs, 1)
    counts, flags = rng.integers(1, 5, shape).astype(float), np.zeros(shape, bool)
    counts[1, 3, :7] = 0
    flags[0, np.flatnonzero((pairs == pairs[0, 0]).all(axis=1)), : data.Nfreqs // 2] = True
    data.nsample_array, data.flag_array = counts.reshape(data.data_array.shape), flags.reshape(data.data_array.shape)
    return data


@pytest.mark.parametrize("count", [np.nan, -1.0])
@pytest.mark.parametrize("settings", [AutoWeights(kind="autos"), SampleWeights(kind="nsamples")])
def test_counts_that_are_none_are_refused(measured, settings, count):
    cross = np.not_equal(*antenna_pairs(measured).T)
    measured.nsample_array[np.flatnonzero(measured.ant_1_array != measured.ant_2_array)[0], 3] = count
    with pytest.raises(InputError, match=f"weights: '{settings.kind}' needs counts .*, and 1 unflagged samples"):
        make_weights(Observation(measured), cross, settings)


@pytest.mark.parametrize("settings", [AutoWeights(kind="autos"), SampleWeights(kind="nsamples"), FlagWeights()])
def test_weights_of_finite_priors_are_inverse_variances(measured, settings):
    """Against the radiometer equation, and against a noise that is given for samples that were measured once."""
    pairs = antenna_pairs(measured)
    cross = pairs[:, 0] != pairs[:, 1]
    prior = ForegroundPrior(mean="sky-model", deviation=0.1)
    calibrator = DelayWeighted(weights=settings, foreground_prior=prior)
    observation, noise = Observation(measured), None if settings.kind == "autos" else 2.5
    weights = make_weights(observation, cross, settings)
    found = inverse_variances(observation, cross, weights, calibrator, noise)[..., 0]
    counts = measured.nsample_array.reshape(2, measured.Nbls, -1)[:, cross]
    if settings.kind == "autos":
        variance = radiometer_variance(measured, pairs[cross], 0)
        assert np.array_equal(found > 0, np.isfinite(variance))
        assert np.allclose(found[found > 0], 1 / variance[found > 0], rtol=1e-9)
    elif settings.kind == "nsamples":
        assert np.allclose(found, counts / 2.5**2, rtol=1e-9)
    else:
        # All samples have the mean of what they should have.
        assert np.allclose(found.mean(axis=(1, 2)), counts.mean(axis=(1, 2)) / 2.5**2, rtol=1e-9)


def test_noise_of_measured_data_is_that_of_a_sample_that_was_measured_once(measured):
    once = measured.copy()
    once.nsample_array = np.ones(measured.data_array.shape)
    crosses = antenna_pairs(measured)
    crosses = crosses[crosses[:, 0] != crosses[:, 1]]
    expected = np.nanmean(1 / radiometer_variance(once, crosses, 0)) ** -0.5
    assert sample_noise(once) == pytest.approx(expected)
    four_times = once.copy()
    four_times.nsample_array = 4 * once.nsample_array
    assert sample_noise(four_times) == pytest.approx(expected)
    assert sample_noise(make_uvdata(make_toy(scattered(5)), 1)) is None


def test_weights_from_gains_are_inverse_variances_where_amplitudes_differ():
    """The level of the noise is from autocorrelations; with the rms over samples it would be too low."""
    data = make_uvdata(make_toy(scattered(5), autos=True), 1)
    pairs = antenna_pairs(data)
    cross = pairs[:, 0] != pairs[:, 1]
    gains = np.exp(0.3 * np.random.default_rng(13).normal(size=(5, FREQUENCIES.size)))
    first, second = np.searchsorted(np.unique(pairs), pairs).T
    products = gains[first] * gains[second]
    data.data_array[~cross] = 3e4 * products[~cross][..., None]
    data.nsample_array = np.full(data.data_array.shape, 2.0)
    observation, settings = Observation(data), FlagWeights()
    calibrator = DelayWeighted(foreground_prior=ForegroundPrior(mean="sky-model", deviation=0.1))
    equal = make_weights(observation, cross, settings)
    unity = inverse_variances(observation, cross, equal, calibrator, sample_noise(data))[0, :, :, 0]
    found = gain_weights(unity, products[cross])
    assert np.allclose(found, 1 / radiometer_variance(data, pairs[cross], 0)[0], rtol=1e-9)


def uvflag(data, values, path):
    flags = UVFlag(data, mode="metric")
    flags.metric_array = values
    flags.write(str(path))
    return FileWeights(kind="file", path=path)


def test_weights_of_a_file_are_found_by_baseline_and_time(toy, tmp_path):
    data = make_uvdata(toy, 3)
    values = np.random.default_rng(4).uniform(0.5, 2, data.data_array.shape)
    settings = uvflag(data, values, tmp_path / "w.h5")
    part = data.select(times=np.unique(data.time_array)[1:], inplace=False)
    weights = make_weights(Observation(part), everything(part), settings)
    wanted = values.reshape(3, 28, 64, 1)[1:]
    assert np.allclose(weights / wanted, (weights / wanted)[:, :1, :1], rtol=1e-10)
    later = data.copy()
    later.time_array = later.time_array + 1
    with pytest.raises(InputError, match="no weights for some baselines or integrations"):
        make_weights(Observation(later), everything(data), settings)
    with pytest.raises(InputError, match="finite and not negative"):
        make_weights(Observation(data), everything(data), uvflag(data, -values, tmp_path / "n.h5"))
    (tmp_path / "x.h5").write_text("")
    with pytest.raises(InputError, match="not a readable UVFlag"):
        make_weights(Observation(data), everything(data), FileWeights(kind="file", path=tmp_path / "x.h5"))


def test_weights_of_a_file_are_needed_for_samples_with_data(toy, tmp_path):
    """Those of a file whose rows are those of the measurement, where a baseline lacks an integration."""
    data = make_uvdata(toy, 2)
    part = data.select(blt_inds=np.delete(np.arange(data.Nblts), 5), inplace=False)
    settings = uvflag(part, np.ones(part.data_array.shape), tmp_path / "w.h5")
    with pytest.raises(InputError, match="no weights for some baselines or integrations"):
        make_weights(Observation(data), everything(data), settings)
    data.flag_array[5] = True
    weights = make_weights(Observation(data), everything(data), settings)
    assert np.array_equal(weights > 0, ~Observation(data).flags)


def test_weights_of_a_file_are_those_of_feeds_of_the_same_direction(toy, tmp_path):
    data = make_uvdata(toy, 1, (-5, -6))
    north = data.copy()
    north.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"])
    values = np.random.default_rng(5).uniform(0.5, 2, data.data_array.shape)
    settings = uvflag(north, values, tmp_path / "w.h5")
    weights = make_weights(Observation(data), everything(data), settings)
    ratios = weights / values[None, :, :, ::-1]
    assert np.allclose(ratios, ratios[:, :1, :1], rtol=1e-10)


def test_complex_weights_are_refused(toy, tmp_path, monkeypatch):
    data = make_uvdata(toy, 1)
    settings = uvflag(data, np.ones(data.data_array.shape), tmp_path / "w.h5")
    file = UVFlag(str(tmp_path / "w.h5"))
    file.metric_array = file.metric_array * 1j
    monkeypatch.setattr("calstudy.calibrate.weights._read_uvflag", lambda path, where: file)
    with pytest.raises(InputError, match="weights must be real"):
        make_weights(Observation(data), everything(data), settings)


def test_zero_weights_everywhere_are_skipped_solves(toy):
    data = make_uvdata(toy, 2)
    data.nsample_array[:] = 0
    result = run_calibrator(SETTINGS.model_copy(update={"weights": SampleWeights(kind="nsamples")}), data)
    assert [record.status for record in result.solutions] == ["skipped", "skipped"]
    assert result.gains.flag_array.all()
    assert result.residual.flag_array.all()
    assert (result.gains.gain_array == 1).all()


def test_starting_at_the_solution_takes_fewer_steps(toy, tmp_path):
    data = make_uvdata(toy, 2)
    result = run_calibrator(ONE_SOLVE, data)
    result.gains.write_calh5(str(tmp_path / "g.calh5"))
    settings = ONE_SOLVE.model_copy(update={"initial_gains": FileStart(kind="file", path=tmp_path / "g.calh5")})
    again = run_calibrator(settings, data)
    assert again.solutions[0].steps < result.solutions[0].steps
    assert again.solutions[0].loss_history[0] < 1.01 * result.solutions[0].loss_history[-1]


def test_gains_that_do_not_fit_are_refused(toy, result):
    data = make_uvdata(toy, 2)
    few = result.gains.select(antenna_nums=[10, 12, 14], inplace=False)
    with pytest.raises(InputError, match=r"no solution for antenna\(s\) 16, 18"):
        run_calibrator(SETTINGS, data, gains=few)
    narrow = result.gains.select(freq_chans=np.arange(10), inplace=False)
    with pytest.raises(InputError, match="no channel at"):
        run_calibrator(SETTINGS, data, gains=narrow)


def test_extra_antennas_and_useless_gains_do_no_harm(toy, result):
    part = make_uvdata(toy, 2).select(antenna_nums=[10, 12, 14, 16], inplace=False)
    gains = result.gains.copy()
    gains.gain_array[0, 3] = np.nan
    start = starting_gains(Observation(part), gains)
    assert start.shape == (4, 64, 2, 1)
    assert np.isfinite(start).all()
    assert (start[0, 3] == 1).all()


def test_sky_based_calibration_needs_and_keeps_its_sky(toy):
    data = make_uvdata(toy, 1)
    settings = SkyBased()
    with pytest.raises(InputError, match="'sky-based': needs a sky model"):
        run_calibrator(settings, data)
    sky = data.copy()
    sky.data_array = toy.foregrounds[:, :, None].copy()
    result = run_calibrator(settings, data, sky)
    assert {record.status for record in result.solutions} == {"converged"}
    assert np.allclose(result.model.data_array, sky.data_array, rtol=1e-12)
    noise = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    assert np.sqrt(np.mean(np.abs(result.residual.data_array) ** 2)) < 1.1 * noise


def test_joint_integrations_share_their_gains(toy):
    data = make_uvdata(toy, 5)
    result = run_calibrator(SETTINGS.model_copy(update={"integrations_per_solve": 2}), data)
    gains = result.gains.gain_array[..., 0]
    assert np.array_equal(gains[:, :, 0], gains[:, :, 1])
    assert np.array_equal(gains[:, :, 2], gains[:, :, 3])
    assert not np.array_equal(gains[:, :, 1], gains[:, :, 2])
    assert [(record.integration, record.n_integrations) for record in result.solutions] == [(0, 2), (2, 2), (4, 1)]
    model, residual = to_cube(result.model), to_cube(result.residual)
    pairs = np.searchsorted(result.gains.ant_array, antenna_pairs(data))
    products = gains[pairs[:, 0]] * gains[pairs[:, 1]].conj()
    rebuilt = products.transpose(2, 0, 1)[..., None] * (model + residual)
    assert np.abs(rebuilt - to_cube(data)).max() < 1e-9 * np.abs(to_cube(data)).max()


def test_a_dead_antenna_and_channel_stay_flagged(toy):
    data = make_uvdata(toy, 1)
    pairs = antenna_pairs(data)
    data.flag_array[(pairs == 14).any(1)] = True
    data.flag_array[:, 9] = True
    result = run_calibrator(SETTINGS, data)
    dead = int(np.flatnonzero(result.gains.ant_array == 14)[0])
    flags = result.gains.flag_array[..., 0, 0]
    assert flags[dead].all()
    assert flags[:, 9].all()
    assert not np.delete(np.delete(flags, dead, 0), 9, 1).any()


def test_one_antenna_is_refused(toy):
    only = make_uvdata(make_toy(scattered(3), autos=True), 1).select(bls=[(10, 10)], inplace=False)
    with pytest.raises(ValueError, match="no cross-correlations"):
        run_calibrator(SETTINGS, only)


@pytest.mark.chain
@pytest.mark.parametrize(
    "settings", [SkyBased(gain_delay="200 ns"), SETTINGS.model_copy(update={"gain_delay": 200e-9})]
)
def test_smooth_gains_of_integrations_with_other_flagged_edges(settings):
    # Noise at which the damping is that of the integration before, whose blocks are of another band.
    toy = make_toy(scattered(6), noise=0.1)
    toy = replace(toy, gains=np.full(toy.gains.shape, 1.1 + 0j))
    uvd = make_uvdata(toy, n_times=3)
    uvd.flag_array.reshape(3, -1, FREQUENCIES.size)[1:, :, :4] = True
    found = run_calibrator(settings.model_copy(update={"weights": FlagWeights()}), uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(found) == ["converged"] * 3
