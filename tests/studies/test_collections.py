"""Collections: members share what they can, keep their own folders, and are compared."""

import io
import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run_command
from rich.console import Console
from tiny import of_the_paper

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.files import sha256
from calstudy.claims.evaluation import evaluate_folder
from calstudy.cli import main as cli
from calstudy.experiment.files import override
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.products import corruption, simulation
from calstudy.products.spectra import power
from calstudy.regression import accept
from calstudy.run.execution import schedule
from calstudy.run.store import Store
from calstudy.studies.kinds.collection import Collection
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.load import load_study
from calstudy.studies.show import describe_plan
from calstudy.studies.study import Budget, Run, run_study
from calstudy.verdicts.tables import from_json

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
NOISES = {"realizations": [{"draw": ["noise"], "count": 2}], "papers": [], "outputs.figures": []}
PAIR = {
    "name": "pair",
    "experiments": [
        "hex.yaml",
        {"file": "hex.yaml", "name": "redundant", "overrides": {"corruption.effects.0.seed": 6}},
    ],
    "roles": {"minimally_redundant": "hexagon"},
    "figures": ["layouts", "spherical-comparison"],
}


def write(folder: Path, **changes) -> Path:
    """Write a collection of two hexagons with different gains, and, for other collections, one with reflections."""
    hexagon = {**override(of_the_paper(folder), "outputs.figures", ["gains"]), "name": "hexagon"}
    reflecting = override({**hexagon, "name": "lowsnr"}, "corruption.effects", ["reflection-gains"])
    for name, data in (("hex", hexagon), ("reflections", reflecting)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(data))
    path = folder / "pair.yaml"
    path.write_text(yaml.safe_dump({**PAIR, **changes}))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    folder = tmp_path_factory.mktemp("collection")
    (folder / "store").symlink_to(shared_store)
    return folder


@pytest.fixture(scope="module")
def collection(folder) -> Collection:
    return load_study(write(folder))


@pytest.fixture(scope="module")
def finished(collection) -> Run:
    return run_study(collection, Budget(1), Console(file=io.StringIO()))


def keys_of(study: ExperimentStudy, stage: str) -> set[str]:
    return {task.key for task in study.tasks if task.stage.name == stage}


def test_members_share_every_product_that_they_can(collection):
    first, second = collection.parts.values()
    assert keys_of(first, "simulate") == keys_of(second, "simulate")
    assert keys_of(first, "levels") == keys_of(second, "levels")
    assert power(first.graph, "noise").key == power(second.graph, "noise").key
    assert keys_of(first, "gains").isdisjoint(keys_of(second, "gains"))
    assert power(first.graph, "residual").key != power(second.graph, "residual").key
    keys = [task.key for task in collection.tasks]
    assert len(set(keys)) == len(keys) < len(first.tasks) + len(second.tasks)


@pytest.mark.chain
def test_every_member_gets_its_own_folder_and_the_collection_another(finished, collection):
    assert list(finished.parts) == ["hexagon", "redundant"]
    folders = {run.folder for run in finished.parts.values()} | {finished.folder}
    assert len(folders) == 3
    for run in finished.parts.values():
        names = {path.name for path in run.folder.iterdir()}
        assert {"figures", "tables", "claims.json", "claims.md", "manifest.json", "experiment.yaml"} <= names
    assert finished.folder == collection.folder
    made = {path.name for path in (finished.folder / "figures").iterdir()}
    assert made == {f"{name}.{ending}" for name in PAIR["figures"] for ending in ("png", "pdf", "npz")}


@pytest.mark.chain
def test_the_combined_figure_shows_the_tables_of_the_members(finished):
    with np.load(finished.folder / "figures" / "spherical-comparison.npz") as shown:
        for role, member in (("minimally_redundant", "hexagon"), ("redundant", "redundant")):
            table = finished.parts[member].folder / "tables" / "residual.outside-wedge.h5"
            spectrum = load_spectrum(table, SphericalSpectrum)
            np.testing.assert_array_equal(shown[f"{role}.residual.power"], spectrum.power)
    with np.load(finished.folder / "figures" / "layouts.npz") as shown:
        assert (len(shown["0.numbers"]), len(shown["1.numbers"])) == (7, 7)


