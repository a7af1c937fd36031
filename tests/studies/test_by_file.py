"""Calibration by another program, through files: what it is told, and that its row is that of a built-in one."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run_command
from pyuvdata import UVCal, UVData
from score_rows import row
from small_chain import small
from tiny import load

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.calibrators.given_gains import (
    MANIFEST,
    ByFile,
    DataSet,
    Manifest,
    find_returned,
    read_manifest,
)
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.experiment.assumed import assumed_world
from calstudy.instrument.telescope import make_template
from calstudy.products import corruption
from calstudy.products.graph import Graph
from calstudy.products.score import score
from calstudy.studies.export import CARRIER, folders_of
from calstudy.studies.kinds.comparison import WorldData, load_worlds
from calstudy.studies.load import load_study
from calstudy.studies.scores import Scores, leaderboard, read_scores, scoring_of
from calstudy.studies.study import Budget, run_study

pytestmark = pytest.mark.chain

ROOT = Path(__file__).parents[2]
# With the weights of the program of the challenge's page.
SKYCAL = {"calibrator": "skycal", "weights": "flags"}
CALAMITY = {"calibrator": "calamity", "prior": "sky-model", "weights": "flags", "chunks": 1}
ASSUMED = {"sky.foregrounds.errors": {"flux_scatter": 0.01}}
NAMES = [f"data-{number}" for number in range(1, 5)]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with an experiment of 7 antennas that are not where they are said to be, and data with flags."""
    folder = tmp_path_factory.mktemp("by-file")
    data = small(
        folder,
        instrument__as_built={"positions": {"scatter": "3 cm"}},
        corruption__effects=[
            {"kind": "per-channel-gains", "sigma": 0.1, "seed": 5},
            {"kind": "channel-flags", "band_edges": "400 kHz", "coarse_edges": "0 Hz", "coarse_centres": False},
        ],
        calibration={**SKYCAL, "chunks": 1, "assumed": ASSUMED},
    )
    data["name"] = "secret-name"
    (folder / "secret.yaml").write_text(yaml.safe_dump(data))
    return folder


def command(*arguments) -> None:
    """Run a command that must succeed."""
    from calstudy.cli import main as cli

    cli.app([str(argument) for argument in arguments], standalone_mode=False)


@pytest.fixture(scope="module")
def exported(home):
    command("export", home / "secret.yaml", "--output", home / "out", "--workers", 1)
    return home / "out"


def calibrate(exported, folder, block, models: bool = False):
    """Calibrate what was exported as it says in its README, and put gains, and perhaps models, into a new folder."""
    folder.mkdir()
    shutil.copyfile(exported / MANIFEST, folder / MANIFEST)
    manifest, calibrator = read_manifest(exported / MANIFEST), CALIBRATORS.make(block)
    sky = UVData.from_file(exported / manifest.sky_model)
    for item in manifest.data:
        found = run_calibrator(calibrator, UVData.from_file(exported / item.file), sky, noise=manifest.noise)
        found.gains.write_calh5(folder / f"{item.name}.calh5")
        if models:
            # A model must not be flagged where data are.
            found.model.flag_array[:] = False
            found.model.write_uvh5(folder / f"{item.name}.model.uvh5")
    return folder


@pytest.fixture(scope="module")
def skycal(exported, home):
    return calibrate(exported, home / "by-skycal", SKYCAL)


def scores_of(home, folder, name="mine"):
    """Score a folder with the command, and return what it writes."""
    path = home / f"{name}.json"
    command("score", home / "secret.yaml", folder, "--name", name, "--output", path, "--overwrite", "--workers", 1)
    return read_scores(path)


def assert_same_bands(scores, others):
    """Gains from a file have no linear response."""
    for band, other in zip(scores["bands"], others["bands"], strict=True):
        assert band.pop("k") == other.pop("k")
        for one in (band, other):
            one.pop("linear_transfer", None)
        assert band == pytest.approx(other, rel=1e-9)


