"""Regression: a study against itself, another draw of the noise, another beam, other units, and what is kept."""

import dataclasses
import io
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from rich.console import Console
from tiny import load, of_the_paper
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.cli.main import app
from calstudy.experiment.files import override
from calstudy.figures.gain_tolerance import GainTolerance
from calstudy.regression import (
    Regression,
    accept,
    compare_array,
    compare_claims,
    compare_figures,
    find_references,
    read_reference,
    read_run,
    remake,
    rules_of,
    show,
)
from calstudy.report.page import read_charts
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study
from calstudy.verdicts.criterion import Verdict

pytestmark = pytest.mark.chain

QUIET = Console(quiet=True)
FIGURES_FOLDER = Path(__file__).parents[2] / "figures"
FIGURES = ["layout", "gains", "data", "wedge", "spherical"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    folder = tmp_path_factory.mktemp("regression")
    (folder / "store").symlink_to(shared_store)
    return folder


@pytest.fixture(scope="module")
def places(folder) -> list[str]:
    return [f"outputs.store={folder / 'store'}", f"outputs.runs={folder / 'runs'}"]


@pytest.fixture(scope="module")
def finished(folder) -> Path:
    """The folder of a finished run of the tiny experiment."""
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(override(of_the_paper(folder), "outputs.figures", FIGURES)))
    return run_study(load_study(path), Budget(workers=1)).folder


@pytest.fixture(scope="module")
def reference(folder, finished) -> Path:
    accept(finished, folder / "references" / "tiny")
    return folder / "references" / "tiny"


def statuses(reference: Path, made: Path) -> dict[str, str]:
    """Return the status of every array, by figure and name."""
    found = compare_figures(read_reference(reference).figures, read_run(made).figures)
    return {f"{item.figure}: {item.name}": item.status for item in found}


def test_a_reference_is_small_and_names_no_place_of_the_machine(reference, finished, folder):
    names = {path.name for path in reference.iterdir()}
    kept = {f"{figure}.{ending}" for figure in FIGURES for ending in ("png", "npz")}
    assert names == kept | {"claims.json", "claims.md", "manifest.json", "experiment.yaml", "tables"}
    assert str(folder) not in (reference / "experiment.yaml").read_text()
    assert load(reference / "experiment.yaml").instrument == load(finished / "experiment.yaml").instrument


def test_a_reference_keeps_the_tables_that_the_manifest_has_on_record(reference, finished, tmp_path):
    manifest = json.loads((reference / "manifest.json").read_text())
    files = {name: digest for entry in manifest["products"] for name, digest in entry.get("files", {}).items()}
    assert "residual.outside-wedge.h5" in files
    assert {path.name: sha256(path) for path in (reference / "tables").iterdir()} == files
    other, run = tmp_path / "reference", tmp_path / "run"
    shutil.copytree(reference, other)
    shutil.copytree(finished, run)
    # Of the others, which it does not keep, none is missing.
    assert (RunFolder(finished).lost, RunFolder(reference).lost) == ([], [])
    # All of a run is read before anything of a reference is replaced.
    (run / "tables" / "residual.outside-wedge.h5").unlink()
    with pytest.raises(InputError, match=r"run: cannot be read .*residual\.outside-wedge\.h5"):
        accept(run, other)
    assert {path.name for path in (other / "tables").iterdir()} == set(files)
    # A run of an older version lists none.
    old = {**manifest, "products": [{**entry, "files": {}} for entry in manifest["products"]]}
    (run / "manifest.json").write_text(json.dumps(old))
    accept(run, other)
    assert not (other / "tables").exists()


def test_made_again_from_the_store_nothing_moves(reference, finished, places):
    assert remake(reference, places, Budget(workers=1), QUIET) == finished
    assert set(statuses(reference, finished).values()) == {"same"}
    claims = compare_claims(read_reference(reference).claims, read_run(finished).claims)
    assert {item.status for item in claims} == {"same"}


def test_another_draw_of_the_noise_moves_what_is_drawn_by_its_error_bars(reference, places):
    again = remake(reference, [*places, "corruption.noise.seeds=[13,14]"], Budget(workers=1), QUIET)
    found = compare_figures(read_reference(reference).figures, read_run(again).figures)
    assert not [item for item in found if item.status == "beyond"]
    moved = {f"{item.figure}: {item.name}": item for item in found if item.status == "moved"}
    for name in ("spherical: all_modes.noise.power", "wedge: noise.power", "data: noise.values"):
        assert 0.4 < moved[name].rms < 1.6, name
    # What the noise does not enter is the same.
    same = {f"{item.figure}: {item.name}" for item in found if item.status == "same"}
    assert {"gains: true.values", "wedge: eor.power", "layout: enu"} <= same