@pytest.mark.chain
def test_combined_claims_hold_each_member_to_its_role(finished):
    claims = {claim.name: claim for claim in from_json((finished.folder / "claims.json").read_text())}
    assert claims["redundant-signal-recovered"].runs == ("redundant",)
    assert claims["redundant-modelling-same-power"].verdict == "not evaluated"
    # A hexagon is a redundant array, whatever role a collection gives it, and held to nothing else.
    assert {claims[name].verdict for name in ("noise-reduced", "gains-within-20-percent")} == {"not evaluated"}
    told = (finished.folder / "claims.md").read_text()
    assert "hexagon does not play the role minimally_redundant of calamity2022: too many of the baselines" in told
    alone = {claim.name: claim for claim in from_json((finished.parts["hexagon"].folder / "claims.json").read_text())}
    assert "gains-within-20-percent" not in alone
    assert alone["redundant-signal-recovered"].runs == ("hexagon",)


def test_claims_are_the_same_evaluated_from_the_folders(finished):
    for folder in (finished.folder, finished.parts["redundant"].folder):
        written = from_json((folder / "claims.json").read_text())
        assert evaluate_folder(folder).verdicts == written


def test_a_second_run_makes_nothing_and_a_member_alone_has_everything(finished, collection, folder):
    again = run_study(collection, Budget(1), Console(file=io.StringIO()))
    assert again.made.tasks == ()
    assert all(run.made.tasks == () for run in again.parts.values())
    store = Path(of_the_paper(folder)["outputs"]["store"])
    alone = ExperimentStudy(collection.members["redundant"])
    assert all((store / task.stage.name / task.key).exists() for task in alone.targets)
    assert alone.folder == finished.parts["redundant"].folder
    manifest = json.loads((finished.folder / "manifest.json").read_text())
    assert set(manifest["members"]) == set(collection.members)


def test_scale_and_overrides_reach_every_member(folder):
    changed = load_study(write(folder), overrides=["power.length_bin=5 m"])
    assert {experiment.power.length_bin for experiment in changed.members.values()} == {5.0}
    with pytest.raises(InputError, match=r"experiments\.0 \(hex\.yaml\): --scale small"):
        load_study(write(folder), scale="small")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"experiment": []}, "experiment: unknown key, did you mean 'experiments'?"),
        ({"experiments": []}, "experiments: must have at least 1 item(s), has 0"),
        ({"experiments": [{"file": "hex.yaml", "nam": "a"}]}, "experiments.0.nam: unknown key, did you mean 'name'?"),
        ({"experiments": [{"name": "a"}]}, "experiments.0.file: missing, and it has no default"),
        ({"experiments": ["hex.yaml", "hex.yaml"]}, "experiments.1: a second 'hexagon'; give it a `name` of its own"),
        (
            {"figures": ["layout"]},
            "figures.0: 'layout' is a figure for experiment files, not for collection files, did you mean 'layouts'?",
        ),
        ({"figures": ["layuot"]}, "figures.0: 'layuot' is not a figure, did you mean 'layout'?"),
        ({"roles": {"redundant": "line"}}, "roles.redundant = 'line': not a member (there are: hexagon, redundant)"),
        ({"roles": {"low_snr": "hexagon"}}, "roles.low_snr = 'hexagon': corruption.effects is per-channel-gains"),
        ({"roles": {"redundant": "lowsnr"}, "experiments": ["reflections.yaml"]}, "not per-channel-gains alone"),
        ({"roles": {}}, "figures: asks for 'layouts', which needs a member in the role(s) minimally_redundant"),
        (
            {"experiments": [{"file": "hex.yaml", "overrides": {"calibration.bufer": 1}}]},
            "experiments.0 (hex.yaml): calibration.bufer: unknown key",
        ),
        (
            {"experiments": ["reflections.yaml", {"file": "hex.yaml", "overrides": {"outputs.store": "x"}}]},
            "have different outputs.store",
        ),
    ],
)
def test_a_fault_is_told_in_the_files_own_terms(tmp_path, changes, told):
    with pytest.raises(ExperimentError) as caught:
        load_study(write(tmp_path, **changes))
    assert any(told in sentence for sentence in caught.value.faults), caught.value.faults


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"experiments": ["none.yaml"]}, r"experiments\.0 \(none\.yaml\): .*cannot be read"),
        ({"experiments": ["pair.yaml"]}, r"experiments\.0 \(pair\.yaml\): has the key 'experiments'"),
    ],
)
def test_a_member_that_cannot_be_used_is_told(tmp_path, changes, told):
    with pytest.raises(InputError, match=told):
        load_study(write(tmp_path, **changes))


