"""Commands to begin with, and those that look after folders: init, examples, schema, runs, store; output as JSON."""

from __future__ import annotations

import errno
import json
import os
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run_command
from jsonschema import Draft202012Validator
from pyuvdata import UVData
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.base.package_files import experiment_names, published
from calstudy.cli import main as cli
from calstudy.experiment.files import dump, override, parse_yaml, validate
from calstudy.run.store import Lease, Store
from calstudy.studies.load import load_study
from calstudy.studies.reference import SCHEMA_FILE, experiment_schema

REFUSED = 2


def output_of(capsys, *arguments: object) -> str:
    """Run a command that must not fail, and return what it prints."""
    cli.app([str(argument) for argument in arguments], standalone_mode=False)
    return capsys.readouterr().out


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


@pytest.fixture(scope="module")
def schema() -> Draft202012Validator:
    content = json.loads(experiment_schema())
    Draft202012Validator.check_schema(content)
    return Draft202012Validator(content)


def test_a_new_experiment_is_valid_with_and_without_its_commented_fields(here, capsys, schema):
    output_of(capsys, "init", "mine")
    text = Path("mine.yaml").read_text()
    # A plan checks it completely.
    assert json.loads(output_of(capsys, "plan", "mine.yaml", "--json"))["name"] == "mine"
    commented = [line for line in text.splitlines() if re.match(r" *# [a-z_]+: ", line)]
    assert len(commented) >= 4
    for line in commented:
        content = parse_yaml(text.replace(line, line.replace("# ", "", 1)), "mine.yaml")
        assert content != parse_yaml(text, "mine.yaml"), line
        validate(content, here)
        assert schema.is_valid(content), line
    assert Path(text.splitlines()[0].partition("$schema=")[2]).is_file()


@pytest.mark.parametrize(("folder", "named"), [(".", "published/experiments/"), ("published/experiments", "")])
def test_a_new_experiment_names_a_schema_of_its_folder_by_a_relative_path(here, capsys, monkeypatch, folder, named):
    monkeypatch.setattr("calstudy.base.package_files.PUBLISHED", here / "published")
    (here / "published" / "experiments").mkdir(parents=True)
    monkeypatch.chdir(here / folder)
    output_of(capsys, "init", "mine")
    assert Path("mine.yaml").read_text().splitlines()[0] == f"# yaml-language-server: $schema={named}{SCHEMA_FILE}"


@pytest.mark.parametrize(
    ("arguments", "name"), [(["init", "mine"], "mine.yaml"), (["fields", "--schema", "s.json"], "s.json")]
)
def test_a_file_that_cannot_be_written_in_full_is_not_there(here, capsys, monkeypatch, arguments, name):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        status, message = run_command(capsys, *arguments)
    assert (status, list(here.iterdir())) == (REFUSED, [])
    assert f"{name}: cannot be written (No space left on device)" in message
    output_of(capsys, *arguments)
    assert (here / name).is_file()


def test_a_file_that_is_a_link_stays_one(here, capsys):
    output_of(capsys, "fields", "--schema", "real.json")
    Path("link.json").symlink_to("real.json")
    before = Path("real.json").read_text()
    Path("real.json").write_text(before + " ")
    output_of(capsys, "fields", "--schema", "link.json")
    assert Path("link.json").is_symlink()
    assert Path("real.json").read_text() == before


def test_a_published_experiment_can_be_copied_under_another_name(here, capsys):
    output_of(capsys, "init", "mine", "--example", "lowsnr")
    copied, original = (
        yaml.safe_load(path.read_text()) for path in (here / "mine.yaml", published("experiments") / "lowsnr.yaml")
    )
    assert copied == {**original, "name": "mine"}