def test_another_beam_is_caught(reference, places):
    changed = [*places, "instrument.beam={kind: airy, diameter: 10 m}"]
    found = statuses(reference, remake(reference, changed, Budget(workers=1), QUIET))
    for name in ("data: reference.values", "spherical: all_modes.uncalibrated.power", "wedge: uncorrupted.power"):
        assert found[name] == "beyond", name
    assert found["gains: true.values"] == "same"


@pytest.mark.parametrize(
    ("figure", "name"),
    [("spherical", "all_modes.uncorrupted.power"), ("wedge", "uncalibrated.power"), ("data", "reference.values")],
)
def test_other_units_are_caught(reference, figure, name):
    arrays = read_reference(reference).figures[figure]
    little_h = 0.6774**3
    assert compare_array(figure, name, arrays, arrays[name]).status == "same"
    assert compare_array(figure, name, arrays, arrays[name] / little_h).status == "beyond"


def drawn_spectrum(rng):
    """Return the arrays of a spectrum of 400 bins of 10 % error."""
    power = 1 + 0.1 * rng.standard_normal(400) + 0j
    series = {"power": power, "noise_error": np.full(400, 0.0), "sample_error": np.full(400, 0.1)}
    return {f"excised.residual.{key}": value for key, value in {**series, "noise_modes": np.ones(400)}.items()}


def test_one_bin_far_off_shows_though_rms_and_mean_do_not():
    arrays = drawn_spectrum(np.random.default_rng(1))
    power = arrays["excised.residual.power"].copy()
    power[7] += 8 * np.sqrt(2) * 0.1
    off = compare_array("spherical", "excised.residual.power", arrays, power)
    assert (off.largest, off.rms, off.shift) == pytest.approx((8, 8 / 20, 8 / 20))
    assert off.status == "beyond"


def test_a_small_loss_at_all_scales_shows_in_the_mean():
    """A tenth less power in each of 400 bins of 10 % error is within every error bar, and 14 standard errors in all."""
    rng = np.random.default_rng(1)
    arrays = drawn_spectrum(rng)
    power = arrays["excised.residual.power"]
    redrawn = compare_array("spherical", "excised.residual.power", arrays, 1 + 0.1 * rng.standard_normal(400) + 0j)
    assert redrawn.status == "moved"
    assert redrawn.rms == pytest.approx(1, abs=0.15)
    lost = compare_array("spherical", "excised.residual.power", arrays, 0.9 * power)
    assert lost.largest < 2
    assert lost.shift == pytest.approx(-0.1 * 20 / (np.sqrt(2) * 0.1), rel=0.02)
    assert lost.status == "beyond"


@pytest.mark.parametrize(("converged", "status"), [(None, "beyond"), (1.0, "beyond"), (0.5, "beyond"), (0.4, "moved")])
def test_scores_of_fits_without_a_solution_depend_on_where_they_stopped(converged, status):
    reference = {name: np.array([1.0, 2.0]) for name in ("w.c.transfer", "w.c.bias", "w.c.cross_transfer")}
    reference |= {f"{name}_error": np.array([0.1, 0.1]) for name in ("w.c.transfer", "w.c.bias")}
    reference["w.c.flux_scale"] = np.array(1.0)
    if converged is not None:
        reference["w.c.converged"] = np.array(converged)
    rules = rules_of("comparison-matrix")
    for name in ("w.c.transfer", "w.c.bias", "w.c.bias_error", "w.c.cross_transfer", "w.c.flux_scale"):
        assert compare_array("comparison-matrix", name, reference, 50 * reference[name], rules).status == status