def test_an_experiment_file_is_an_experiment(folder):
    write(folder)
    assert isinstance(load_study(folder / "hex.yaml"), ExperimentStudy)


@pytest.mark.parametrize("scale", [None, "small"])
def test_the_papers_collection_shares_its_simulations(scale):
    collection = load_study(EXPERIMENTS / "paper.yaml", scale)
    graphs = {name: part.graph for name, part in collection.parts.items()}
    for component in (simulation.foregrounds, simulation.eor):
        assert component(graphs["minredundant"]).key == component(graphs["lowsnr"]).key
    assert corruption.gains(graphs["redundant"]).key == corruption.gains(graphs["redundant-modelling"]).key
    assert set(collection.roles) == {"minimally_redundant", "redundant", "redundant_modelling", "low_snr"}


def elsewhere(folder: Path, place: Path, *overrides: str) -> Collection:
    """Return the same collection with an empty store, and a folder of runs, in another place."""
    changes = [f"outputs.store={place / 'store'}", f"outputs.runs={place / 'runs'}", *overrides]
    return load_study(write(folder), overrides=changes)


@pytest.mark.parametrize("command", ["run", "plan"])
def test_finished_members_are_not_made_again_by_a_strict_run(tmp_path, capsys, command):
    (tmp_path / "study.yaml").write_text("{name: both, experiments: [a.yaml]}")
    (tmp_path / "a.yaml").write_text("name: a")
    status, told = run_command(capsys, command, tmp_path / "study.yaml", "--strict", "--finished", tmp_path)
    assert (status, told.count("\n")) == (2, 1)
    assert "--strict: makes all products of other code again, and --finished takes some" in told


def test_members_that_were_run_elsewhere_are_compared_without_being_run(finished, folder, tmp_path):
    runs = finished.folder.parent
    text = io.StringIO()
    taken = elsewhere(folder, tmp_path).with_finished([runs], Console(file=text, width=300))
    assert [line[: line.index("/")] for line in text.getvalue().splitlines()] == [
        f"{name}: taken from " for name in ("hexagon", "redundant")
    ]
    result = run_study(taken, Budget(1), Console(file=io.StringIO()))
    assert {task.stage.name for task in result.made.tasks} == {"figure", "claims"}
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {result.folder.name}
    assert result.folder.name == finished.folder.name
    told = [*result.warnings, *json.loads((result.folder / "manifest.json").read_text())["warnings"]]
    assert not any("no longer in the store" in warning for warning in told)
    for name in PAIR["figures"]:
        arrays = [np.load(run.folder / "figures" / f"{name}.npz") for run in (finished, result)]
        assert all(
            np.array_equal(arrays[0][key], arrays[1][key], equal_nan=True) for key in arrays[0] if key[-5:] != "title"
        )
    claims = [from_json((run.folder / "claims.json").read_text()) for run in (finished, result)]
    assert claims[0] == claims[1] == evaluate_folder(result.folder).verdicts


def test_a_member_can_come_from_a_reference_and_others_are_run(finished, folder, tmp_path):
    reference = tmp_path / "figures" / "hexagon"
    accept(finished.parts["hexagon"].folder, reference)
    taken = elsewhere(folder, tmp_path).with_finished([tmp_path / "figures"], Console(file=io.StringIO()))
    assert list(taken.parts) == ["redundant"]
    assert taken.finished == {"hexagon": reference}
    stages = {task.stage.name for task in schedule(taken.targets, Store(tmp_path / "store")).todo}
    assert stages >= {"simulate", "calibrate"}


def test_a_plan_with_finished_members_is_what_the_run_makes_and_leaves_the_store_alone(finished, folder, tmp_path):
    there, runs = elsewhere(folder, tmp_path), [finished.parts["hexagon"].folder]
    planned = there.with_finished(runs, Console(file=io.StringIO()), planned=True)
    plan = describe_plan(planned, Budget(1))
    assert not (tmp_path / "store").exists()
    taken = there.with_finished(runs, Console(file=io.StringIO()))
    counts = Counter(task.stage.name for task in schedule(taken.targets, Store(tmp_path / "store")).todo)
    assert {row["stage"]: row["to_make"] for row in plan["stages"] if row["to_make"]} == counts
    # Without the option the other member is counted as well.
    assert sum(counts.values()) < sum(row["to_make"] for row in describe_plan(there, Budget(1))["stages"])


