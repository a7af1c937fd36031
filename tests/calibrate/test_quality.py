"""What stands out in measured data is named; an interrupted calibration is resumed; sky models may lack baselines."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run_and_read, run_command
from observations import with_autos
from pyuvdata import UVCal, UVData
from toy import HEX, Toy, make_toy, scattered
from toy_data import ONE_SOLVE, make_uvdata, sky_of

from calstudy.base.errors import InputError
from calstudy.base.visibilities import flag_cube
from calstudy.calibrate.calibrators.given_gains import ByFile, NoCalibration
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.preparation import make_problem
from calstudy.calibrate.records import CalibrationResult, make_gains, make_visibilities
from calstudy.calibrate.settings import FlagWeights, GainFit
from calstudy.calibrate.sky_model import common_baselines
from calstudy.products import calibration as products
from calstudy.products.files import write_visibilities
from calstudy.realdata.quality import assess, chi_squared, count_unknowns, predicted
from calstudy.realdata.reading import prepare
from calstudy.realdata.selection import Selection, select

OPTIONS = ["--set", "calibrator=sky-based"]
N_TIMES, CHANNEL, NOISE = 4, 20, 0.01
ANTENNA = 3
"""Place among the eight antennas."""
SKY_BASED = SkyBased(weights=FlagWeights())


@pytest.fixture(scope="module")
def clean() -> UVData:
    """Data without autocorrelations, with complex noise."""
    uvd = make_uvdata(make_toy(scattered(8)), N_TIMES)
    rng = np.random.default_rng(5)
    draws = rng.normal(size=(2, *uvd.data_array.shape))
    uvd.data_array += NOISE * (draws[0] + 1j * draws[1]) / np.sqrt(2)
    return uvd


def result_of(data: UVData, noise: np.ndarray, gains: np.ndarray | None = None) -> CalibrationResult:
    """Return a calibration whose residual, in the unit of the data, is `noise`, (Ntimes, Nbls, Nfreqs, Npols)."""
    numbers = data.telescope.antenna_numbers
    shape = (len(numbers), data.Nfreqs, data.Ntimes, data.Npols)
    gains = np.ones(shape, complex) if gains is None else gains
    first, second = (np.searchsorted(numbers, column[: data.Nbls]) for column in (data.ant_1_array, data.ant_2_array))
    products = np.moveaxis(gains[first] * gains[second].conj(), 2, 0)
    flags = np.zeros(noise.shape, bool)
    return CalibrationResult(
        make_gains(data, numbers, gains, np.zeros(shape, bool)),
        make_visibilities(data, np.zeros_like(noise), flags),
        make_visibilities(data, noise / products, flags),
        (),
    )


def normal(data: UVData, seed: int = 3) -> np.ndarray:
    draws = np.random.default_rng(seed).normal(size=(2, data.Ntimes, data.Nbls, data.Nfreqs, data.Npols))
    return (draws[0] + 1j * draws[1]) / np.sqrt(2)


def test_noise_alone_has_a_chi2_of_one_and_no_warnings(clean):
    found = assess(clean, result_of(clean, normal(clean)))
    samples = N_TIMES * clean.Nbls * clean.Nfreqs
    for values in (found.chi2_by_antenna, found.chi2_by_channel, found.chi2_by_integration):
        # The scatter of a mean of n squares of complex normal variables is 1/sqrt(n).
        assert np.abs(values - 1).max() < 6 / np.sqrt(samples / values.size)
    assert found.warnings == []


def test_chi2_does_not_depend_on_the_gains(clean):
    rng = np.random.default_rng(8)
    gains = rng.uniform(0.5, 2, (8, clean.Nfreqs, N_TIMES, 1)) * np.exp(1j * rng.uniform(0, 6, (8, clean.Nfreqs, 1, 1)))
    with_gains, without = (assess(clean, result_of(clean, normal(clean), used)) for used in (gains, None))
    assert np.allclose(with_gains.chi2_by_channel, without.chi2_by_channel, rtol=1e-10)
    assert np.allclose(with_gains.chi2_by_antenna, without.chi2_by_antenna, rtol=1e-10)


def test_what_is_noisy_is_named_and_nothing_else(clean):
    noise = normal(clean)
    noise[:, :, CHANNEL] *= 4
    (warning,) = assess(clean, result_of(clean, noise)).warnings
    assert f"{clean.freq_array[CHANNEL] / 1e6:.3f} MHz (1" in warning
    assert warning.count("MHz") == 1
    noise = normal(clean)
    noise[2] *= 3
    (warning,) = assess(clean, result_of(clean, noise)).warnings
    assert "integration 2 (" in warning
    noise = normal(clean)
    number = clean.telescope.antenna_numbers[ANTENNA]
    touching = (clean.ant_1_array[: clean.Nbls] == number) | (clean.ant_2_array[: clean.Nbls] == number)
    noise[:, touching] *= 5
    (warning,) = assess(clean, result_of(clean, noise)).warnings
    assert f"antenna ant{number} (" in warning
    assert warning.count("ant") == 2


def test_gains_that_stand_out_are_named(clean):
    gains = np.ones((8, clean.Nfreqs, N_TIMES, 1), complex)
    gains[:, CHANNEL] = 80j
    gains[ANTENNA] *= 0.1
    loud = clean.copy()
    loud.data_array[:, CHANNEL] *= 50
    for data, question in ((loud, "interference? (--flag-interference"), (clean, "its data are as elsewhere: noise?")):
        told = assess(data, result_of(data, normal(data), gains)).warnings
        assert len(told) == 2
        assert f"{clean.freq_array[CHANNEL] / 1e6:.3f} MHz (80 x); {question}" in told[0]
        assert f"antenna ant{clean.telescope.antenna_numbers[ANTENNA]} (1/10); a dead one?" in told[1]


def test_with_autocorrelations_chi2_is_in_units_of_the_radiometer_equation(clean):
    data = with_autos(clean, 7.0)
    sigma = 7.0 / np.sqrt(float(np.mean(clean.channel_width)) * float(clean.integration_time[0]))
    found = assess(data, result_of(clean, 2 * sigma * normal(clean)))
    assert "radiometer" in found.noise
    assert np.nanmean(found.chi2_by_channel) == pytest.approx(4, rel=6 / np.sqrt(clean.data_array.size))
    assert found.warnings == []
    # Two antennas have a gain each in every channel, and one baseline: what is left is rounding.
    absorbed = normal(clean)
    absorbed[:, :, CHANNEL] *= 4
    (warning,) = assess(data, result_of(clean, 1e-4 * sigma * absorbed)).warnings
    assert "chi^2 is 1e-08 per sample: the fit has about as many unknowns as there are samples" in warning
    assert "or the noise is far below that of the autocorrelations" in warning


def measured(toy: Toy) -> tuple[UVData, UVData]:
    """Return an integration of a toy with the autocorrelations that its noise has, and its sky model."""
    crosses, rms = make_uvdata(toy, 1), np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    level = rms * np.sqrt(float(np.mean(crosses.channel_width)) * float(crosses.integration_time[0]))
    data, sky = with_autos(crosses, level), with_autos(sky_of(crosses, toy.foregrounds), level)
    autos = data.ant_1_array == data.ant_2_array
    antennas = np.searchsorted(data.telescope.antenna_numbers, data.ant_1_array[autos])
    data.data_array[autos] *= np.abs(toy.gains[antennas, :, None]) ** 2
    return data, sky


def given_gains(toy: Toy, folder: Path, with_model: bool) -> ByFile:
    """Return the calibrator that has the true gains in a file, and perhaps foregrounds of cross-correlations."""
    crosses, gains, model = make_uvdata(toy, 1), toy.gains[:, :, None, None], folder / "model.uvh5"
    made = make_gains(crosses, crosses.telescope.antenna_numbers, gains, np.zeros(gains.shape, bool))
    made.write_calh5(folder / "gains.calh5")
    if with_model:
        sky_of(crosses, toy.foregrounds).write_uvh5(model)
    return ByFile(gains=folder / "gains.calh5", model=model if with_model else None)


def chi2_per_sample(data: UVData, result: CalibrationResult) -> tuple[float, int]:
    total, samples = chi_squared(data, predicted(result.gains, result.model))
    return total / samples, samples


def unknowns(data: UVData, sky: UVData, settings: GainFit) -> float | None:
    fit = products.prepared_fit(settings, data, sky, None)
    return count_unknowns(make_problem(fit, settings, slice(0, 1), 0), settings)


@pytest.mark.parametrize("name", ["none", "by-file", "by-file with a model"])
def test_the_true_gains_and_sky_have_a_chi2_of_one_beside_autocorrelations(name, tmp_path):
    """Those of the sky model are zero, as where it lacks them: the receiver's power is no part of the sky."""
    toy, calibrator = make_toy(scattered(8), noise=0.01), NoCalibration()
    if name == "none":
        toy = replace(toy, gains=np.ones_like(toy.gains))
    else:
        calibrator = given_gains(toy, tmp_path, "model" in name)
    data, sky = measured(toy)
    sky.data_array[sky.ant_1_array == sky.ant_2_array] = 0
    result = run_calibrator(calibrator, data, sky)
    mean, samples = chi2_per_sample(data, result)
    assert samples == toy.noise.size
    assert mean == pytest.approx(1, abs=4 / np.sqrt(samples))
    found = assess(data, result)
    assert np.abs(found.chi2_by_antenna - 1).max() < 4 / np.sqrt(7 * data.Nfreqs)
    assert found.warnings == []