@pytest.mark.parametrize(
    ("error", "made", "status"),
    [
        ([0, 0, 0], [1e6, -2e6, 3], "beyond"),
        ([np.nan] * 3, [1e6, -2e6, 3], "beyond"),
        ([0, np.nan, 0.1], [1, 2.04, 3], "beyond"),
        ([0, np.nan, 0.1], [1, 2, 3.1], "moved"),
        # Other processors move fits by less than 1 % of the largest.
        ([0, np.nan, 0.1], [1.02, 2 - 0.02, 3.1], "moved"),
        ([0, np.nan, 0.1], [1 + 1e-7, 2 - 1e-7, 3], "same"),
        # Of an infinite error anything may come.
        ([np.inf] * 3, [1e6, -2e6, 3], "moved"),
    ],
)
def test_what_has_no_error_bar_may_move_by_a_percent(error, made, status):
    reference = {"x": np.array([1.0, 2.0, 3.0]), "x_error": np.array(error, float)}
    assert compare_array("figure", "x", reference, np.array(made, float)).status == status


def test_solves_that_no_longer_converge_are_beyond_the_tolerance():
    reference = {"w.c.converged": np.array(1.0)}
    assert compare_array("comparison-matrix", "w.c.converged", reference, np.array(0.9)).status == "moved"
    assert compare_array("comparison-matrix", "w.c.converged", reference, np.array(0.5)).status == "beyond"


def test_what_is_missing_new_or_of_another_shape_is_told():
    reference = {"data": {"a": np.zeros(3), "b": np.zeros(3)}, "wedge": {"c": np.array("title")}}
    made = {"data": {"a": np.zeros(4), "new": np.zeros(2)}, "wedge": {"c": np.array("heading")}}
    found = {item.name: (item.status, item.problem) for item in compare_figures(reference, made)}
    assert found["a"] == ("beyond", "shape (4,), was (3,)")
    assert found["b"] == ("beyond", "missing")
    assert found["new"][0] == "moved"
    assert found["c"] == ("beyond", "different")
    nan = compare_array("layout", "enu", {"enu": np.array([1.0, np.nan])}, np.array([np.nan, 1.0]))
    assert (nan.status, nan.problem) == ("beyond", "finite in other places, or not alike")


@pytest.mark.parametrize("made", [[1, np.nan, np.inf], [1, np.inf, np.inf], [1, -np.inf, np.nan]])
def test_infinities_and_missing_numbers_are_not_the_same(made):
    reference = {"enu": np.array([1, np.inf, np.nan])}
    assert compare_array("layout", "enu", reference, reference["enu"].copy()).status == "same"
    assert compare_array("layout", "enu", reference, np.array(made, dtype=float)).status == "beyond"


def test_times_of_a_machine_are_told_and_never_too_far():
    found = compare_array("runtime-rows", "seconds", {"seconds": np.ones(3)}, 7 * np.ones(3))
    assert (found.status, found.relative) == ("moved", 6)
    other_device = compare_figures({"runtime-rows": {"gpu": np.ones(3)}}, {"runtime-rows": {"cpu": np.ones(2)}})
    assert {item.status for item in other_device} == {"moved"}


@pytest.mark.parametrize(
    ("uncertainty", "measured", "verdict", "status"),
    [
        (0.1, 1.0, "supported", "same"),
        (0.1, 1.2, "supported", "moved"),
        (0.1, 1.2, "contradicted", "moved"),
        (0.1, 1.4, "contradicted", "beyond"),
        (0.0, 1.1, "contradicted", "beyond"),
        (0.1, None, "not evaluated", "beyond"),
    ],
)
def test_a_verdict_may_change_with_a_number_that_moved_within_its_error(uncertainty, measured, verdict, status):
    texts = {"section": "", "sentence": "", "quantity": "", "threshold": "", "why": "", "reason": "", "runs": ()}
    old = Verdict(name="claim", measured=1.0, uncertainty=uncertainty, verdict="supported", **texts)
    new = dataclasses.replace(old, measured=measured, verdict=verdict)
    assert [item.status for item in compare_claims([old], [new])] == [status]
    assert [item.status for item in compare_claims([old], [])] == ["beyond"]
    assert [item.status for item in compare_claims([], [new])] == ["moved"]