def test_the_plan_in_json_is_alone_on_standard_output(finished, folder, tmp_path, capsys):
    changes = [text for field in ("store", "runs") for text in ("--set", f"outputs.{field}={tmp_path / field}")]
    arguments = ["plan", write(folder), "--finished", finished.folder.parent, "--json", *changes]
    cli.app([str(argument) for argument in arguments], standalone_mode=False)
    printed = capsys.readouterr()
    stages = json.loads(printed.out)["stages"]
    assert {row["stage"] for row in stages if row["to_make"]} == {"figure", "claims"}
    assert printed.err.count("taken from") == len(PAIR["experiments"])


def test_a_finished_run_of_something_else_is_not_taken(finished, folder, tmp_path):
    text, other = io.StringIO(), elsewhere(folder, tmp_path, "power.length_bin=5 m")
    with pytest.raises(InputError, match=r"no finished run of a member is there \(members: hexagon, redundant\)"):
        other.with_finished([finished.folder.parent], Console(file=text, width=300))
    assert "is left out; its tables are of other settings, or another version of a stage" in text.getvalue()
    assert not (tmp_path / "store").exists()


def test_a_run_with_a_changed_table_is_left_out_for_one_that_is_whole(finished, folder, tmp_path):
    whole, run = finished.parts["hexagon"].folder, tmp_path / "old" / "hexagon"
    shutil.copytree(whole, run)
    (run / "tables" / "eor.wedge.h5").write_bytes(b"")
    text = io.StringIO()
    taken = elsewhere(folder, tmp_path).with_finished([run, whole], Console(file=text, width=300))
    assert taken.finished == {"hexagon": whole}
    with pytest.raises(InputError, match="no finished run of a member is there"):
        elsewhere(folder, tmp_path).with_finished([run], Console(file=text, width=300))
    assert "tables/eor.wedge.h5 is not what the run wrote" in text.getvalue()


def test_other_results_in_the_store_are_not_passed_off_as_those_of_the_run(finished, folder, tmp_path):
    """The same study run twice, on machines that round differently, has one key and two results."""
    run = tmp_path / "old" / "hexagon"
    shutil.copytree(finished.parts["hexagon"].folder, run)
    (run / "tables" / "eor.all-modes.csv").write_text("other")
    manifest = json.loads((run / "manifest.json").read_text())
    (entry,) = (item for item in manifest["products"] if "eor.all-modes.csv" in item.get("files", {}))
    entry["files"]["eor.all-modes.csv"] = sha256(run / "tables" / "eor.all-modes.csv")
    (run / "manifest.json").write_text(json.dumps(manifest))
    there = elsewhere(folder, tmp_path)
    assert there.with_finished([run], Console(file=io.StringIO())).finished == {"hexagon": run}
    # The same again is in the store already.
    assert there.with_finished([run], Console(file=io.StringIO())).finished == {"hexagon": run}
    with pytest.raises(
        InputError, match=r"tables/eor\.all-modes\.csv differs from that of the same study in the store"
    ):
        there.with_finished([finished.parts["hexagon"].folder], Console(file=io.StringIO()))


def test_a_member_of_which_more_than_tables_is_needed_is_run(finished, folder, tmp_path):
    text = io.StringIO()
    path = write(
        folder, figures=[], experiments=["hex.yaml", {"file": "hex.yaml", "name": "drawn", "overrides": NOISES}]
    )
    changes = [f"outputs.store={tmp_path / 'store'}", f"outputs.runs={tmp_path / 'runs'}"]
    taken = load_study(path, overrides=changes).with_finished([finished.folder.parent], Console(file=text, width=300))
    write(folder)
    assert list(taken.finished) == ["hexagon"]
    assert "drawn: will be run (it has realizations; such members are always run)" in text.getvalue()


@pytest.mark.parametrize(
    ("file", "place", "told"),
    [
        ("hex.yaml", ".", "only a collection"),
        ("pair.yaml", "nowhere", "nowhere: is not the folder of a finished run, and holds none"),
    ],
)
def test_what_cannot_be_put_together_is_refused(finished, folder, file, place, told):
    with pytest.raises(InputError, match=told):
        load_study(folder / file).with_finished([finished.folder.parent / place], Console(file=io.StringIO()))