def test_the_experiment_of_which_can_be_copied_and_changed(here, capsys):
    output_of(capsys, "init", "mine", "--example", "which")
    content = yaml.safe_load((here / "mine.yaml").read_text())
    assert content == {**yaml.safe_load((published("experiments") / "which.yaml").read_text()), "name": "mine"}
    assert load_study(here / "mine.yaml", overrides=["worlds={ideal: {}}"]).name == "mine"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["init", "taken"], "exists already, and is not overwritten"),
        (["init", "my study"], "'my study' cannot name an experiment"),
        (["init", "../mine"], "cannot name an experiment"),
        (["init", "mine", "--example", "lowsrn"], "neither a file nor a published experiment"),
        (["plan", "quickstrt"], "nor a published experiment, did you mean 'quickstart'?"),
        (["plan", "quickstart", "--set", "instrument..beam=airy"], "--set instrument..beam=airy: write a dotted path"),
        (["init", "mine", "--example", "paper"], "--example paper: is made of other files"),
        (["init", "mine", "--example", "calibrators"], "--example calibrators: is made of other files"),
        (["init", "mine", "--beam", "hera"], "--beam hera: is the beam of measured data"),
        (
            ["init", "mine", "--data", "hera_qm:data/x", "--beam", "her"],
            "--beam: 'her' is not a beam, did you mean 'hera'",
        ),
        (["fields", "--schema", "nowhere/schema.json"], "--schema nowhere/schema.json: cannot be written"),
        (["fields", "--schema", "taken.yaml"], "--schema taken.yaml: is another file, and is not overwritten"),
        (["fields", "calibration", "--schema", "s.json"], "the schema is of whole files; leave out the section"),
        (["runs", "nowhere"], "nowhere: no such folder of runs"),
        (["store", "nowhere"], "nowhere: no such store"),
        (["store", "store", "--delete"], "--delete: say which products"),
        (["store", "store", "--older-than", "long"], "--older-than long: write a number of hours or days"),
        (["store", "store", "--unreferenced", "--runs", "nowhere"], "nowhere: no such folder of runs"),
    ],
)
def test_mistakes_are_one_sentence_and_change_nothing(arguments, told, here, capsys):
    Path("taken.yaml").write_text("name: taken\n")
    Path("store").mkdir()
    status, message = run_command(capsys, *arguments)
    assert status == REFUSED
    assert told in message
    assert message.count("\n") == 1
    assert sorted(path.name for path in here.iterdir()) == ["store", "taken.yaml"]
    assert Path("taken.yaml").read_text() == "name: taken\n"


def test_all_published_experiments_are_listed(here, capsys):
    listed = output_of(capsys, "init", "--list")
    assert all(name in listed for name in experiment_names())


def test_the_published_schema_is_current_and_every_experiment_names_it():
    folder = published("experiments")
    assert (folder / SCHEMA_FILE).read_text() == experiment_schema(), "run: python -m calstudy fields --schema"
    for name in experiment_names():
        first = (folder / f"{name}.yaml").read_text().splitlines()[0]
        assert first == f"# yaml-language-server: $schema={SCHEMA_FILE}"


@pytest.mark.parametrize("name", experiment_names())
def test_published_experiments_follow_the_schema(name, schema):
    content = parse_yaml((published("experiments") / f"{name}.yaml").read_text(), name)
    assert [error.message for error in schema.iter_errors(content)] == []


def test_an_experiment_with_every_field_follows_the_schema(schema, tmp_path):
    content = yaml.safe_load(dump(validate(tiny(tmp_path), tmp_path)))
    assert [error.message for error in schema.iter_errors(content)] == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("banana", 1),
        ("instrument.layout", "hexx"),
        ("instrument.layout.side", "four"),
        ("instrument.channels.width", 80),
        ("instrument.chanels", {}),
        ("instrument.beam", {"kind": "airy", "radius": "3 m"}),
        ("sky.eor.nside", 65),
        ("corruption.effects", [{"kind": "reflection-gain"}]),
        ("calibration", {"calibrator": "sky-based", "basis": {}}),
        ("calibration.solver", {"name": "adamax", "max_step": 3}),
        ("outputs.figures", ["wegde"]),
        ("sweep", {"sky.eor.seed": 3}),
        ("realizations", {"draw": ["foregrounds"]}),
    ],
)
def test_an_editor_finds_what_a_plan_finds(path, value, schema, tmp_path):
    good = tiny(tmp_path)
    assert schema.is_valid(good)
    assert not schema.is_valid(override(good, path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("calibration.calibrator", "mine.py:Mine"),
        ("calibration", {"calibrator": "mine.py", "anything": 3}),
        ("instrument.beam", "mine.py"),
        ("instrument.location", "hera"),
        ("instrument.location", {"latitude": "-30 deg", "longitude": "21 deg"}),
        ("corruption.effects", ["crosstalk", {"kind": "mine.py"}]),
        ("instrument.as_built.dipoles.dead_fraction", "15 %"),
        ("realizations", [{"draw": ["noise"]}, {"draw": ["eor"], "count": 3}]),
    ],
)
def test_an_editor_accepts_short_forms_and_files_of_ones_own(path, value, schema, tmp_path):
    assert schema.is_valid(override(tiny(tmp_path), path, value))


def test_a_plan_as_json_has_the_numbers_of_the_table(here, capsys):
    Path("tiny.yaml").write_text(yaml.safe_dump(tiny(here)))
    plan = json.loads(output_of(capsys, "plan", "tiny.yaml", "--json"))
    table = output_of(capsys, "plan", "tiny.yaml")
    assert {row["stage"] for row in plan["stages"]} >= {"simulate", "calibrate", "transfer"}
    assert all(row["stage"] in table for row in plan["stages"])
    assert plan["seconds"] == pytest.approx(sum(row["seconds"] for row in plan["stages"]))
    assert plan["store"] == str(here / "store")


