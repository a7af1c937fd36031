"""A calibrator from outside the package, by a path and by an entry point: as good a citizen as a built-in one."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run_command, time_limit
from own_calibrators import KNOWN_GAINS, install, write_calibrator
from tiny import load, tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.calibrators.given_gains import NoCalibration
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.experiment.files import dump
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.products.calibration import calibration
from calstudy.products.graph import Graph
from calstudy.products.spectra import power
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study

UNFINISHED = """
from calstudy.calibrate.interface import Calibrator
class Mine(Calibrator):
    def solve(self): ...
class Other(Calibrator):
    def solve(self): ...
"""


@pytest.fixture(params=["path", "entry point"])
def reference(request, tmp_path, monkeypatch) -> Iterator[str]:
    """What an experiment gives as `calibrator`."""
    if request.param == "path":
        yield write_calibrator(tmp_path).name
        return
    site = tmp_path / "site"
    install(site)
    monkeypatch.syspath_prepend(site)
    # Workers are processes of their own.
    monkeypatch.setenv("PYTHONPATH", f"{site}:{Path(__file__).parents[2]}")
    yield "known-gains"
    sys.modules.pop("known_gains", None)


def experiment(folder: Path, calibration: dict | str, figures: tuple[str, ...] = ()) -> Path:
    """Write the tiny experiment with a calibration section and these figures, and return its path."""
    path, content = folder / "own.yaml", tiny(folder)
    content["outputs"]["figures"] = list(figures)
    path.write_text(yaml.safe_dump({**content, "calibration": calibration}))
    return path


def faults(path: Path) -> list[str]:
    """Return what is wrong with an experiment file."""
    with pytest.raises(ExperimentError) as caught:
        load(path)
    return caught.value.faults


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"max_length": "3 Jy"}, "calibration.max_length: '3 Jy' has a unit that cannot be converted to m"),
        ({"max_length": 3}, "calibration.max_length: 3 has no unit"),
        ({"max_length": "-1 m"}, "calibration.max_length = '-1 m': must be greater than 0 m"),
        ({"factr": 2.0}, "calibration.factr: unknown key, did you mean 'factor'? (allowed: assumed, calibrator"),
        ({"chunks": 0}, "calibration.chunks = 0: must be at least 1"),
    ],
)
def test_settings_are_validated_with_their_units(reference, tmp_path, settings, told):
    found = faults(experiment(tmp_path, {"calibrator": reference, **settings}))
    assert len(found) == 1, found
    assert found[0].startswith(told), found


def test_what_is_resolved_can_be_read_again(reference, tmp_path):
    first = load(experiment(tmp_path, {"calibrator": reference, "max_length": "0.2 km"}))
    assert first.calibration.max_length == 200.0
    again = tmp_path / "elsewhere" / "resolved.yaml"
    again.parent.mkdir()
    again.write_text(dump(first))
    assert load(again) == first


def test_fields_lists_it(reference, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["calstudy", "fields", *([reference] if reference.endswith(".py") else [])])
    from calstudy.cli.main import main

    with pytest.raises(SystemExit):
        main(leave=sys.exit)
    listed = capsys.readouterr().out
    assert "KnownGains" in listed if reference.endswith(".py") else "{calibrator: known-gains}" in listed
    assert "| `max_length` | quantity in m | `1e+06 m` | Longer baselines are refused. |" in listed


def test_a_changed_option_or_code_is_another_product(reference, tmp_path, monkeypatch):
    def key(**settings) -> str:
        return power(Graph(load(experiment(tmp_path, {"calibrator": reference, **settings}))), "residual").key

    first = key()
    assert key() == first == key(factor=1.0)
    assert key(factor=2.0) != first
    if reference.endswith(".py"):
        (tmp_path / reference).write_text(KNOWN_GAINS + "\n# changed\n")
    else:
        install(tmp_path / "site", version="1.1")
    assert key() != first


def test_a_plan_has_its_cost_and_its_refusal(reference, tmp_path, capsys):
    study = load_study(experiment(tmp_path, {"calibrator": reference, "chunks": 1}))
    task = calibration(study.graph, study.experiment.variants["residual"], "even")
    (piece,) = task.needs.values()
    assert piece.cost.seconds == 1234.0
    path = experiment(tmp_path, {"calibrator": reference, "max_length": "20 m"})
    status, told = run_command(capsys, "plan", path)
    assert status == 2
    assert told == "calstudy: calibration.max_length: is exceeded by a baseline of 28 m\n"


@pytest.mark.chain
def test_a_run_uses_it_and_tells_its_status(reference, tmp_path, shared_store):
    (tmp_path / "store").symlink_to(shared_store)
    settings = {"calibrator": reference, "factor": 2.0, "status": "max-steps"}
    run = run_study(load_study(experiment(tmp_path, settings)), Budget(workers=1))
    (told,) = [text for text in run.warnings if text.startswith("calibrate (")]
    assert ", and 3 more): 2 of 2 solves did not converge (2 max-steps)" in told
    assert "these are the gains that are known" in told
    records = [product.record for product in run.made.products.values()]
    notes = [record["notes"] for record in records if record["stage"] == "calibrate"]
    assert all("median_steps" not in note and note["by_status"] == {"max-steps": 2} for note in notes)


@pytest.fixture
def observed(tmp_path):
    """Data and a sky model in files."""
    instrument = {**tiny(tmp_path)["instrument"], "channels": {"first": "170 MHz", "width": "400 kHz", "count": 8}}
    template = make_template(InstrumentSettings.model_validate(instrument))
    rng = np.random.default_rng(1)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols, 2)
    data, sky = (from_cube(template, rng.standard_normal(shape) @ (1, 1j)) for _ in range(2))
    data.write_uvh5(str(tmp_path / "data.uvh5"))
    sky.write_uvh5(str(tmp_path / "sky.uvh5"))
    return data, sky


@pytest.mark.chain
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("status", "code"), [("converged", 0), ("stalled", 3)])
def test_the_calibrate_command_uses_it(reference, observed, tmp_path, capsys, monkeypatch, status, code):
    monkeypatch.chdir(tmp_path)
    options = ["--sky-model", "sky.uvh5", "--set", f"calibrator={reference}", "--set", f"status={status}"]
    found, told = run_command(capsys, "calibrate", "data.uvh5", *options, "--output", "out")
    assert found == code, told
    described = json.loads((tmp_path / "out" / "solution.json").read_text())
    assert described["settings"]["max_length"] == "1000000.0 m"
    assert described["by_status"] == {status: 2}
    assert [record["n_steps"] for record in described["records"]] == [None, None]
    if code:
        assert "2 of 2 solves did not converge" in told
        assert "stalled, these are the gains that are known" in told


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ["--set", "max_length=20 m", "--sky-model", "sky.uvh5"],
            "calibration.max_length: is exceeded by",
        ),
        (["--set", "max_length=20", "--sky-model", "sky.uvh5"], "calibration.max_length: 20 has no unit"),
        ([], "needs a sky model"),
        (["--buffer", "50 ns"], "has no such key, but calamity, "),
        (["--expected-loss", "--sky-model", "sky.uvh5"], "--expected-loss: is known for fits by least squares"),
        (["--set", "fault=value", "--sky-model", "sky.uvh5"], "line 46, in spoiled: ValueError: no such thing"),
    ],
)
def test_the_calibrate_command_refuses_in_a_sentence(reference, observed, tmp_path, capsys, monkeypatch, options, told):
    monkeypatch.chdir(tmp_path)
    code, error = run_command(capsys, "calibrate", "data.uvh5", "--set", f"calibrator={reference}", *options)
    complaints = [line for line in error.splitlines() if line.startswith("calstudy:")]
    assert code == 2, error
    assert len(complaints) == 1, error
    assert told in complaints[0], error


@pytest.mark.chain
@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("exit", "known_gains.py line 44, in spoiled: it ended the process (sys.exit, status 5)"),
        ("value", "known_gains.py line 46, in spoiled: ValueError: no such thing"),
        ("type", "known_gains.py line 48, in spoiled: TypeError: object of type 'int' has no len()"),
        ("interrupt", "known_gains.py line 76, in spoiled: it ended the process (KeyboardInterrupt)"),
    ],
)
def test_an_error_ends_a_run_with_the_line_of_the_users_code(tmp_path, capsys, fault, told):
    reference = write_calibrator(tmp_path).name
    path = experiment(tmp_path, {"calibrator": reference, "fault": fault})
    with time_limit(120):
        code, error = run_command(capsys, "run", path, "--workers", 1)
    complaints = [line for line in error.splitlines() if line.startswith("calstudy:")]
    assert code == 2, error
    assert len(complaints) == 1, error
    assert told in complaints[0], error
    assert "Traceback" not in error
    assert "site-packages" not in error


def known_gains(folder: Path, **settings):
    """Return the calibrator of a file with settings."""
    return CALIBRATORS.make({"calibrator": str(write_calibrator(folder)), **settings})


def test_the_residual_is_the_calibrated_data_less_the_model(observed, tmp_path):
    data, sky = observed
    result = run_calibrator(known_gains(tmp_path, factor=2.0), data, sky)
    channel = 2.0 * np.arange(1, data.Nfreqs + 1)[:, None]
    np.testing.assert_allclose(to_cube(result.residual), to_cube(data) / channel**2 - to_cube(sky), rtol=1e-12)
    np.testing.assert_array_equal(to_cube(result.model), to_cube(sky))
    assert result.gains.gain_array.shape == (data.telescope.Nants, data.Nfreqs, data.Ntimes, 1)
    assert [record.status for record in result.solutions] == ["converged"] * data.Ntimes


def test_flagged_gains_flag_what_they_calibrate(observed, tmp_path):
    data, sky = observed
    result = run_calibrator(known_gains(tmp_path, fault="flagged"), data, sky)
    flags = result.residual.flag_array.reshape(data.Ntimes, data.Nbls, data.Nfreqs)
    first = data.ant_1_array[: data.Nbls] == data.telescope.antenna_numbers[0]
    assert flags[:, first, 3].all()
    assert flags.sum() == data.Ntimes * first.sum()
    assert np.isfinite(result.residual.data_array).all()
    assert not result.residual.data_array[result.residual.flag_array].any()


@pytest.mark.parametrize("own", [True, False])
def test_gains_of_antennas_without_data_are_flagged(observed, tmp_path, own):
    """By no calibrator's own doing: here all gains are known, or one."""
    data, sky = observed
    data, numbers = data.copy(), data.telescope.antenna_numbers
    flags = data.flag_array.reshape(data.Ntimes, data.Nbls, data.Nfreqs)
    ends = np.stack([data.ant_1_array, data.ant_2_array])[:, : data.Nbls]
    flags[0, (ends == numbers[2]).any(axis=0), 3:] = True
    # One baseline is enough.
    flags[0, (ends == numbers[4]).any(axis=0).nonzero()[0][1:]] = True
    flags[1, :, 5] = True
    result = run_calibrator(known_gains(tmp_path) if own else NoCalibration(), data, sky)
    expected = np.zeros((data.Ntimes, len(numbers), data.Nfreqs), bool)
    expected[0, 2, 3:], expected[1, :, 5] = True, True
    np.testing.assert_array_equal(np.moveaxis(result.gains.flag_array[..., 0], 2, 0), expected)
    np.testing.assert_array_equal(result.residual.flag_array, data.flag_array)