@pytest.mark.parametrize("settings", [SKY_BASED, ONE_SOLVE])
def test_calibrated_autocorrelations_are_real_and_no_part_of_chi2(settings, tmp_path):
    """pyuvdata writes no others. They determine gains, and what the others determine is not known."""
    calibrator = settings.model_copy(update={"autos": True})
    data, sky = measured(make_toy(scattered(8), noise=0.01))
    result = run_calibrator(calibrator, data, sky)
    for name, uvd in (("model", result.model), ("residual", result.residual)):
        write_visibilities(uvd, tmp_path / name)
        autos = uvd.ant_1_array == uvd.ant_2_array
        assert autos.sum() == 8
        assert not uvd.data_array[autos].imag.any()
        assert uvd.data_array[~autos].imag.any()
    assert chi2_per_sample(data, result)[1] == 28 * data.Nfreqs
    assert unknowns(data, sky, calibrator) is None


@pytest.mark.parametrize("settings", [SKY_BASED, ONE_SOLVE])
def test_a_flagged_antenna_counts_as_one_that_was_left_out(settings):
    """Neither its gains nor the foregrounds of its baselines are unknowns."""
    data, sky = measured(make_toy(HEX, noise=0.01))
    number = int(data.telescope.antenna_numbers[ANTENNA])
    touching = (data.ant_1_array == number) | (data.ant_2_array == number)
    left_out = [uvd.select(blt_inds=np.flatnonzero(~touching), inplace=False) for uvd in (data, sky)]
    data.flag_array[touching] = True
    counts, means = [], []
    for some, model in ((data, sky), left_out):
        mean, samples = chi2_per_sample(some, run_calibrator(settings, some, model))
        assert samples == 15 * data.Nfreqs
        counts.append(unknowns(some, model, settings))
        means.append(mean * samples / (samples - counts[-1]))
    assert counts[0] == counts[1]
    assert means[0] == pytest.approx(means[1], rel=1e-3)
    assert means[0] == pytest.approx(1, abs=4 / np.sqrt(samples - counts[0]))