def assert_tells_nothing(folder, home):
    """No file has the name of the experiment, of its folders, of a variant, an effect or a realization."""
    words = ["secret", "even", "odd", "eor", "residual", "per-channel", "as_built", "mwa-compact", str(home), "/store"]
    for path in (path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes().lower()
        for word in words:
            # Letters on either side make another word, as in "model".
            assert not re.search(rb"(?<![a-z])" + re.escape(word.encode().lower()) + rb"(?![a-z])", content), path


def test_nothing_of_the_truth_is_in_the_folder(exported, home):
    assert {path.name for path in exported.iterdir()} == {
        MANIFEST,
        "README.md",
        "sky-model.uvh5",
        *(f"{name}.uvh5" for name in NAMES),
    }
    experiment = load(home / "secret.yaml")
    nominal = make_template(experiment.instrument.nominal()).telescope.antenna_positions
    built = make_template(experiment.instrument, as_built=True).telescope.antenna_positions
    assert np.abs(built - nominal).max() > 0.01
    assert_tells_nothing(exported, home)
    for path in exported.iterdir():
        if path.suffix == ".uvh5":
            uvd = UVData.from_file(path)
            assert np.array_equal(uvd.telescope.antenna_positions, nominal)
            assert not uvd.extra_keywords
            assert "calstudy export" in uvd.history
            assert (uvd.nsample_array == 1).all()


def test_data_are_those_of_the_run_and_the_sky_model_is_what_is_assumed(exported, home):
    graph = Graph(load(home / "secret.yaml"))
    manifest = read_manifest(exported / MANIFEST)
    variants = [graph.experiment.variants[name] for name in ("residual", "residual_without_eor")]
    tasks = {
        task.key: task
        for task in (corruption.data(graph, variant, parity) for variant in variants for parity in ("even", "odd"))
    }
    assert {item.digest for item in manifest.data} == set(tasks)
    for item in manifest.data:
        stored = UVData.from_file(home / "store" / "corrupt" / item.digest / "data.uvh5")
        given = UVData.from_file(exported / item.file)
        assert np.array_equal(to_cube(given), to_cube(stored))
        assert np.array_equal(given.flag_array, stored.flag_array)
        assert given.flag_array.any()
    assert (assumed_world(graph.experiment).sky.foregrounds) != graph.experiment.sky.foregrounds
    # The phases of the true baselines are off by up to sqrt(2) 2 pi 3 cm / 1.7 m = 0.15 rad, fluxes by 1 %.
    [true] = [
        path
        for path in (home / "store" / "simulate").glob("*/visibilities.uvh5")
        if json.loads((path.parent / "product.json").read_text())["label"] == "foregrounds"
    ]
    sky, truth = (to_cube(UVData.from_file(path)) for path in (exported / manifest.sky_model, true))
    assert 0.01 < np.linalg.norm(sky - truth) / np.linalg.norm(truth) < 0.2


@pytest.mark.parametrize(("block", "models"), [(SKYCAL, False), (CALAMITY, True)], ids=["skycal", "calamity"])
def test_a_built_in_calibrator_through_files_gives_its_own_row(exported, home, block, models, tmp_path):
    """Gains, and models of double precision, come back as they went: what is left is the order of sums."""
    own = home / "own.json"
    settings = {**SKYCAL, "chunks": 1} if block == SKYCAL else block
    change = f"calibration={json.dumps({**settings, 'assumed': ASSUMED})}"
    command("score", home / "secret.yaml", "--set", change, "--output", own, "--overwrite", "--workers", 1)
    found = scores_of(home, calibrate(exported, tmp_path / "back", block, models))
    [mine], [built_in] = found.rows, read_scores(own).rows
    assert mine.digest == built_in.digest
    for name in ("flux_scale", "gain_error_aligned", "gain_error_as_fitted", "held_out_chi_squared", "sky_model_error"):
        assert mine.scores[name] == pytest.approx(built_in.scores[name], rel=1e-9), name
    assert_same_bands(mine.scores, built_in.scores)
    assert set(mine.scores["by_status"]) == {"by-file"}
    assert mine.scores["cpu_seconds_per_integration"] is None


def test_data_sets_are_told_by_their_digests_and_not_by_their_names(skycal, home, tmp_path):
    other = tmp_path / "renamed"
    other.mkdir()
    text = (skycal / MANIFEST).read_text()
    for name, turned in zip(NAMES, NAMES[::-1], strict=True):
        shutil.copyfile(skycal / f"{name}.calh5", other / f"{turned}.calh5")
        text = text.replace(f'"{name}"', f'"<{turned}>"')
    (other / MANIFEST).write_text(text.replace("<", "").replace(">", ""))
    assert scores_of(home, other, "renamed").rows[0].scores == scores_of(home, skycal).rows[0].scores


HEXAGON = ("instrument.layout={kind: hex, side: 3, spacing: 14 m}", "power.pairs=redundant-group")


@pytest.mark.parametrize(
    ("changes", "flagged"), [((), None), ((), 2), (HEXAGON, 0)], ids=["all", "one antenna flagged", "in groups"]
)
def test_the_true_gains_and_foregrounds_leave_all_of_the_signal_and_nothing_else(home, tmp_path, changes, flagged):
    """With V = g_a g_b* (F + S + N), division by g_a g_b* and subtraction of F leave S and N: T = s = 1, no bias.

    Baselines of an antenna without gains have no part in any of the powers that are compared.
    """
    experiment = load(home / "secret.yaml", overrides=list(changes))
    template = make_template(experiment.instrument)
    from calstudy.base.gains import make_uvcal
    from calstudy.base.observation import Observation
    from calstudy.corrupt.interface import draw_truth

    gains = draw_truth(experiment.corruption.effects[0], Observation(template))["gains"]
    cal = make_uvcal(template, gains)
    if flagged is not None:
        cal.flag_array[flagged] = True
    cal.write_calh5(tmp_path / "true.calh5")
    change = json.dumps({"calibrator": "by-file", "gains": str(tmp_path / "true.calh5"), "assumed": {}})
    path = tmp_path / "true.json"
    command("score", home / "secret.yaml", "--set", f"calibration={change}", "--set", "instrument.as_built={}",
            *(part for change in changes for part in ("--set", change)), "--output", path, "--workers", 1)  # fmt: skip
    [row] = read_scores(path).rows
    assert row.scores["flux_scale"] == pytest.approx(1, abs=1e-9)
    assert row.scores["gain_error_as_fitted"] < 1e-9
    for band in row.scores["bands"]:
        # Data are stored as complex64: 6e-8 of foregrounds that are 1e4 times the EoR, of one sample in many.
        assert band["transfer"] == pytest.approx(1, abs=1e-3)
        assert abs(band["bias"]) < 4 * band["bias_error"] + 0.01


def change_gains(source, target, change):
    """Copy a folder, with the gains of data-1 changed."""
    shutil.copytree(source, target)
    cal = UVCal.from_file(source / "data-1.calh5")
    changed = change(cal)
    cal = cal if changed is None else changed
    cal.write_calh5(target / "data-1.calh5", clobber=True)
    return target


def larger(cal):
    cal.gain_array *= 1.01


def later(cal):
    cal.time_array = cal.time_array + 1e-3
    cal.set_lsts_from_time_array()


def spoilt(cal):
    cal.gain_array[2, 4, 0, 0] = np.nan
    cal.flag_array[2, 4, 0, 0] = False


FAULTS = {
    "antenna": (lambda cal: cal.select(antenna_nums=cal.ant_array[1:], inplace=False), "no solution for antenna"),
    "channel": (lambda cal: cal.select(freq_chans=range(20), inplace=False), "no channel at"),
    "nan": (spoilt, "1 gains are zero or not finite, and not flagged, the first of antenna"),
    "flags": (lambda cal: cal.flag_array.fill(True), "all gains are flagged"),
    "time": (later, "no solution within half an integration"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_faults_of_gains_are_sentences(skycal, home, tmp_path, capsys, kind):
    change, sentence = FAULTS[kind]
    folder = change_gains(skycal, tmp_path / "bad", change)
    status, text = run_command(capsys, "score", home / "secret.yaml", folder, "--workers", 1)
    assert status == 2
    assert sentence in text
    assert "data-1.calh5" in text
    assert "Traceback" not in text


def test_faults_of_folders_are_sentences(skycal, home, tmp_path, capsys):
    def told(folder, file=home / "secret.yaml", *more):
        status, text = run_command(capsys, "score", file, folder, *more)
        assert status == 2
        return text

    assert "no such folder" in told(tmp_path / "nowhere")
    assert "has no manifest.json" in told(tmp_path)
    assert "other digests" in told(skycal, home / "secret.yaml", "--set", "corruption.noise.seeds=[17, 18]")
    lacking = tmp_path / "lacking"
    shutil.copytree(skycal, lacking)
    shutil.copy(lacking / "data-2.calh5", lacking / "data-2.calfits")
    assert "has data-2.calh5 and data-2.calfits; keep one" in told(lacking)
    (lacking / "data-2.calfits").unlink()
    (lacking / "data-3.calh5").unlink()
    assert "no gains for data-3 (allowed: data-3.calh5, data-3.calfits, data-3.cal, data-3.h5, " in told(lacking)
    (lacking / "data-3.calh5").write_text("nothing")
    assert "not a readable file of CalH5, calfits, H5Parm, hyperdrive or calibrate" in told(lacking)
    (lacking / MANIFEST).write_text('{"calstudy": "0"}')
    assert "is not a manifest of 'calstudy export' (digest: Field required)" in told(lacking)
    status, text = run_command(capsys, "export", home / "secret.yaml", "--output", skycal)
    assert status == 2
    assert "holds files already; use --overwrite" in text
    assert run_command(capsys, "export", home / "secret.yaml", "--output", tmp_path / "x", "--format", "png")[0] == 2
    with pytest.raises(ExperimentError, match=r"folder = 'nowhere': no such folder"):
        load(home / "secret.yaml", overrides=['calibration={"calibrator": "by-file", "folder": "nowhere"}'])
    with pytest.raises(ExperimentError, match="needs either a folder, or gains for all data"):
        load(home / "secret.yaml", overrides=["calibration=by-file"])


def worlds_of(path, *overrides):
    return load_worlds(path, None, overrides, CARRIER)


def test_gains_are_not_left_beside_data_that_they_were_not_found_for(home, tmp_path):
    path, seeds = home / "secret.yaml", "corruption.noise.seeds=[17, 18]"
    [case] = worlds_of(path).cases
    data = (DataSet(name="data-1", file="data-1.uvh5", digest="a"),)
    manifest = Manifest(calstudy="0", digest=WorldData.of(case.experiment).digest, data=data)
    (tmp_path / MANIFEST).write_text(manifest.model_dump_json())
    assert folders_of(worlds_of(path, seeds), tmp_path, "uvh5", True) == [tmp_path]
    for name in ("data-1.calh5", "data-1.model.uvh5"):
        (tmp_path / name).touch()
    assert folders_of(worlds_of(path), tmp_path, "uvfits", True) == [tmp_path]
    told = r"holds what was returned for other data, data-1.calh5, data-1.model.uvh5; move these files away"
    with pytest.raises(InputError, match=told):
        folders_of(worlds_of(path, seeds), tmp_path, "uvh5", True)


def test_several_worlds_are_not_written_below_the_manifest_of_one(tmp_path):
    (tmp_path / MANIFEST).touch()
    with pytest.raises(InputError, match=r"has the manifest.json of a single world, .*; use another folder"):
        folders_of(worlds_of(ROOT / "experiments" / "challenge.yaml"), tmp_path, "uvh5", True)


def test_another_format_replaces_the_data_of_an_export_and_nothing_else(exported, home, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(exported, folder)
    kept = {"data-1.calh5", "data-1.model.uvh5", "data-9.uvh5", "notes.txt"}
    for name in kept:
        (folder / name).touch()
    command("export", home / "secret.yaml", "--output", folder, "--format", "uvfits", "--overwrite", "--workers", 1)
    written = {MANIFEST, "README.md", "sky-model.uvfits", *(f"{name}.uvfits" for name in NAMES)}
    assert {path.name for path in folder.iterdir()} == written | kept
    for place, told in ((folder, True), (exported, False)):
        assert ("gains found from the columns of the files must be" in (place / "README.md").read_text()) == told


def test_gains_of_the_other_convention_are_inverted(skycal, home, tmp_path):
    def inverted(cal):
        cal.gain_array[:] = 1 / cal.gain_array
        cal.gain_convention = "multiply"

    calibrator = ByFile(folder=change_gains(skycal, tmp_path / "inverted", inverted))
    data = UVData.from_file(home / "out" / "data-1.uvh5")
    sky = UVData.from_file(home / "out" / "sky-model.uvh5")
    manifest = read_manifest(skycal / MANIFEST)
    which = manifest.data[0].digest, manifest.sky_model_digest
    found, expected = (
        run_calibrator(found.for_data(*which), data, sky) for found in (calibrator, ByFile(folder=skycal))
    )
    assert np.allclose(found.gains.gain_array, expected.gains.gain_array, rtol=1e-12)
    assert np.array_equal(found.gains.flag_array, expected.gains.flag_array)


def test_a_folder_takes_part_in_a_comparison_beside_the_built_in_ones(skycal, home):
    """It has gains for the first world alone, and is left out in the other."""
    data = {
        "name": "compared",
        "experiment": "secret.yaml",
        "calibrators": {"built in": {**SKYCAL, "chunks": 1}, "mine": {"calibrator": "by-file",
                        "folder": skycal.name}},
        "worlds": {"first": {"calibration.assumed": ASSUMED}, "second": {"corruption.noise.seeds": [17, 18]}},
        "figures": ["comparison-matrix"],
    }  # fmt: skip
    path = home / "comparison.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    study = load_study(path)
    assert [bool(case.refusal) for case in study.cases] == [False, False, False, True]
    run = run_study(study, Budget(workers=1))
    found = json.loads((run.folder / "tables" / "comparison.json").read_text())
    assert_same_bands(found["first"]["mine"], found["first"]["built in"])
    text = (run.folder / "tables" / "comparison.md").read_text()
    assert "mine cannot work here" in text
    assert re.search(r"\| mine \|.*8 by-file \| - \| - \|", text)


def test_the_content_of_gains_decides_the_key(skycal, home, tmp_path):
    def key(folder):
        block = {"calibrator": "by-file", "folder": str(folder), "assumed": ASSUMED}
        return score(Graph(load(home / "secret.yaml", overrides=[f"calibration={json.dumps(block)}"]))).key

    same, other = tmp_path / "same", tmp_path / "other"
    shutil.copytree(skycal, same)
    change_gains(skycal, other, larger)
    assert key(same) == key(skycal) != key(other)


def test_worlds_of_a_comparison_get_folders_without_their_names(home, tmp_path, exported):
    data = {
        "name": "compared",
        "experiment": str(home / "secret.yaml"),
        "calibrators": {"none": "none"},
        "worlds": {"positions off": {"calibration.assumed": ASSUMED}, "ideal": {"instrument.as_built": {}}},
    }
    path = tmp_path / "comparison.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    command("export", path, "--output", tmp_path / "worlds", "--workers", 1)
    folders = sorted((tmp_path / "worlds").iterdir())
    assert [folder.name for folder in folders] == ["world-1", "world-2"]
    first, second = (read_manifest(folder / MANIFEST) for folder in folders)
    assert first == read_manifest(exported / MANIFEST)
    assert first.digest != second.digest
    with pytest.raises(InputError, match="no gains for data-"):
        find_returned(tmp_path / "worlds", second.data[0].digest, second.sky_model_digest)


def test_gains_of_a_world_are_not_taken_for_those_of_one_with_the_same_data_and_another_sky_model(
    skycal, home, tmp_path
):
    data = {
        "name": "compared",
        "experiment": str(home / "secret.yaml"),
        "calibrators": {"mine": {"calibrator": "by-file", "folder": str(tmp_path / "back")}},
        "worlds": {"as assumed": {"calibration.assumed": ASSUMED}, "all known": {"calibration.assumed": {}}},
    }
    path = tmp_path / "comparison.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    shutil.copytree(skycal, tmp_path / "back" / "world-1")
    first, second = load_study(path).cases
    of_both = [{task.key for task in WorldData.of(case.experiment).data} for case in (first, second)]
    assert of_both[0] == of_both[1]
    assert first.refusal == ""
    assert "of a world with another sky model" in second.refusal
    # With a folder of its own, each world has its own gains.
    own = tmp_path / "back" / "world-2"
    change_gains(skycal, own, larger)
    manifest = json.loads((own / MANIFEST).read_text())
    manifest["sky_model_digest"] = WorldData.of(second.experiment).sky_model.key
    (own / MANIFEST).write_text(json.dumps(manifest))
    first, second = load_study(path).cases
    assert (first.refusal, second.refusal) == ("", "")
    assert score(Graph(first.experiment)).key != score(Graph(second.experiment)).key


# pyuvdata 3.2 leaves the SIGMA of samples without weight undefined.
@pytest.mark.filterwarnings("ignore:'where' used without 'out':UserWarning")
@pytest.mark.parametrize("file_format", ["uvfits", "ms"])
def test_other_formats_hold_the_same_data(exported, home, tmp_path, file_format):
    """Both store single precision, and are phased: what comes back agrees to 1e-6 of the largest visibility."""
    if file_format == "ms":
        pytest.importorskip("casacore", reason="the extra [ms] is not installed")
    from calstudy.realdata.reading import prepare

    folder = tmp_path / "out"
    command("export", home / "secret.yaml", "--output", folder, "--format", file_format, "--workers", 1)
    assert read_manifest(folder / MANIFEST).digest == read_manifest(exported / MANIFEST).digest
    assert_tells_nothing(folder, home)
    for name in (*NAMES, "sky-model"):
        given = UVData.from_file(exported / f"{name}.uvh5")
        found, _ = prepare(UVData.from_file(str(folder / f"{name}.{file_format}")))
        assert np.abs(to_cube(found) - to_cube(given)).max() < 1e-6 * np.abs(given.data_array).max()
        assert np.array_equal(found.flag_array, given.flag_array)
        # Positions are stored about the centre of the Earth, to the double's 1e-9 m; 4 um is a tenth of a turn's 1e-5.
        assert np.allclose(found.telescope.get_enu_antpos(), given.telescope.get_enu_antpos(), atol=4e-6)


def test_gains_come_back_as_casa_tables(skycal, exported, tmp_path):
    """CASA stores complex64: 6e-8 of gains near one."""
    pytest.importorskip("casacore", reason="the extra [ms] is not installed")
    folder = tmp_path / "casa"
    folder.mkdir()
    shutil.copyfile(skycal / MANIFEST, folder / MANIFEST)
    manifest = read_manifest(skycal / MANIFEST)
    for item in manifest.data:
        UVCal.from_file(skycal / f"{item.name}.calh5").write_ms_cal(str(folder / f"{item.name}.cal"))
    data, sky = (UVData.from_file(exported / name) for name in ("data-1.uvh5", "sky-model.uvh5"))
    which = manifest.data[0].digest, manifest.sky_model_digest
    found, own = (run_calibrator(ByFile(folder=place).for_data(*which), data, sky).gains for place in (folder, skycal))
    assert np.array_equal(found.flag_array, own.flag_array)
    assert np.abs(found.gain_array - own.gain_array).max() < 1e-6 * np.abs(own.gain_array).max()


@pytest.mark.parametrize(
    ("passes", "weights"),
    # Passes go half of the way, so that 25 end within 1e-7 of where they lead.
    [(1, "flags"), (25, {"kind": "gains", "passes": 30, "tolerance": 1e-8})],
    ids=["equal", "own"],
)
def test_the_program_of_the_challenge_page_finds_the_gains_of_skycal(exported, tmp_path, passes, weights):
    """Two programs minimize the same function; the phase of all antennas together is free in every channel."""
    folder = tmp_path / "copy"
    shutil.copytree(exported, folder)
    skycal = calibrate(exported, tmp_path / "by-skycal", {**SKYCAL, "weights": weights})
    page = (ROOT / "docs" / "challenge" / "README.md").read_text()
    [code] = re.findall(r"```python\n(# calibrate.py.*?)```", page, re.DOTALL)
    (tmp_path / "calibrate.py").write_text(code)
    subprocess.run([sys.executable, tmp_path / "calibrate.py", folder, str(passes)], check=True)
    for name in NAMES:
        found, expected = (UVCal.from_file(place / f"{name}.calh5") for place in (folder, skycal))
        assert np.array_equal(found.flag_array, expected.flag_array)
        products = [
            np.where(cal.flag_array, 0, cal.gain_array)[:, None] * np.where(cal.flag_array, 0, cal.gain_array).conj()
            for cal in (found, expected)
        ]
        # Both stop at changes of 1e-8 of the gains; StefCal converges by about a factor of two each step.
        assert np.allclose(*products, atol=1e-6)


def test_a_calibrator_is_scored_by_its_name(home, capsys):
    path = home / "none.json"
    change = f"calibration.assumed={json.dumps(ASSUMED)}"
    command("score", home / "secret.yaml", "--calibrator", "none", "--set", change, "--output", path, "--workers", 1)
    [found] = read_scores(path).rows
    assert found.calibrator == "none"
    # Gains of one, whose true values are off by 10 % in real and imaginary part.
    assert found.scores["gain_error_as_fitted"] == pytest.approx(0.1 * np.sqrt(2), rel=0.3)
    for options, sentence in {
        ("--calibrator", "none", home): "cannot be given together with a folder",
        ("--calibrator", "[1]"): "must be a name, a file.py, or a block",
        ("--name", "mine"): "names the row of a folder or of --calibrator",
        ("--output", path): "is there already; use --overwrite",
    }.items():
        status, text = run_command(capsys, "score", home / "secret.yaml", *options)
        assert status == 2
        assert sentence in text


def test_the_leaderboard_has_all_scores_and_these_are_of_the_challenge():
    folder = ROOT / "docs" / "challenge"
    page = leaderboard(folder)
    worlds = load_worlds(ROOT / "experiments" / "challenge.yaml", None, (), CARRIER)
    digests = {case.world: (WorldData.of(case.experiment).digest, scoring_of(case.experiment)) for case in worlds.cases}
    for path in folder.glob("*.json"):
        for item in read_scores(path).rows:
            assert (item.digest, item.scoring) == digests[item.world], f"{path.name}: {item.world}"
            assert f"| {item.calibrator} |" in page


def test_a_leaderboard_ranks_by_what_is_unbiased_first_and_then_by_what_is_left(tmp_path):
    def store(name, *rows):
        (tmp_path / f"{name}.json").write_text(Scores(calstudy="0", name="c", rows=rows).model_dump_json())

    # A large bias that is uncertain does not count for none; of the others the one that keeps more is ahead.
    store("a", row("1", "uncertain", (0, -3), 2, (1, 1)), row("1", "loses", (0, 0.1), 0.1, (0.4, 0.9)))
    store("b", row("1", "keeps", (0.1, 0), 0.1, (0.9, 0.9)))
    text = leaderboard(tmp_path)
    ranked = re.findall(r"^\| (\w+) \|", text.split("## 1")[0], re.MULTILINE)
    assert ranked == ["calibrator", "keeps", "loses", "uncertain"]
    assert "| keeps | 2 of 2, T 0.90 |" in text
    assert "| uncertain | 0 of 2 |" in text
    store("c", row("1", "keeps", (0, 0), 0.1, (0.9, 0.9)))
    with pytest.raises(InputError, match=r"c.json: 'keeps' has scores in the world '1' twice"):
        leaderboard(tmp_path)
    store("c", row("1", "other", (0, 0), 0.1, (0.9, 0.9), digest="e"))
    with pytest.raises(InputError, match=r"'other' was scored on other data"):
        leaderboard(tmp_path)
    store("c", row("1", "other", (0, 0), 0.1, (0.9, 0.9), scoring="z"))
    with pytest.raises(InputError, match=r"'other' was measured otherwise than others in the world '1'"):
        leaderboard(tmp_path)
    content = Scores(calstudy="0", name="c", rows=(row("1", "other", (0, 0), 0.1, (0.9, 0.9)),)).model_dump()
    content["rows"][0]["scores"] = {}
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="scores: Value error, bands: Field required"):
        leaderboard(tmp_path)
    (tmp_path / "c.json").write_text("{}")
    with pytest.raises(InputError, match="is not a file of 'calstudy score --output'"):
        leaderboard(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        leaderboard(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="has no files of scores"):
        leaderboard(tmp_path / "empty")