def test_verdicts_on_run_time_may_be_others_on_another_machine():
    texts = dict.fromkeys(("section", "sentence", "quantity", "threshold", "why", "reason"), "")
    old = Verdict(name="claim", measured=1.0, uncertainty=0.0, verdict="supported", runs=(), **texts)
    slower = dataclasses.replace(old, measured=2.0, verdict="contradicted")
    gone = dataclasses.replace(old, measured=None, verdict="not evaluated")
    assert [item.status for item in compare_claims([old], [slower], on_machines=True)] == ["moved"]
    assert [item.status for item in compare_claims([old], [slower])] == ["beyond"]
    assert [item.status for item in compare_claims([gone], [slower], on_machines=True)] == ["moved"]
    assert [item.status for item in compare_claims([old], [gone], on_machines=True)] == ["beyond"]
    assert read_reference(FIGURES_FOLDER / "runtime").on_machines
    assert not read_reference(FIGURES_FOLDER / "minredundant").on_machines


def test_a_claim_that_could_not_be_evaluated_need_not_be_listed_any_more():
    texts = dict.fromkeys(("section", "sentence", "quantity", "threshold", "why", "reason"), "")
    never = Verdict(name="claim", measured=None, uncertainty=None, verdict="not evaluated", runs=(), **texts)
    assert [item.status for item in compare_claims([never], [])] == ["moved"]


def test_the_command_answers_with_its_exit_status_and_overwrites_only_if_told(tmp_path, finished):
    command, kept = CliRunner(), tmp_path / "kept"
    new = command.invoke(app, ["regress", str(kept), "--against", str(finished), "--update"])
    assert (new.exit_code, new.output.splitlines()[-1]) == (0, f"{kept}: new reference")
    arrays = dict(np.load(kept / "gains.npz"))
    np.savez(kept / "gains.npz", **{**arrays, "true.values": 2 * arrays["true.values"]})
    before = (kept / "gains.npz").read_bytes()
    moved = command.invoke(app, ["regress", str(kept), "--against", str(finished)])
    assert moved.exit_code == 1
    assert "true.values" in moved.output
    assert (kept / "gains.npz").read_bytes() == before
    told = json.loads((finished / "regression.json").read_text())
    assert not told["holds"]
    assert [item["name"] for item in told["arrays"] if item["status"] == "beyond"] == ["true.values"]
    updated = command.invoke(app, ["regress", str(kept), "--against", str(finished), "--update"])
    assert updated.exit_code == 0
    assert command.invoke(app, ["regress", str(kept), "--against", str(finished)]).exit_code == 0


def test_a_run_never_replaces_the_references_of_other_studies(tmp_path, finished):
    command, other, kept = CliRunner(), tmp_path / "all" / "other", tmp_path / "all" / "tiny"
    for folder in (other, kept):
        accept(finished, folder)
    (other / "experiment.yaml").write_text((other / "experiment.yaml").read_text().replace("name: tiny", "name: other"))
    before = {path: path.read_bytes() for path in (tmp_path / "all").rglob("*") if path.is_file()}
    for folder, told in {tmp_path / "all": "give the one reference folder", other: "a run of 'tiny', and"}.items():
        refused = command.invoke(app, ["regress", str(folder), "--against", str(finished), "--update"])
        assert isinstance(refused.exception, InputError)
        assert told in str(refused.exception)
    assert {path: path.read_bytes() for path in (tmp_path / "all").rglob("*") if path.is_file()} == before
    # Another study may be compared.
    assert command.invoke(app, ["regress", str(other), "--against", str(finished)]).exit_code == 0


SWEEP = """
name: sweep
outputs: {figures: []}
sweep: [{sky.eor.seed: [2, 12]}]
"""


def test_references_that_cannot_be_made_again_do_not_stop_the_others(
    tmp_path, finished, reference, places, monkeypatch
):
    """`regress` without a folder goes through all published studies, for hours."""
    folder = tmp_path / "figures"
    for name in ("tiny", "zz-last"):
        shutil.copytree(reference, folder / name)
    for name, text in (("broken", "name: broken\ninstrument: 3\n"), ("sweep", SWEEP)):
        (folder / name).mkdir()
        (folder / name / "experiment.yaml").write_text(text)
    monkeypatch.setattr("calstudy.regression.run_study", lambda *study: SimpleNamespace(folder=finished))
    arguments = [word for place in places for word in ("--set", place)]
    found = CliRunner().invoke(app, ["regress", str(folder), *arguments])
    assert found.exit_code == 1, found.output
    told = found.output
    assert "broken: NOT MADE AGAIN" in told
    assert "sweep: left out" in told
    assert told.count(": holds") == 2, told
    for name in ("tiny", "zz-last"):
        shutil.rmtree(folder / name)
    nothing = CliRunner().invoke(app, ["regress", str(folder), *arguments])
    assert isinstance(nothing.exception, InputError)