@pytest.mark.parametrize("settings", [SKY_BASED, ONE_SOLVE])
def test_chi2_per_degree_of_freedom_is_one_where_antennas_and_baselines_have_other_flags(settings):
    data, sky = measured(make_toy(scattered(8), noise=0.01))
    flags, pairs = flag_cube(data)[0, :, :, 0], np.column_stack([data.ant_1_array, data.ant_2_array])
    for antenna, number in enumerate(data.telescope.antenna_numbers[:6]):
        flags[(pairs == number).any(axis=1), 8 * antenna : 8 * antenna + 12] = True
    flags[np.flatnonzero(np.not_equal(*pairs.T))[:3], 12:] = True
    mean, samples = chi2_per_sample(data, run_calibrator(settings, data, sky))
    degrees = samples - unknowns(data, sky, settings)
    assert mean * samples / degrees == pytest.approx(1, abs=4 / np.sqrt(degrees))


def test_a_selection_of_lengths_keeps_the_autocorrelations_that_weights_need(clean):
    data = with_autos(clean, 7.0)
    lengths = np.linalg.norm(data.uvw_array, axis=1)
    selection = {"lengths": (1.0, float(np.median(lengths[lengths > 0])))}
    without = select(data, Selection(**selection))
    assert (without.ant_1_array != without.ant_2_array).all()
    kept = select(data, Selection(**selection, autos=True))
    are_autos = kept.ant_1_array == kept.ant_2_array
    assert set(kept.ant_1_array[are_autos]) == set(without.ant_1_array) | set(without.ant_2_array)
    assert (~are_autos).sum() == without.Nblts