def test_nothing_is_fitted_or_calibrated_where_all_is_flagged(observed):
    data, sky = observed
    data = data.copy()
    data.flag_array[data.Nbls :] = True
    result = run_calibrator(NoCalibration(), data, sky)
    assert [record.status for record in result.solutions] == ["converged", "skipped"]


@pytest.mark.parametrize("status", ["failed", "skipped"])
def test_gains_of_a_failed_solve_are_flagged(observed, tmp_path, status):
    result = run_calibrator(known_gains(tmp_path, status=status), *observed)
    assert result.gains.flag_array.all()
    assert result.residual.flag_array.all()
    assert not result.residual.data_array.any()


def test_one_set_of_gains_for_each_solve(observed, tmp_path):
    whole = run_calibrator(known_gains(tmp_path), *observed)
    shared = run_calibrator(known_gains(tmp_path, fault="one for all", integrations_per_solve=2), *observed)
    assert [record.n_integrations for record in shared.solutions] == [2]
    np.testing.assert_array_equal(shared.residual.data_array, whole.residual.data_array)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("pair", "returns tuple, not a Calibration"),
        ("shape", r"returns gains of shape \(7, 7, 2, 1\) .* expected complex numbers of shape \(7, 8, 2, 1\)"),
        ("one for all", r"returns gains of shape \(7, 8, 1, 1\)"),
        ("zero", "returns gains that are zero or not finite, and not flagged"),
        ("model", r"returns a model of shape \(2, 21, 7, 1\), expected \(2, 21, 8, 1\)"),
        ("status", "its status one of converged, max-steps, stalled, failed, skipped"),
        ("outcomes", "returns 3 outcomes for 2 solves"),
        ("multiply", "convention 'multiply'; it must be 'divide'"),
        ("refusal", "known_gains: refusal returned False; return a sentence that says why, or None"),
        ("write", "line 50, in spoiled: ValueError: assignment destination is read-only"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(observed, tmp_path, fault, told):
    with pytest.raises(InputError, match=told):
        run_calibrator(known_gains(tmp_path, fault=fault), *observed)


@pytest.mark.parametrize(
    ("text", "reference", "told"),
    [
        (KNOWN_GAINS, "absent.py", "absent.py' cannot be read (No such file or directory)"),
        (KNOWN_GAINS, "known_gains.py:Other", "holds no calibrator of this name (it has: KnownGains)"),
        ("def f(:\n", "known_gains.py", "is not valid Python (line 1:"),
        ("import sys\nsys.exit()\n", "known_gains.py", "known_gains.py line 2, in <module>: it ended the process"),
        ("x = 1\n", "known_gains.py", "must hold one calibrator"),
        (UNFINISHED, "known_gains.py", "':Class' (it has: Mine without calibrate; Other without calibrate)"),
        (UNFINISHED, "known_gains.py:Mine", "this name (it has: Mine without calibrate; Other without calibrate)"),
        (UNFINISHED + "    size = 3\n", "known_gains.py", "`size = 3` has no type: write one, as in `size: float"),
        (
            KNOWN_GAINS,
            "calamty",
            "'calamty' is not a calibrator, did you mean 'calamity'? (there are: by-file, calamity,",
        ),
    ],
)
def test_an_experiment_tells_before_it_starts(tmp_path, text, reference, told):
    (tmp_path / "known_gains.py").write_text(text)
    found = faults(experiment(tmp_path, {"calibrator": reference}))
    assert len(found) == 1, found
    assert found[0].startswith("calibration.calibrator: "), found
    assert told in found[0], found


def test_figures_that_need_a_fit_are_refused(tmp_path):
    reference = write_calibrator(tmp_path).name
    path = experiment(tmp_path, {"calibrator": reference}, figures=("expected-loss",))
    assert "needs a calibrator that fits by least squares" in faults(path)[0]
