"""Runs end to end: right, resumable, and never wrong from a damaged product."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from fault_runs import differences
from pyuvdata import UVCal, UVData
from rich.console import Console
from tiny import load, of_the_paper

from calstudy.base.errors import InputError
from calstudy.experiment.files import override, validate
from calstudy.experiment.model import Experiment
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.run.store import Store
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.study import Budget, Run, run_study

pytestmark = pytest.mark.chain


def run_here(data: dict, folder: Path) -> tuple[Run, str]:
    text = io.StringIO()
    study = ExperimentStudy(validate(data, folder))
    result = run_study(study, Budget(workers=1), Console(file=text, width=200))
    assert result.folder == study.folder
    return result, text.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def finished(folder) -> Run:
    return run_here(of_the_paper(folder), folder)[0]


def arrays(result: Run, figure: str) -> dict[str, np.ndarray]:
    with np.load(result.folder / "figures" / f"{figure}.npz") as file:
        return dict(file)


def load_tiny(result: Run) -> Experiment:
    return validate(of_the_paper(result.folder.parents[1]), result.folder)


def product_of(result: Run, stage: str, label: str) -> Path:
    return next(
        result.made.products[task.key].path for task in result.tasks if (task.stage.name, task.label) == (stage, label)
    )


def stages_made(result: Run) -> set[str]:
    return {task.stage.name for task in result.made.tasks}


def test_a_run_leaves_figures_tables_manifest_and_a_file_that_reads_back(finished):
    names = {path.name for path in (finished.folder / "figures").iterdir()}
    figures, endings = load_tiny(finished).outputs.figures, ("png", "pdf", "npz")
    assert names == {f"{figure.label}.{ending}" for figure in figures for ending in endings}
    assert (finished.folder / "tables" / "residual.outside-wedge.csv").exists()
    assert load(finished.folder / "experiment.yaml").sky == load_tiny(finished).sky
    manifest = json.loads((finished.folder / "manifest.json").read_text())
    assert manifest["seeds"]["corruption.effects.0.seed"] == 5
    assert any("G4Jy" in note for note in manifest["stand_ins"])
    assert manifest["captions"].keys() == {figure.label for figure in figures}
    assert {entry["stage"] for entry in manifest["products"]} >= {"simulate", "calibrate", "power", "figure", "claims"}
    assert all(entry["made_by_this_run"] for entry in manifest["products"])
    assert (finished.folder / "report.html").exists()
    assert json.loads((finished.folder / "claims.json").read_text())


def test_products_are_in_standard_formats(finished):
    label = "corrupted data (foregrounds + eor + noise even)"
    assert UVData.from_file(product_of(finished, "simulate", "foregrounds") / "visibilities.uvh5").Nbls == 21
    assert UVCal.from_file(product_of(finished, "calibrate", label) / "gains.calh5").Ntimes == 2


def test_gain_errors_fill_the_window_and_calibration_empties_it(finished):
    def outside(name: str) -> float:
        wedge = load_spectrum(finished.folder / "tables" / f"{name}.wedge.h5", CylindricalSpectrum)
        window = wedge.delay > wedge.horizon_delay[:, None] + 400e-9
        return float(np.mean(np.abs(wedge.power.real)[window]))

    assert outside("uncalibrated") > 1e4 * outside("eor")
    assert outside("residual") < 1e-4 * outside("uncalibrated")
    # Perfect gains leave noise and EoR there: within the scatter of a few dozen modes of one another.
    assert outside("uncorrupted") < 10 * (outside("eor") + outside("noise"))


def test_the_scaled_eor_is_40_db_below_the_foregrounds(finished):
    levels = json.loads((product_of(finished, "levels", "levels") / "levels.json").read_text())
    assert levels["eor_factor"] * levels["eor_rms"] == pytest.approx(1e-4 * levels["foreground_rms"])
    assert levels["noise_std"] == pytest.approx(2e-4 * levels["foreground_rms"])


def test_spectra_have_errors_of_noise_and_sample_variance(finished):
    spectrum = load_spectrum(finished.folder / "tables" / "residual.all-modes.h5", SphericalSpectrum)
    filled = spectrum.n_modes > 0
    assert (spectrum.noise_error[filled] > 0).all()
    assert (spectrum.sample_error[filled] > 0).all()
    noise = load_spectrum(finished.folder / "tables" / "noise.all-modes.h5", SphericalSpectrum)
    assert (noise.sample_error[filled] == 0).all()


def test_a_second_run_makes_nothing(finished, folder):
    result, _ = run_here(of_the_paper(folder), folder)
    assert result.made.tasks == ()
    assert result.folder == finished.folder
    manifest = json.loads((finished.folder / "manifest.json").read_text())
    assert not any(entry["made_by_this_run"] for entry in manifest["products"])


def test_a_complete_store_is_only_read(finished, folder, monkeypatch):
    def written(*_: object) -> None:
        raise AssertionError("the store was written")

    for name in ("prepare", "lock", "building", "seal"):
        monkeypatch.setattr(Store, name, written)
    store = Path(of_the_paper(folder)["outputs"]["store"])
    before = sorted(store.rglob("*"))
    result, _ = run_here(of_the_paper(folder), folder)
    assert sorted(store.rglob("*")) == before
    assert result.made.tasks == ()
    temporary = {task.key for task in finished.tasks if task.temporary}
    assert result.made.products.keys() == finished.made.products.keys() - temporary


def test_a_changed_field_makes_only_what_reads_it_in_another_run_folder(finished, folder):
    result, _ = run_here(override(of_the_paper(folder), "power.bins.width", "0.2 h/Mpc"), folder)
    assert stages_made(result) == {"spectra", "figure", "claims", "transfer", "score"}
    figures = {task.label for task in result.made.tasks if task.stage.name == "figure"}
    assert figures == {"wedge", "spherical", "signal-loss"}
    assert result.folder != finished.folder


def test_a_damaged_product_is_told_and_rebuilt_to_the_same_figures(finished, folder):
    before = arrays(finished, "spherical")
    for stage, label, name in (
        ("spectra", "wedge and spherical", "residual.all-modes.h5"),
        ("figure", "spherical", "spherical.npz"),
        ("power", "residual", "delay-spectra.h5"),
    ):
        path = product_of(finished, stage, label) / name
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    result, text = run_here(of_the_paper(folder), folder)
    assert "damaged" in text
    assert stages_made(result) == {"power", "spectra", "figure"}
    # From the same calibration, so that nothing but the rounding of sums may differ.
    assert differences(before, arrays(result, "spherical")) == []


def test_it_is_told_that_warnings_were_removed_with_their_products(finished, folder, tmp_path):
    calibrations = next(iter(finished.made.products.values())).path.parents[1] / "calibrate"
    calibrations.rename(tmp_path / "calibrate")
    result, _ = run_here(of_the_paper(folder), folder)
    (tmp_path / "calibrate").rename(calibrations)
    assert result.made.tasks == ()
    [told] = [text for text in result.warnings if "no longer in the store" in text]
    assert re.fullmatch(r"\d+ products behind the results .* \(calibrate \d+\), nor are their warnings", told)
    assert json.loads((result.folder / "manifest.json").read_text())["warnings"] == [told]
    assert told in (result.folder / "report.html").read_text()
    result, _ = run_here(of_the_paper(folder), folder)
    assert json.loads((result.folder / "manifest.json").read_text())["warnings"] == []


def test_a_run_folder_with_a_strangers_file_is_refused(finished, folder):
    stranger = finished.folder / "thesis.tex"
    stranger.write_text("mine")
    with pytest.raises(InputError, match=r"thesis\.tex"):
        run_here(of_the_paper(folder), folder)
    assert stranger.read_text() == "mine"
    stranger.unlink()


def command(path: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "calstudy", "run", str(path), *options]


def test_a_killed_run_resumes_and_ends_as_if_it_had_not_been(finished, tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(of_the_paper(tmp_path)))
    process = subprocess.Popen(
        command(path, "--workers", "1"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.monotonic() + 600
    while not list((tmp_path / "store" / "simulate-chunk").glob("[0-9a-f]*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    survivors = {product.name for product in (tmp_path / "store" / "simulate-chunk").glob("[0-9a-f]*")}
    assert survivors
    result, _ = run_here(of_the_paper(tmp_path), tmp_path)
    assert not survivors & {task.key for task in result.made.tasks}
    expected, found = arrays(finished, "spherical"), arrays(result, "spherical")
    for key in expected:
        if expected[key].dtype.kind in "fc":
            assert found[key] == pytest.approx(expected[key], rel=1e-3, nan_ok=True), key
    assert not list(tmp_path.glob("store/*/.building-*"))


def test_temporary_products_are_dropped_once_used(finished, folder):
    store = Path(of_the_paper(folder)["outputs"]["store"])
    temporary = [task for task in finished.tasks if task.temporary]
    assert temporary
    assert not any((store / task.stage.name / task.key).exists() for task in temporary)