@pytest.mark.parametrize("fit_autos", [False, True])
def test_baselines_that_the_sky_model_lacks_are_left_out_and_autocorrelations_stay_if_they_are_not_fitted(
    clean, fit_autos
):
    data, _ = prepare(with_autos(clean, 7.0))
    pairs = clean.get_antpairs()[:3]
    sky, _ = prepare(clean.select(bls=pairs, inplace=False))
    sky.data_array *= 3
    model, kept, notes = common_baselines(sky, data, fit_autos)
    numbers = clean.telescope.antenna_numbers.tolist()
    expected = set(pairs) | (set() if fit_autos else {(number, number) for number in numbers})
    assert set(kept.get_antpairs()) == expected
    assert set(model.get_antpairs()) == expected
    assert np.array_equal(model.get_data(*pairs[2]), 3 * data.get_data(*pairs[2]))
    assert fit_autos or not model.get_data(numbers[4], numbers[4]).any()
    assert len(notes) == 1
    assert notes[0].startswith(f"{data.Nbls - len(expected)} baselines that the sky model lacks")


def test_a_sky_model_of_other_antennas_is_refused(clean):
    data, _ = prepare(clean.select(bls=clean.get_antpairs()[:1], inplace=False))
    sky, _ = prepare(clean.select(bls=clean.get_antpairs()[-1:], inplace=False))
    with pytest.raises(InputError, match="none of the cross-correlations"):
        common_baselines(sky, data, False)


@pytest.fixture
def files(clean, tmp_path, monkeypatch):
    """Data and a sky model in the working directory."""
    monkeypatch.chdir(tmp_path)
    clean.write_uvh5("data.uvh5")
    model = clean.copy()
    model.data_array *= 0.25
    model.write_uvh5("sky.uvh5")
    return tmp_path


CALIBRATE = ["calibrate", "data.uvh5", "--sky-model", "sky.uvh5", *OPTIONS]


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(files, capsys):
    status, told = run_and_read(capsys, *CALIBRATE, "--output", "out", "--dry-run")
    assert status == 0
    assert f"{N_TIMES} solves" in told.out
    assert not (files / "out").exists()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.chain