def key_of(letter: str) -> str:
    return 32 * letter


def make_product(store: Store, stage: str, letter: str, made_from: str | None = None, days: float = 0.0) -> None:
    """Put a product into a store that was made some days ago; its key is a letter, repeated."""
    key = key_of(letter)
    with store.lock(stage, key), store.building(stage, key) as folder:
        (folder / "data.bin").write_bytes(b"x" * 1000)
        started = (datetime.now(UTC) - timedelta(days=days)).isoformat()
        inputs = {} if made_from is None else {"data": [stage, key_of(made_from)]}
        store.seal(folder, {"stage": stage, "key": key, "label": letter, "started": started, "inputs": inputs})


@pytest.fixture
def used_store(here) -> Store:
    """A store in which `b`, made from `a`, belongs to a run, and `c` and the old `d` to none."""
    store = Store(here / "store")
    store.prepare()
    for key, made_from, days in (("a", None, 50), ("b", "a", 1), ("c", "a", 1), ("d", None, 50)):
        make_product(store, "average", key, made_from, days)
    run = here / "runs" / "mine-1234"
    run.mkdir(parents=True)
    manifest = {"name": "mine", "finished": datetime.now(UTC).isoformat(), "products": [{"key": key_of("b")}]}
    (run / "manifest.json").write_text(json.dumps(manifest))
    return store


def keys(store: Store) -> set[str]:
    return {path.name[0] for path in (store.root / "average").iterdir() if not path.name.startswith(".")}


def test_nothing_is_deleted_unasked_and_what_runs_were_made_from_is_kept(used_store, capsys):
    assert "4 products" in output_of(capsys, "store")
    assert "2 products" in output_of(capsys, "store", "--unreferenced")
    assert "2 products" in output_of(capsys, "store", "--older-than", "30d")
    assert keys(used_store) == {"a", "b", "c", "d"}
    told = output_of(capsys, "store", "--unreferenced", "--older-than", "30d", "--delete")
    assert re.findall(r"deleted: average \((\w)\)", told) == ["d"]
    assert keys(used_store) == {"a", "b", "c"}
    told = output_of(capsys, "store", "--unreferenced", "--delete")
    assert re.findall(r"deleted: average \((\w)\)", told) == ["c"]
    assert keys(used_store) == {"a", "b"}


def test_products_of_runs_behind_links_are_kept(used_store, here, capsys):
    (here / "disk").mkdir()
    (here / "runs" / "mine-1234").rename(here / "disk" / "mine-1234")
    (here / "runs" / "mine-1234").symlink_to(here / "disk" / "mine-1234")
    # A link that leads back up is followed once.
    (here / "disk" / "mine-1234" / "up").symlink_to(here / "runs")
    assert output_of(capsys, "runs").count("mine-1234") == 1
    output_of(capsys, "store", "--unreferenced", "--delete")
    assert keys(used_store) == {"a", "b"}


@pytest.mark.parametrize("text", ["{", "[]", '{"name": "mine", "products": [{}]}'])
def test_nothing_counts_as_unreferenced_where_a_run_cannot_be_read(used_store, here, capsys, text):
    (here / "runs" / "mine-1234" / "manifest.json").write_text(text)
    status, told = run_command(capsys, "store", "--unreferenced", "--delete")
    assert (status, told.count("\n")) == (REFUSED, 1)
    assert "mine-1234: its manifest.json cannot be read" in told
    assert keys(used_store) == {"a", "b", "c", "d"}


def test_exported_data_among_runs_are_no_run(used_store, here, capsys):
    (here / "runs" / "exported").mkdir()
    (here / "runs" / "exported" / "manifest.json").write_text('{"calstudy": "1", "digest": "", "data": []}')
    assert "2 products" in output_of(capsys, "store", "--unreferenced")


def test_what_a_run_needs_at_this_time_is_not_deleted(used_store, capsys):
    with Lease(used_store).holding([key_of("a")]):
        told = output_of(capsys, "store", "--older-than", "0h", "--delete")
    assert "kept, for a run needs it: average (a)" in told
    assert keys(used_store) == {"a"}


@pytest.mark.parametrize("place", ["average/notes", "my.folder/of.mine", f"average/{key_of('e')}", "mine/product.json"])
def test_what_is_no_product_is_never_deleted(used_store, capsys, place):
    precious = used_store.root / place / "precious.txt"
    precious.parent.mkdir(parents=True)
    precious.write_text("mine")
    assert "4 products" in output_of(capsys, "store", "--older-than", "0h", "--delete")
    assert precious.read_text() == "mine"
    # Runs, in place of a store.
    (used_store.root.parent / "runs" / "mine-1234" / "figures").mkdir()
    assert "0 products" in output_of(capsys, "store", "runs", "--older-than", "0h", "--delete")
    assert (used_store.root.parent / "runs" / "mine-1234" / "figures").is_dir()