@pytest.mark.parametrize(
    ("bias", "status"),
    [([8.26e5, 768.0, 0.5], "beyond"), ([8.26e5, 768.0, 2e-4], "moved"), ([8.26e5, 900.0, 1e-4], "beyond")],
)
def test_bands_of_a_law_that_decades_lie_between_are_compared_each(bias, status):
    """What is a rounding of the first band is half of the EoR in the last."""
    arrays = {"world.law.bias": np.array([8.26e5, 768.0, 1e-4]), "world.law.sigma": np.array(0.05)}
    arrays["world.law.terms"] = np.array([[3e8, 3e5, 0.04], [1e9, 1e6, 0.1]])
    made = {**arrays, "world.law.bias": np.array(bias)}
    found = compare_figures(
        {"gain-tolerance": arrays}, {"gain-tolerance": made}, {"gain-tolerance": GainTolerance.tolerances}
    )
    assert {item.name: item.status for item in found}["world.law.bias"] == status


def test_damaged_arrays_of_a_run_are_one_sentence(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    path = next((run / "figures").glob("*.npz"))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="the arrays of the figure cannot be read"):
        read_run(run)
    with pytest.raises(InputError, match="the arrays of the figure cannot be read"):
        read_charts(path)


@pytest.mark.parametrize("option", [["--set", "sky.eor.seed=3"], ["--workers", "2"], ["--max-memory", "4 GB"]])
def test_options_of_a_run_are_refused_where_none_is_made(reference, finished, option):
    refused = CliRunner().invoke(app, ["regress", str(reference), "--against", str(finished), *option])
    assert isinstance(refused.exception, InputError)
    assert "nothing is made again" in str(refused.exception)


def test_folders_that_hold_nothing_are_told(tmp_path, reference):
    assert find_references([reference.parent]) == [reference]
    with pytest.raises(InputError, match="holds no reference results"):
        find_references([tmp_path])
    with pytest.raises(InputError, match="is not the folder of a finished run"):
        read_run(tmp_path)


def test_the_table_lists_what_is_beyond_first():
    arrays = {"true.values": np.ones(4), "recovered.values": np.ones((1, 4)), "residual.values": np.full((1, 4), 0.1)}
    made = {**arrays, "true.values": np.full(4, 1.1), "recovered.values": np.full((1, 4), 1.05)}
    text = io.StringIO()
    found = compare_figures({"gains": arrays}, {"gains": made})
    show(Regression("here", "there", found, []), Console(file=text, width=140))
    lines = [line for line in text.getvalue().splitlines() if "gains: " in line and "│" in line]
    assert ["true.values" in line and "beyond" in line for line in lines] == [True, False]
    assert "DOES NOT HOLD" in text.getvalue()


@pytest.mark.parametrize("folder", find_references([FIGURES_FOLDER]), ids=lambda folder: folder.name)
def test_every_published_reference_is_the_same_as_itself(folder):
    """No tolerance asks for an array that the reference does not have, and none is beyond itself."""
    results = read_reference(folder)
    compared = compare_figures(results.figures, results.figures, results.tolerances)
    assert {item.status for item in compared} == {"same"}


@pytest.mark.parametrize(
    "name", ["minredundant", "redundant", "redundant-modelling", "lowsnr", "paper", "convergence", "runtime"]
)
def test_the_published_references_can_be_read_and_made_again(name):
    kept = FIGURES_FOLDER / name
    results = read_reference(kept)
    assert results.figures
    assert bool(results.claims) == (name != "convergence")
    study = load_study(kept / "experiment.yaml")
    assert study.name == name


def test_default_figures_of_measured_data_have_their_tolerances(tmp_path):
    (tmp_path / "experiment.yaml").write_text("{name: mine, observed: {data: [a.uvh5]}, outputs: {figures: null}}")
    assert rules_of("observed-wedge", read_reference(tmp_path).tolerances)


def test_texts_that_look_like_numbers_stay_texts_in_a_reference(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "manifest.json").write_text('{"name": "mine"}')
    (run / "experiment.yaml").write_text("{name: mine, description: '1e-3'}")
    accept(run, tmp_path / "kept")
    assert RunFolder(tmp_path / "kept").content["description"] == "1e-3"