def test_a_killed_calibration_is_resumed_and_gives_what_an_undisturbed_one_gives(files, capsys, monkeypatch):
    assert run_command(capsys, *CALIBRATE, "--output", "whole")[0] == 0
    solves = []
    true = products.run_calibrator

    def killed(calibrator, data, *others, **more):
        if len(solves) == 2:
            raise RuntimeError("killed")
        solves.append(data.time_array[0])
        return true(calibrator, data, *others, **more)

    with monkeypatch.context() as patch:
        patch.setattr(products, "run_calibrator", killed)
        with pytest.raises(RuntimeError, match="killed"):
            run_command(capsys, *CALIBRATE, "--output", "cut")
    assert not (files / "cut" / "gains.calh5").exists()
    solves.clear()

    def counted(calibrator, data, *others, **more):
        solves.append(data.time_array[0])
        return true(calibrator, data, *others, **more)

    with monkeypatch.context() as patch:
        patch.setattr(products, "run_calibrator", counted)
        assert run_command(capsys, *CALIBRATE, "--output", "cut")[0] == 0
    assert len(solves) == 2
    whole, cut = (UVCal.from_file(files / name / "gains.calh5") for name in ("whole", "cut"))
    assert np.array_equal(whole.gain_array, cut.gain_array)
    assert whole.Ntimes == N_TIMES
    # The sky model is a quarter of the data.
    assert np.abs(whole.gain_array) == pytest.approx(2, rel=1e-6)
    records = [json.loads((files / name / "solution.json").read_text())["records"] for name in ("whole", "cut")]
    assert [record["integration"] for record in records[1]] == list(range(N_TIMES))
    assert [record["last_loss"] for record in records[0]] == [record["last_loss"] for record in records[1]]
    assert not list((files / "cut").glob(".unfinished*"))


@pytest.mark.chain
@pytest.mark.filterwarnings("ignore")
def test_interference_is_warned_of_and_written(files, clean, capsys):
    spoiled = clean.copy()
    spoiled.data_array[:, CHANNEL] *= 1e4
    spoiled.write_uvh5("data.uvh5", clobber=True)
    status, told = run_and_read(capsys, *CALIBRATE, "--output", "out")
    assert status == 0
    named = f"{clean.freq_array[CHANNEL] / 1e6:.3f} MHz (100 x); interference?"
    assert named in told.out
    # By the name of the polarization in the file and in --select, which pyuvdata calls ee.
    assert "warning: xx: |g| is far above" in told.out
    (quality,) = json.loads((files / "out" / "solution.json").read_text())["quality"]
    assert any(warning.startswith("xx: ") and named in warning for warning in quality["warnings"])
    assert quality["gain_by_channel"][CHANNEL] == pytest.approx(100, rel=1e-3)
    assert len(quality["chi2_by_antenna"]) == len(quality["antennas"]) == 8
    with np.load(files / "out" / "diagnostics.npz") as arrays:
        assert arrays["chi2_by_channel"].shape == (clean.Nfreqs,)
        assert str(arrays["antennas"][0]).startswith("ant")
    status, told = run_and_read(capsys, *CALIBRATE, "--output", "flagged", "--flag-interference")
    assert status == 0
    assert "interference?" not in told.out
    gains = UVCal.from_file(files / "flagged" / "gains.calh5")
    assert gains.flag_array[:, CHANNEL].all()
    assert np.abs(gains.gain_array[~gains.flag_array]) == pytest.approx(2, rel=1e-3)


def test_a_field_may_be_given_as_in_an_experiment_file(files, capsys):
    options = ["--set", "calibration.integrations_per_solve=2", "--output", "out", "--dry-run"]
    status, told = run_and_read(capsys, *CALIBRATE, *options)
    assert status == 0
    assert f"{N_TIMES // 2} solves" in told.out


def test_only_simulations_have_errors_that_count_lost_samples():
    """Errors of measured data are from the difference of the halves, which lack the samples as well."""
    records = [{"status": status, "integration": 0, "message": "flagged"} for status in ("skipped", "converged")]
    told = {}
    for measured_data in (False, True):
        told[measured_data] = " ".join(products._warnings({"skipped": 1, "converged": 1}, records, measured_data))
        assert "50 % of the solves gave no gains, and their samples are lost" in told[measured_data]
    assert "too small" in told[False]
    assert "too small" not in told[True]
