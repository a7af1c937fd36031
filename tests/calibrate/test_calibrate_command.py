"""``calstudy calibrate`` from file to files: results, exit codes, and one sentence for every mistake."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
from filelock import FileLock
from observations import with_autos
from pyuvdata import UVCal, UVData, UVFlag
from toy import make_toy, scattered
from toy_data import make_uvdata

import calstudy
from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.base.gain_files import read_gains
from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.calibrate.expected_loss import ExpectedTransfer
from calstudy.calibrate.settings import FileWeights
from calstudy.calibrate.weights import make_weights
from calstudy.cli import main as cli
from calstudy.cli.calibrate import _calibration
from calstudy.interface import CalibratedData
from calstudy.power.tables import load_spectrum
from calstudy.realdata.reading import prepare, read_visibilities
from calstudy.realdata.selection import Selection
from calstudy.realdata.settings import defaults
from calstudy.studies.calibration import FIGURE_FILES, IN_USE, DataCalibration, calibration_file

WRITTEN = {"gains.calh5", "model.uvh5", "residual.uvh5", "solution.json", *FIGURE_FILES}
"""Without options."""
OPTIONS = ["--buffer", "50 ns", "--set", "basis.min_delay=50 ns"]


def write_data(toy, folder):
    path = folder / "data.uvh5"
    uvd = make_uvdata(toy, 2)
    uvd.flag_array[5, :7] = True
    uvd.write_uvh5(str(path))
    return path


@pytest.fixture
def data(toy, tmp_path):
    return write_data(toy, tmp_path)


@pytest.fixture(scope="module")
def finished(toy, tmp_path_factory):
    """The folder of data, with all that the command can write in its folder ``out``, and what it told."""
    folder, told = tmp_path_factory.mktemp("calibrated"), io.StringIO()
    wanted = ["--also", "calfits", "--also", "h5parm", "--expected-loss"]
    arguments = [write_data(toy, folder), *OPTIONS, "--output", "out", *wanted]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told), redirect_stderr(told):
        patch.setattr(sys, "argv", ["calstudy", "calibrate", *map(str, arguments)])
        patch.chdir(folder)
        with pytest.raises(SystemExit) as end:
            cli.main(leave=sys.exit)
    assert end.value.code == 0
    return folder, told.getvalue()


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Run the command and return its exit code and what it wrote."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["calstudy", "calibrate", *map(str, arguments)])
        monkeypatch.chdir(tmp_path)
        with pytest.raises(SystemExit) as end:
            cli.main(leave=sys.exit)
        written = capsys.readouterr()
        return end.value.code, written.out + written.err

    return run


def test_a_dry_run_says_what_would_be_solved_and_imports_no_tensorflow(data, tmp_path):
    code = (
        f"import sys\nsys.argv = ['calstudy', 'calibrate', '{data}', '--dry-run', '--set', 'basis.min_delay=50 ns']\n"
        "from calstudy.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "assert 'pyuvdata' in sys.modules\nassert 'tensorflow' not in sys.modules"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    assert "2 solves" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["data.uvh5"]


@pytest.mark.chain
def test_the_expected_loss_is_written_and_how_far_the_fit_is_told(command, finished):
    folder, error = finished
    expected = load_spectrum(folder / "out" / "expected-transfer.ee.h5", ExpectedTransfer)
    assert expected.transfer.shape == (28, 64)
    assert -1e-9 < expected.transfer.min() < 0.1 < 0.5 < expected.transfer.max() < 1
    assert not expected.error.any()
    assert "left by stopping: at most" in error
    records = json.loads((folder / "out" / "solution.json").read_text())["records"]
    assert all(0 < record["newton_decrement"] < 1e-3 and record["decrement_rms"] > 0 for record in records)
    again, told = command(folder / "data.uvh5", *OPTIONS, "--output", folder / "out", "--expected-loss")
    assert again == 2
    assert "expected-transfer.ee.h5" in told


def test_gains_without_errors_are_the_same(command, finished, tmp_path):
    folder, _ = finished
    status, _ = command(folder / "data.uvh5", *OPTIONS, "--output", "plain", "--no-gain-errors")
    assert status == 0
    gains, known = (UVCal.from_file(str(path / "gains.calh5")) for path in (tmp_path / "plain", folder / "out"))
    # Another order of tasks may round otherwise.
    np.testing.assert_allclose(gains.gain_array, known.gain_array, rtol=1e-9)
    records = json.loads((tmp_path / "plain" / "solution.json").read_text())["records"]
    assert all("gain_errors" not in record for record in records)
    assert not (tmp_path / "plain" / "gain-errors.json").exists()


def test_everything_is_written_and_readable(finished):
    out, data = finished[0] / "out", finished[0] / "data.uvh5"
    assert {path.name for path in out.iterdir()} == {*WRITTEN, "gains.calfits", "gains.h5", "expected-transfer.ee.h5"}
    gains, fits = UVCal.from_file(str(out / "gains.calh5")), UVCal.from_file(str(out / "gains.calfits"))
    assert np.allclose(gains.gain_array, fits.gain_array, rtol=1e-5)
    parm = read_gains(out / "gains.h5", "test", UVData.from_file(str(data)))
    assert np.array_equal(gains.flag_array, parm.flag_array)
    assert np.allclose(*(np.where(gains.flag_array, 1, cal.gain_array) for cal in (gains, parm)), rtol=1e-9)
    model, residual = (UVData.from_file(str(out / name)) for name in ("model.uvh5", "residual.uvh5"))
    original = UVData.from_file(str(data))
    assert np.array_equal(residual.flag_array, original.flag_array)
    first, second = (np.searchsorted(gains.ant_array, numbers) for numbers in (model.ant_1_array, model.ant_2_array))
    time = np.repeat([0, 1], model.Nbls)
    products = gains.gain_array[first, :, time] * gains.gain_array[second, :, time].conj()
    used = ~original.flag_array
    rebuilt = products * (model.data_array + residual.data_array)
    assert np.abs(rebuilt - original.data_array)[used].max() < 1e-5 * np.abs(original.data_array).max()


def test_scale_and_band_shape_against_the_sky_model_are_told(command, finished, data, tmp_path):
    sky = UVData.from_file(str(finished[0] / "out" / "model.uvh5"))
    sky.data_array *= 2 * np.linspace(0.9, 1.1, sky.Nfreqs)[:, None]
    sky.write_uvh5(str(tmp_path / "sky.uvh5"))
    code, error = command(data, *OPTIONS, "--output", "out", "--sky-model", "sky.uvh5", "--set", "prior=sky-model")
    assert code == 0
    # 0.9 to 1.1 times the truth: 5.8 % rms, whose mean the scale takes.
    assert re.search(r"over the sky model: 1\.0000, and 5\.[6-9] % rms", error)
    records = json.loads((tmp_path / "out" / "solution.json").read_text())["records"]
    assert all(record["diagnostics"]["sky_model_slope"] == pytest.approx(1) for record in records)


def test_a_sky_model_in_kelvin_and_gains_of_zero_are_refused(command, finished, data, tmp_path):
    """Either would be taken for something else, and give results without a word."""
    sky = UVData.from_file(str(finished[0] / "out" / "model.uvh5"))
    sky.vis_units = "K str"
    sky.write_uvh5(str(tmp_path / "kelvin.uvh5"))
    code, error = command(data, *OPTIONS, "--output", "out", "--sky-model", "kelvin.uvh5")
    assert code == 2
    assert "sky model: is in 'K str', and must be in Jy" in error
    gains = UVCal.from_file(str(finished[0] / "out" / "gains.calh5"))
    gains.gain_array *= 0
    gains.write_calh5(str(tmp_path / "zero.calh5"))
    code, error = command(data, *OPTIONS, "--output", "out", "--gains", "zero.calh5")
    assert code == 2
    assert "gains: all are zero or not finite" in error


def test_the_size_of_the_errors_of_the_sky_model_is_told(command, finished, data, tmp_path):
    """A model with a tenth more flux on every other baseline, and a tenth less on the others."""
    sky = UVData.from_file(str(finished[0] / "out" / "model.uvh5"))
    numbers = np.unique(sky.baseline_array)
    sky.data_array *= np.where(np.isin(sky.baseline_array, numbers[::2]), 1.1, 0.9)[:, None, None]
    sky.write_uvh5(str(tmp_path / "sky.uvh5"))
    block = ["--set", "calibrator=empirical-bayes", "--set", "foreground_prior.noise=0.1 Jy"]
    code, error = command(data, *block, "--output", "out", "--sky-model", "sky.uvh5", "--select", "times=0..0")
    assert code == 0, error
    (found,) = re.findall(r"errors of the sky model: ([0-9.]+) % of its rms on each baseline", error)
    assert 5 < float(found) < 20


@pytest.mark.chain
def test_samples_of_many_measurements_have_the_noise_of_all_of_them(command, finished, data, tmp_path):
    """Nine measurements of a second each have the noise of one of nine seconds."""
    sky = UVData.from_file(str(finished[0] / "out" / "model.uvh5"))
    sky.data_array *= 1 + 0.1 * (sky.baseline_array % 2)[:, None, None]
    sky.write_uvh5(str(tmp_path / "sky.uvh5"))
    measured = with_autos(UVData.from_file(str(data)), power=30.0)
    found = {}
    for name, counts in (("once", 1), ("often", 9)):
        measured.nsample_array[:] = counts
        measured.integration_time[:] = 9.0 / counts
        measured.write_uvh5(str(tmp_path / f"{name}.uvh5"))
        block = ["--set", "calibrator=delay-weighted", "--select", "times=0..0", "--output", name]
        assert command(f"{name}.uvh5", *block, "--sky-model", "sky.uvh5", "--no-gain-errors")[0] == 0
        found[name] = read_gains(tmp_path / name / "gains.calh5", "test").gain_array
    # The fits stop at a tolerance of 1e-5; noise three times too large moves gains by 1e-3 and more.
    assert found["often"] == pytest.approx(found["once"], rel=1e-4)


def test_the_log_tells_every_solve(finished):
    log = json.loads((finished[0] / "out" / "solution.json").read_text())
    assert log["by_status"] == {"converged": 2}
    assert [record["integration"] for record in log["records"]] == [0, 1]
    for record in log["records"]:
        assert len(record["loss_history"]) == record["n_steps"] + 1
        assert record["seconds"] > 0
        assert record["peak_memory"] > 1e8
    assert log["settings"]["basis"]["buffer"].startswith("5e-08")
    assert log["settings"]["prior"] == "gains"


def test_results_are_never_overwritten_unasked(command, data, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "gains.calh5").write_text("precious")
    code, error = command(data, *OPTIONS, "--output", "out")
    assert code == 2
    assert error == "calstudy: --output out: holds gains.calh5 already; use --overwrite or another folder\n"
    assert (folder / "gains.calh5").read_text() == "precious"
    assert command(data, *OPTIONS, "--output", "out", "--overwrite", "--select", "times=0..0")[0] == 0
    assert {path.name for path in folder.iterdir()} == WRITTEN
    assert UVCal.from_file(str(folder / "gains.calh5")).Ntimes == 1


@pytest.mark.parametrize("name", ["gains.h5", "gains.fits", "gains.bin", "gains.calfits"])
def test_gains_of_other_formats_are_not_overwritten_either(command, data, tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("precious")
    code, error = command(data, *OPTIONS, "--output", "out", "--also", "h5parm")
    assert (code, (tmp_path / "out" / name).read_text()) == (2, "precious")
    assert f"holds {name} already" in error


def test_results_that_are_replaced_leave_none_of_the_earlier_calibration(command, data, finished, tmp_path):
    shutil.copytree(finished[0] / "out", tmp_path / "out")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    one, start = ["--select", "times=0..0"], ["--gains", "out/gains.calfits"]
    assert command(data, *OPTIONS, *one, *start, "--output", "out", "--overwrite")[0] == 0
    # What it reads is kept.
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN | {"notes.txt", "gains.calfits"}
    assert command(data, *OPTIONS, *one, "--output", "out", "--overwrite")[0] == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN | {"notes.txt"}


@pytest.mark.parametrize(
    ("name", "option"), [("residual.uvh5", None), ("model.uvh5", "--sky-model"), ("gains.calh5", "--gains")]
)
def test_a_result_never_replaces_an_input(command, data, finished, tmp_path, name, option):
    shutil.copytree(finished[0] / "out", tmp_path / "out")
    before = sha256(tmp_path / "out" / name)
    given = [f"out/{name}"] if option is None else [data, option, f"out/{name}"]
    for more in ([], ["--dry-run"]):
        code, error = command(*given, *OPTIONS, "--output", "out", "--overwrite", *more)
        assert code == 2
        assert f"--output out: {name} in it is an input, and a result would replace it; choose another folder" in error
    assert sha256(tmp_path / "out" / name) == before


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        ({"calibrator": "by-file", "gains": "gains.h5", "model": "sky.uvh5"}, {"gains.h5", "sky.uvh5"}),
        ({"weights": {"kind": "file", "path": "gains.fits"}}, {"gains.fits"}),
        ({"initial_gains": {"kind": "file", "path": "gains.h5"}}, {"gains.h5"}),
    ],
)
def test_files_that_a_calibration_reads_are_not_removed(data, monkeypatch, tmp_path, settings, kept):
    monkeypatch.chdir(tmp_path)
    for name in ("gains.h5", "gains.fits", "model.uvh5", "residual.uvh5", "solution.json", *kept):
        (tmp_path / name).touch()
    sections = {"observed": {"data": [str(data)]}, "calibration": settings}
    DataCalibration.load(calibration_file(sections, tmp_path))._remove_earlier(tmp_path, {"solution.json"})
    assert {path.name for path in tmp_path.iterdir()} == {"data.uvh5", "solution.json", *kept}


def test_two_calibrations_do_not_write_to_one_folder(command, data, tmp_path):
    (tmp_path / "out").mkdir()
    with FileLock(tmp_path / "out" / IN_USE, fallback_to_soft=False):
        code, error = command(data, *OPTIONS, "--output", "out")
        assert code == 2
        assert "--output out: another calibration writes to it" in error
    assert command(data, *OPTIONS, "--output", "out", "--select", "times=0..0")[0] == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == WRITTEN


def test_not_converging_is_exit_code_3_and_says_which(command, data):
    code, error = command(data, *OPTIONS, "--set", "solver.max_steps=1", "--output", "out")
    assert code == 3
    assert "2 of 2 solves did not converge" in error
    assert "integration 1, polarization xx: max-steps, not converged after 1 steps" in error


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["none.uvh5"], "'none.uvh5': no such file or folder"),
        (["data.uvh5", "./data.uvh5"], "data.uvh5 is given twice; leave one out"),
        (["data.uvh5", "--set", "solver=newton"], "solver: 'newton' is not a choice"),
        (["data.uvh5", "--buffer", "50"], "basis.buffer: '50' has no unit"),
        (["data.uvh5", "--set", "bufer=3"], "bufer: unknown key"),
        (
            ["data.uvh5", "--set", "calibrator=delay-weighted"],
            "foreground_prior.noise: must be given, for the data",
        ),
        (["data.uvh5", "--set", "calibrator=sky-based"], "calibration.calibrator = 'sky-based': needs a sky model"),
        (
            ["data.uvh5", "--set", "calibrator=sky-based", *OPTIONS],
            "calibration.basis: 'sky-based' has no such key, but calamity",
        ),
        (["data.uvh5", "--gains", "no.calh5"], "calibration.initial_gains.path = 'no.calh5': no such file"),
        (["data.uvh5", "--weights", "no.h5"], "--weights no.h5: neither gains, flags, nsamples or autos, nor a file"),
        (["data.uvh5", "--select", "antennas=3"], "--select antennas: '3' is not in the data"),
        (["data.uvh5", "--buffer", "2000 ns"], "fills all 64 channels"),
        (["data.uvh5", "--also", "mwaocal", *OPTIONS], "--also hyperdrive and mwaocal hold gains of xx and yy"),
        (["data.uvh5", "--also", "uvfits", *OPTIONS], "--also 'uvfits': not a choice"),
        (["data.uvh5", "--set", "autos=true"], "the data hold no autocorrelations"),
        (
            ["data.uvh5", "--gains", "data.uvh5", *OPTIONS],
            "not a readable file of CalH5, calfits, H5Parm, hyperdrive or calibrate",
        ),
    ],
)
def test_mistakes_are_one_sentence(command, data, arguments, sentence):
    code, error = command(*arguments)
    assert code == 2
    # The plan that precedes the solves is not a complaint.
    complaints = [line for line in error.splitlines() if line.startswith("calstudy:")]
    assert len(complaints) == 1
    assert sentence in complaints[0]
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--weights", "autos"], "weights: 'autos' needs autocorrelations, which the data lack for antenna"),
        (["--weights", "weights.h5"], "no weights for some channels of the data"),
        (["--gains", "gains.calh5"], "gains: no solution for antenna(s) 16, 18, 20, 22, 24 of the data"),
        (["--gains", "flagged.calh5"], "gains: all are flagged, zero or not finite"),
        (["--sky-model", "dark.uvh5"], "sky model: where the data are, all of it is zero or flagged"),
        (["--sky-model", "flagged.uvh5"], "sky model: where the data are, all of it is zero or flagged"),
    ],
)
def test_a_dry_run_refuses_what_the_run_refuses(command, data, tmp_path, arguments, sentence):
    uvd = UVData.from_file(str(data))
    UVFlag(uvd.select(freq_chans=range(40), inplace=False), mode="metric").write(str(tmp_path / "weights.h5"))
    whole = make_uvcal(uvd, np.ones((8, 64, 2, 1), complex))
    whole.select(antenna_nums=[10, 12, 14], inplace=False).write_calh5(str(tmp_path / "gains.calh5"))
    whole.flag_array[:] = True
    whole.write_calh5(str(tmp_path / "flagged.calh5"))
    uvd.flag_array[:] = True
    uvd.write_uvh5(str(tmp_path / "flagged.uvh5"))
    uvd.flag_array[:], uvd.data_array[:] = False, 0
    uvd.write_uvh5(str(tmp_path / "dark.uvh5"))
    for others in (["--dry-run"], ["--output", "out"]):
        code, error = command(data, *OPTIONS, *arguments, *others)
        assert code == 2
        assert sentence in error


@pytest.mark.chain
def test_gains_that_are_not_known_to_start_from_are_counted(command, data, tmp_path):
    gains = make_uvcal(UVData.from_file(str(data)), np.ones((8, 64, 2, 1), complex))
    gains.write_calh5(str(tmp_path / "gains.calh5"))
    for others in (["--dry-run"], ["--output", "whole"]):
        assert "No gains to start from" not in command(data, *OPTIONS, "--gains", "gains.calh5", *others)[1]
    gains.flag_array[[1, 3]] = gains.flag_array[:, 5] = gains.flag_array[4, 7, 0] = True
    gains.write_calh5(str(tmp_path / "gains.calh5"), clobber=True)
    told = "for 2 of 8 antennas, 1 of 64 channels, 1 of 756 other gains; these start from unity."
    for others in (["--dry-run"], ["--output", "out"]):
        code, text = command(data, *OPTIONS, "--gains", "gains.calh5", *others)
        assert code == 0
        assert f"No gains to start from are known {told}" in text


def test_antennas_of_autocorrelations_alone_need_no_gains_to_start_from(command, tmp_path):
    """An outrigger that the sky model lacks leaves its autocorrelation in the data."""
    sky = make_uvdata(make_toy(scattered(6)), 2)
    numbers = np.union1d(sky.ant_1_array, sky.ant_2_array)
    part = sky.select(antenna_nums=numbers[:-1], inplace=False)
    with_autos(sky, 10.0).write_uvh5(str(tmp_path / "data.uvh5"))
    part.write_uvh5(str(tmp_path / "sky.uvh5"))
    gains = make_uvcal(sky, np.ones((sky.telescope.Nants, sky.Nfreqs, 2, 1), complex))
    gains.select(antenna_nums=numbers[:-1])
    gains.write_calh5(str(tmp_path / "gains.calh5"))
    files = ["--sky-model", "sky.uvh5", "--gains", "gains.calh5"]
    code, told = command("data.uvh5", *OPTIONS, *files, "--dry-run")
    assert code == 0, told
    assert "No gains to start from" not in told


def test_calfits_of_data_with_gaps_are_refused_before_the_solves(command, data):
    uvd = UVData.from_file(str(data))
    gap = uvd.select(freq_chans=[*range(20), *range(30, 64)], inplace=False)
    gap.write_uvh5(str(data), clobber=True)
    for others in (["--dry-run"], ["--output", "out"]):
        code, told = command(data, *OPTIONS, "--also", "calfits", *others)
        assert code == 2
        assert "the channels of the data have gaps" in told


def test_weights_of_a_file_are_found_for_turned_and_reordered_data(command, data, tmp_path):
    """Calibration brings data to an order and a direction of its own."""
    uvd = UVData.from_file(str(data))
    weights = UVFlag(uvd, mode="metric")
    weights.metric_array = np.tile(uvd.freq_array[:, None] / 1e8, (uvd.Nblts, 1, 1))
    weights.write(str(tmp_path / "weights.h5"))
    uvd.reorder_freqs(channel_order="-freq")
    uvd.conjugate_bls(np.flatnonzero((uvd.time_array > uvd.time_array.min()) & (np.arange(uvd.Nblts) % 2 == 0)))
    uvd.blts_are_rectangular = False
    uvd.write_uvh5(str(data), clobber=True)
    code, told = command(
        data, *OPTIONS, "--weights", "weights.h5", "--select", "frequencies=165 MHz..180 MHz", "--dry-run"
    )
    assert code == 0, told
    prepared, _ = prepare(read_visibilities([data]), Selection(frequencies=(165e6, 180e6)))
    observation = Observation(prepared)
    settings = FileWeights(kind="file", path=tmp_path / "weights.h5")
    found = make_weights(observation, np.ones(observation.n_baselines, bool), settings)
    ratio = found / observation.frequencies[:, None]
    assert np.ptp(ratio[found > 0]) < 1e-6 * ratio.max()


def test_a_dry_run_says_that_integrations_are_days_apart(command, data):
    assert "days apart" not in command(data, *OPTIONS, "--dry-run")[1]
    uvd = UVData.from_file(str(data))
    uvd.time_array[uvd.time_array > uvd.time_array.min()] += 3
    uvd.set_lsts_from_time_array()
    uvd.write_uvh5(str(data), clobber=True)
    assert "integrations are up to 3 days apart" in command(data, *OPTIONS, "--dry-run")[1]


def test_a_dry_run_says_where_no_sample_has_a_weight(command, tmp_path):
    uvd = make_uvdata(make_toy(scattered(5), autos=True), 1)
    autos = uvd.ant_1_array == uvd.ant_2_array
    uvd.data_array[autos] = np.abs(uvd.data_array[autos])
    uvd.flag_array[autos] = True
    uvd.write_uvh5(str(tmp_path / "data.uvh5"))
    code, told = command("data.uvh5", *OPTIONS, "--weights", "autos", "--dry-run")
    assert code == 0
    assert "Every sample is flagged or has no weight by weights: autos" in told


def test_antennas_that_are_flagged_or_lost_by_their_autocorrelations_are_told_with_the_results(command, tmp_path):
    uvd = with_autos(make_uvdata(make_toy(scattered(6)), 1), power=10.0)
    one, other = np.unique(uvd.ant_1_array)[:2].tolist()
    uvd.flag_array[(uvd.ant_1_array == one) & (uvd.ant_2_array == one)] = True
    uvd.flag_array[(uvd.ant_1_array == other) ^ (uvd.ant_2_array == other)] = True
    uvd.write_uvh5(str(tmp_path / "data.uvh5"))
    code, told = command("data.uvh5", *OPTIONS, "--weights", "autos", "--no-gain-errors", "--output", "out")
    assert code == 0, told
    warnings = json.loads((tmp_path / "out" / "solution.json").read_text())["warnings"]
    for text in (f"All visibilities of antenna(s) {other} are flagged", f"all of antenna(s) {one} among them"):
        assert any(text in warning for warning in warnings), warnings
        assert text in told


def test_what_the_memory_does_not_hold_is_refused(command, data, tmp_path):
    code, error = command(data, *OPTIONS, "--output", "out", "--max-memory", "500 MB")
    assert code == 2
    assert "calstudy: --max-memory leaves 0.0 GB of memory for work, but calibrate-chunk (data whole" in error
    assert not (tmp_path / "out").exists()
    assert "--max-memory '5': write a positive number" in command(data, "--max-memory", "5")[1]


@pytest.mark.parametrize("output", ["/proc/out", "x" * 300])
def test_an_output_folder_that_cannot_be_made_is_refused_before_the_data_are_read(output, command):
    code, error = command("no-such-data.uvh5", "--output", output)
    assert code == 2
    assert f"--output {output}: cannot be written" in error or "File name too long" in error
    assert "no-such-data" not in error


@pytest.mark.parametrize("writer", ["write_calh5", "write_uvh5"])
def test_an_output_folder_that_vanishes_is_told_in_a_sentence(writer, command, data, tmp_path, monkeypatch):
    container = UVCal if writer == "write_calh5" else UVData
    write = getattr(container, writer)

    def vanish(self, *arguments, **options):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        write(self, *arguments, **options)

    monkeypatch.setattr(container, writer, vanish)
    code, error = command(data, *OPTIONS, "--output", "out", "--select", "times=0..0")
    assert code == 2
    assert "--output out: calibrate-chunk (data whole" in error or "--output out: observe (data whole" in error
    assert "could not be written (it was removed while it was written)" in error
    assert "Traceback" not in error


def test_a_disk_that_is_full_is_told_in_a_sentence(command, data, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        # The words of h5py, whose error has no errno.
        raise OSError("Can't synchronously write data (file write failed: errno = 28, error message = 'No space left')")

    monkeypatch.setattr(UVData, "write_uvh5", fail)
    code, error = command(data, *OPTIONS, "--output", "out", "--select", "times=0..0")
    assert code == 2
    assert "--output out: observe (data whole) could not be written (No space left on device); make room or" in error


@pytest.mark.chain
@pytest.mark.parametrize("text", ["prior: none\n", "calibration: {prior: none, solver: {max_steps: 7}}\n", "{}\n"])
def test_a_settings_file_is_stronger_than_the_defaults_for_measured_data(command, data, tmp_path, text):
    (tmp_path / "settings.yaml").write_text(text)
    options = ["--buffer", "50 ns", "--settings", "settings.yaml", "--set", "solver.tolerance=0.1"]
    command(data, *options, "--select", "times=0..0", "--output", "out", "--no-gain-errors")
    found = json.loads((tmp_path / "out" / "solution.json").read_text())["settings"]
    usual = defaults(has_sky_model=False)
    assert found["prior"] == ("none" if "prior" in text else "gains")
    assert found["solver"]["max_steps"] == (7 if "solver" in text else usual["solver"]["max_steps"])
    assert found["solver"]["tolerance"] == 0.1


def test_python_calibrates_as_the_command_does(finished, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    basis = {"basis.buffer": "50 ns", "basis.min_delay": "50 ns"}
    first = {"select": {"times": "0..0"}}
    found = calstudy.calibrate_data(data, "again", first, quiet=True, gain_errors=False, **basis)
    expected = UVCal.from_file(finished[0] / "out" / "gains.calh5")
    # Compiled code and threads add in another order.
    np.testing.assert_allclose(found.gains.gain_array[:, :, 0], expected.gain_array[:, :, 0], rtol=1e-6)
    assert list(found.solves.status) == ["converged"]
    assert found.model.Ntimes == found.residual.Ntimes == 1
    assert "1 converged" in repr(found)
    with pytest.raises(InputError, match=r"output = again: holds gains\.calh5"):
        calstudy.calibrate_data(data, "again")
    assert all("gain_errors" not in record for record in found.solution["records"])
    with pytest.raises(InputError, match="has no errors of gains"):
        _ = found.gain_errors
    with pytest.raises(InputError, match=r"calibration\.bsis"):
        calstudy.calibrate_data(data, "other", **{"bsis.buffer": "50 ns"})


def test_gains_have_their_errors_beside_what_other_readers_see(command, finished, data, tmp_path):
    gains = UVCal.from_file(str(finished[0] / "out" / "gains.calh5"))
    found = CalibratedData(finished[0] / "out")
    errors = found.gain_errors
    assert errors.amplitude.shape == gains.gain_array.shape
    # No errors where there are no gains.
    assert np.array_equal(np.isfinite(errors.phase.values), ~gains.flag_array)
    for record in found.solution["records"]:
        summary = record["gain_errors"]
        assert summary["left_out"] == ["phase", "scale", "smooth"]
        assert summary["noise_from"] == "residual"
        assert 0 < summary["smooth_fraction"] < 1
        assert summary["median_signal_to_noise"] * summary["median_relative_amplitude"] == pytest.approx(1)
    command(data, "--output", "smooth", *OPTIONS, "--set", "gain_delay=200 ns", "--select", "times=0..0")
    smooth = CalibratedData(tmp_path / "smooth")
    assert "restricted to smooth functions" in smooth.solution["records"][0]["gain_errors"]["reason"]
    with pytest.raises(InputError, match="has no errors of gains"):
        _ = smooth.gain_errors


@pytest.mark.chain
def test_an_antenna_that_cannot_be_calibrated_is_flagged_with_its_number(command, toy, data, tmp_path):
    uvd, rng = UVData.from_file(str(data)), np.random.default_rng(5)
    # The fourth antenna.
    dead = (uvd.ant_1_array == 16) | (uvd.ant_2_array == 16)
    rms = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    uvd.data_array[dead] = rms * (rng.standard_normal((2, *uvd.data_array[dead].shape)).T @ [1, 1j]).T / np.sqrt(2)
    uvd.write_uvh5(str(data), clobber=True)
    options = [*OPTIONS, "--set", "weights=flags", "--also", "calfits"]
    _, told = command(data, *options, "--output", "out")
    assert re.search(
        r"cannot be calibrated are flagged; .*: 16 \([0-9.]+ against [0-9.]+ by noise alone, in 2 of", told
    )
    found = CalibratedData(tmp_path / "out")
    for gains in (found.gains, UVCal.from_file(str(tmp_path / "out" / "gains.calfits"))):
        assert np.array_equal(gains.flag_array.all(axis=(1, 2, 3)), gains.ant_array == 16)
    for record in found.solution["records"]:
        signal_to_noise, noise_alone = record["gain_errors"]["lost_antennas"]["16"]
        assert 0 < signal_to_noise < 2 * noise_alone
    for written in (found.model, found.residual):
        assert np.array_equal(written.flag_array.all(axis=(1, 2)), dead)
    assert not found.residual.data_array[dead].any()
    command(data, *options, "--output", "plain", "--no-gain-errors", "--select", "times=0..0")
    assert not CalibratedData(tmp_path / "plain").gains.flag_array.all(axis=(1, 2, 3)).any()


def test_the_loss_of_smoothed_gains_is_not_expected(command, data):
    smooth = ["--set", "smooth_gains.kind=polynomial", "--set", "smooth_gains.frequency_degree=2"]
    code, told = command(data, *OPTIONS, *smooth, "--expected-loss", "--dry-run")
    assert code == 2
    assert "--expected-loss: lacks the effect of calibration.smooth_gains on the residual" in told


def test_an_empty_section_of_a_settings_file_changes_nothing_and_a_list_is_refused(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("calibration:\n")
    assert _calibration(path, {"solver": "adamax"}) == {"solver": "adamax"}
    path.write_text("calibration: [calamity]")
    with pytest.raises(InputError, match=r"settings.yaml: calibration = \['calamity'\]: must be the name of a"):
        _calibration(path, {})