def test_runs_are_listed(used_store, capsys):
    listed = output_of(capsys, "runs")
    assert "mine-1234" in listed
    assert str(datetime.now(UTC).year) in listed


def test_a_path_is_written_as_yaml_reads_it(here, capsys):
    import hera_qm

    data = Path(hera_qm.__file__).parent / "data" / "zen.2457698.40355.xx.HH.uvh5"
    (here / "a's #1.uvh5").symlink_to(data)
    output_of(capsys, "init", "mine", "--data", "a's #1.uvh5")
    assert parse_yaml((here / "mine.yaml").read_text(), "mine")["observed"]["data"] == "a's #1.uvh5"


def test_no_file_is_written_about_one_integration(here, capsys):
    """It has no halves, and no plan of the file would go through."""
    import hera_qm

    data = UVData.from_file(Path(hera_qm.__file__).parent / "data" / "zen.2457698.40355.xx.HH.uvh5")
    data.select(times=np.unique(data.time_array)[:1])
    data.write_uvh5("one.uvh5")
    with pytest.raises(
        InputError, match=r"has 1 integration, and a study needs two.*observed.odd.*observed.difference"
    ):
        output_of(capsys, "init", "mine", "--data", "one.uvh5")
    assert not (here / "mine.yaml").exists()


def test_a_file_about_measured_data_is_valid_and_proposes_what_is_quiet_and_alive(here, capsys, schema):
    package = "hera_qm:data/zen.2457698.40355.xx.HH.uvh5"
    told = output_of(capsys, "init", "mine", "--data", package)
    text = (here / "mine.yaml").read_text()
    assert "observed.beam = hera is a guess, which sets the level of power spectra" in told
    assert re.search(r"  beam: hera +# a guess", text)
    assert "a guess" not in output_of(capsys, "init", "named", "--data", package, "--beam", "hera")
    assert "a guess" not in (here / "named.yaml").read_text()
    content = parse_yaml(text, "mine")
    assert [error.message for error in schema.iter_errors(content)] == []
    # There is interference at 149.902 and 157.812 MHz, and antenna 81 saw no sky.
    assert content["observed"]["select"]["frequencies"] == "137.597 MHz..149.805 MHz"
    assert "81" not in content["observed"]["select"]["antennas"].split(",")
    for told in ("80 of 171 with a redundant partner", "do not stand out from others; all: 137.500 MHz..162.403 MHz"):
        assert told in text
    # The file has autocorrelations; weights of gains that are lost in noise would run away.
    assert content["calibration"]["weights"] == "autos"
    facts = load_study(here / "mine.yaml").graph.parts.facts["even"]
    assert (facts.frequencies.size, facts.antennas) == (126, 18)


def test_antennas_are_proposed_by_number_where_their_names_are_the_numbers_of_others(here, capsys):
    import hera_qm

    data = UVData.from_file(Path(hera_qm.__file__).parent / "data" / "zen.2457698.40355.xx.HH.uvh5")
    data.telescope.antenna_names = np.roll(data.telescope.antenna_numbers, 1).astype(str)
    data.write_uvh5("named.uvh5")
    output_of(capsys, "init", "mine", "--data", "named.uvh5")
    antennas = parse_yaml((here / "mine.yaml").read_text(), "mine")["observed"]["select"]["antennas"].split(",")
    assert all(text.startswith("number:") for text in antennas)
    numbers = load_study(here / "mine.yaml").graph.parts.facts["even"].frame.numbers
    assert [f"number:{number}" for number in numbers] == antennas


def test_all_channels_and_antennas_are_proposed_where_none_stands_out_or_data_are_large(here, capsys, monkeypatch):
    import hera_qm

    data = UVData.from_file(Path(hera_qm.__file__).parent / "data" / "zen.2457698.40355.xx.HH.uvh5")
    data.select(freq_chans=range(20, 60), antenna_nums=[9, 10, 20, 22])
    data.write_uvh5("quiet.uvh5")
    for reason in ("All channels: leave out edges", "All channels; data so large were not searched"):
        output_of(capsys, "init", "mine", "--data", "quiet.uvh5")
        text = (here / "mine.yaml").read_text()
        assert reason in text
        assert parse_yaml(text, "mine")["observed"]["select"] == {"frequencies": "139.453 MHz..143.262 MHz"}
        (here / "mine.yaml").unlink()
        monkeypatch.setattr("calstudy.cli.start.LARGE", 1.0)
