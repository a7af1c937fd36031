"""Hundreds of broken experiment files through the command line: sentences that name the field, never a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from broken import Broken, bad_beams, bad_layouts, bad_texts, implausible, missing_files, unknown_keys, wrong_values
from command_line import run_command, time_limit
from tiny import tiny

from calstudy.cli import main as cli

REFUSED = 2
LIMIT = 60
"""Seconds for one file: refusing takes a fraction of one, and a plan of a valid file a few."""
GENERATED = [wrong_values, unknown_keys]
HARMLESS = 40
"""Generated changes that are no mistakes, at most: the description may be anything."""
HAND_WRITTEN = [bad_texts, missing_files, bad_layouts, implausible, bad_beams]


def faulty(item: Broken, status: int, message: str) -> str:
    """Return what is wrong with an answer to a broken file, or nothing."""
    if status == 0:
        return ""
    if status != REFUSED:
        return f"{item.name}: exit status {status}"
    if any(not line.startswith("calstudy: ") or len(line) < 20 for line in message.strip().splitlines()):
        return f"{item.name}: not a sentence: {message!r}"
    if item.field and not any(name in message for name in item.field):
        return f"{item.name}: names none of {item.field}: {message!r}"
    return ""


def answers(makers, folder, capsys) -> list[tuple[Broken, int, str]]:
    """Return every broken file with the exit status of its plan and what is written."""
    found = []
    for item in (item for make in makers for item in make(folder)):
        Path("file.yaml").write_bytes(item.text)
        with time_limit(LIMIT):
            found.append((item, *run_command(capsys, "plan", "file.yaml")))
    return found


def faults(found: list[tuple[Broken, int, str]]) -> list[str]:
    return [fault for fault in (faulty(*answer) for answer in found) if fault]


def test_generated_changes_are_refused_with_sentences_that_name_the_field(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = answers(GENERATED, tmp_path, capsys)
    assert faults(found) == []
    refused = [item for item, status, _ in found if status == REFUSED]
    assert len(refused) >= 180
    assert len(found) - len(refused) <= HARMLESS
    assert not Path("pwned").exists()


@pytest.mark.parametrize("make", HAND_WRITTEN)
def test_none_of_the_hand_written_ones_is_taken_for_good(make, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = answers([make], tmp_path, capsys)
    assert faults(found) == []
    assert len(found) >= 7
    assert [item.name for item, status, _ in found if status != REFUSED] == []
    # Nothing in a file is ever run.
    assert not Path("pwned").exists()


@pytest.mark.parametrize(
    "option",
    [
        "sky.eor.seed",
        "=3",
        "sky.eor.seed=[",
        "sky.eor.seed=!!python/object/apply:os.system ['touch pwned']",
        "sky..seed=3",
        "nowhere.at.all=3",
        "name.x=3",
        "corruption.noise.factor=.nan",
        "outputs.store=~nobody-of-that-name/store",
    ],
)
def test_broken_overrides_are_refused_in_a_sentence(option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    status, message = run_command(capsys, "plan", "file.yaml", "--set", option)
    assert status == REFUSED
    assert message.startswith("calstudy: ")
    assert not Path("pwned").exists()


def test_object_tags_are_refused_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text("name: !!python/object/apply:os.system ['touch pwned']\n")
    status, message = run_command(capsys, "plan", "file.yaml")
    assert status == REFUSED
    assert "python/object/apply:os.system is refused" in message


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (
            "sweep={instrument.times.start: [2020-01-01, 2021-01-01]}",
            "2020-01-01 is a date in YAML; write it in quotes",
        ),
        ("description=2020-01-01 12:00:00", "2020-01-01 12:00:00 is a date in YAML; write it in quotes"),
        ("sweep={sky.eor.seed: [!!binary aGVsbG8=]}", "the tag tag:yaml.org,2002:binary is refused"),
        ("sweep={sky.eor.seed: [!!set {a}]}", "the tag tag:yaml.org,2002:set is refused"),
        ("corruption.effects.\u00b2.seed=4", "'\u00b2' is not an item of a list of 1, counted from 0"),
        ("corruption.effects.\u0660.seed=4", "'\u0660' is not an item of a list of 1, counted from 0"),
    ],
)
def test_what_yaml_or_python_take_for_something_else_is_named(option, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    status, message = run_command(capsys, "plan", "file.yaml", "--set", option)
    assert (status, message.count("\n")) == (REFUSED, 1)
    assert told in message


@pytest.mark.parametrize("file", ["nowhere.yaml", ".", "/dev/null/x.yaml"])
def test_an_experiment_that_cannot_be_read_is_named(file, capsys):
    status, message = run_command(capsys, "plan", file)
    assert status == REFUSED
    assert file in message


HUGE = [
    *("--set", "instrument.layout.side=26"),
    *("--set", "instrument.channels.count=60000"),
    *("--set", "instrument.channels.width=1 kHz"),
]
WEIGHTED = ("--set", "calibration.calibrator=delay-weighted")
NOISELESS = (
    *("--set", "corruption.noise=none"),
    *("--set", "variants={residual: {components: [foregrounds], effects: true, calibrate: true}}"),
)
COMMANDS = [
    (["plan", "file.yaml", "--workers", "99999"], "--workers 99999: at most"),
    (["plan", "file.yaml", "--workers", "0"], "greater than or equal to 1"),
    (["plan", "file.yaml", "--max-memory", "lots"], "--max-memory 'lots': write a positive number"),
    (["plan", "file.yaml", "--max-memory", "-3 GB"], "write a positive number"),
    # Refused before foreground bases of 60000 channels are made for two million baselines.
    (["plan", "file.yaml", *HUGE, "--max-memory", "6 GB"], "which take 3,652.3 GB, and there are 6.0 GB of memory"),
    (["plan", "file.yaml", "--max-memory", "1 MB"], "--max-memory leaves"),
    (["plan", "file.yaml", "--scale", "small"], "--scale small: not a scale"),
    (["plan", "file.yaml", "--set", "instrument.channels.width=80 mHz"], "must be at least 100 Hz"),
    (["plan", "file.yaml", "--set", "sky.eor.seed=010"], "010 is an octal number in YAML, 8"),
    (
        ["plan", "file.yaml", *WEIGHTED, "--set", "calibration.foreground_prior.deviation=10 %"],
        "foreground_prior.deviation: '10 %' is neither a number of at least 0, nor 'infinite', nor 'estimated'",
    ),
    (["plan", "file.yaml", *WEIGHTED, *NOISELESS], "corruption.noise: is 'none', and the finite deviations of"),
    (
        ["plan", "file.yaml", "--set", "calibration.foreground_prior.mean=sky-model"],
        "calibration.foreground_prior.mean: must be none beside an infinite deviation",
    ),
    (["plan", "file.yaml", "--set", "outputs.figures.77=wedge"], "not an item of a list of 8"),
    (["plan", "empty.yaml"], "empty.yaml: must hold a block of keys such as 'name: quickstart', and is empty"),
    (["plan", "list.yaml"], "and holds a list"),
    (["plan", "."], ".: is a folder"),
    (["plan", "quickstrat"], "neither a file nor a published experiment"),
    (["plan", "x" * 300], "cannot be read or written (File name too long)"),
    (["plan", "file.yaml", "--set", "scales={small: {instrument.banana: 3}}"], "scales.small: instrument.banana: unk"),
    (["plan"], "Missing argument"),
    (["plan", "file.yaml", "--banana"], "No such option: --banana"),
    (["run", "file.yaml", "--workers", "99999"], "--workers 99999: at most"),
    (["claims", "nowhere"], "nowhere"),
    (["claims", "."], "not the folder of a finished run"),
    (["report", "nowhere"], "nowhere"),
    (["regress", "nowhere"], "nowhere"),
    (["regress", "--against", "."], "give the one reference folder"),
    (["validate", "99.9"], "99.9: not a step of the ladder"),
    (["validate", "0.1", "--scale", "tiny"], "tiny"),
    (["validate", "--ladder", "nowhere"], "--ladder: not a step of the ladder"),
    (["fields", "nowhere.py"], "nowhere.py"),
    (["data", "fetch", "banana"], "nothing that can be fetched (allowed: gleam, beam, g4jy, haslam)"),
    (["calibrate"], "Missing argument"),
    (["calibrate", "nowhere.uvh5"], "'nowhere.uvh5': no such file or folder"),
    (["calibrate", "list.yaml"], "list.yaml: cannot be read as visibilities"),
    (["calibrate", "x", "--weights", "banana"], "--weights banana: neither gains, flags, nsamples or autos, nor"),
    (["calibrate", "x", "--select", "banana=3"], "--select banana=3: write one of"),
    (["calibrate", "x", "--select", "times=3"], "write a range such as times=0..9"),
    (["calibrate", "x", "--select", "times=a..b"], "not a whole number"),
    (["calibrate", "x", "--select", "lengths=3..5"], "has no unit"),
    (["calibrate", "x", "--select", "times=0..1", "--select", "times=0..2"], "--select times: given twice"),
    (["calibrate", "x", "--set", "basis.banana=3"], "calibration.basis.banana: unknown key"),
    (["calibrate", "x", "--set", "calibrator=banana"], "'banana' is not a calibrator"),
    (["calibrate", "x", "--buffer", "3"], "calibration.basis.buffer"),
    (["calibrate", "x", "--buffer", "-3 ns"], "calibration.basis.buffer"),
    (["calibrate", "x", "--set", "solver=banana"], "calibration.solver"),
    (["calibrate", "x", "--settings", "nowhere.yaml"], "nowhere.yaml: cannot be read"),
    (["calibrate", "x", "--settings", "list.yaml"], "list.yaml"),
    (["calibrate", "x", "--settings", "empty.yaml"], "calstudy: empty.yaml: must hold a block of keys such as 'cali"),
    (["calibrate", "x" * 300], "cannot be read (File name too long)"),
    (["calibrate", "file.yaml", "--gains", "x" * 300], "File name too long"),
    (["calibrate", "x", "--max-memory", "lots"], "write a positive number"),
    (["calibrate", "x", "--output", "list.yaml"], "list.yaml is a file; a folder is needed)"),
    (["banana"], "No such command 'banana'"),
]
"""Command lines that cannot be meant, and what the answer says."""


@pytest.mark.parametrize(("arguments", "told"), COMMANDS, ids=[" ".join(arguments) for arguments, _ in COMMANDS])
def test_a_command_that_cannot_be_meant_is_answered_in_a_sentence(arguments, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    Path("list.yaml").write_text("[a, b]\n")
    Path("empty.yaml").touch()
    status, message = run_command(capsys, *arguments)
    assert status == REFUSED
    assert "Traceback" not in message
    assert told in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.yaml", "file.yaml", "list.yaml"]


def test_more_memory_than_the_machine_has_is_noted_in_a_plan(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    assert planned(capsys, "--max-memory", "99999 TB").count("is more than this machine has") == 1
    assert "is more than" not in planned(capsys)


def refused(capsys, *options: str) -> str:
    """Return why ``calstudy plan file.yaml`` refuses."""
    status, message = run_command(capsys, "plan", "file.yaml", *options)
    assert status == REFUSED
    return " ".join(message.split())


def planned(capsys, *options: str) -> str:
    """Return what ``calstudy plan file.yaml`` writes to standard output."""
    cli.app(["plan", "file.yaml", *options], standalone_mode=False)
    return capsys.readouterr().out


def test_a_folder_that_is_a_file_is_named_as_it_was_given(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    status, message = run_command(capsys, "run", "file.yaml", "--output", "file.yaml")
    assert status == REFUSED
    assert message.startswith("calstudy: --output file.yaml: cannot be written (")
    assert message.endswith("file.yaml is a file; a folder is needed)\n")


def test_a_flux_limit_that_is_assumed_and_misses_nothing_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The 100 brightest sources are brighter than 10 Jy.
    assumed = {"sky.foregrounds.flux_limit": "2 Jy"}
    Path("file.yaml").write_text(yaml.safe_dump({**tiny(tmp_path), "calibration": {"assumed": assumed}}))
    planned(capsys, "--set", "calibration.assumed={sky.foregrounds.flux_limit: 20 Jy}")
    assert "flux_limit = '2.0 Jy': leaves out no source" in refused(capsys)
    # Where the sky model is wrong otherwise, it is noted.
    errors = "sky.foregrounds.errors.flux_scale: 1.1"
    told = planned(capsys, "--set", f"calibration.assumed={{sky.foregrounds.flux_limit: 2 Jy, {errors}}}")
    assert "leaves out no source: all 100 are brighter" in " ".join(told.split())


def test_a_flux_limit_that_misses_nothing_of_a_catalogue_is_refused_in_a_plan(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sky.csv").write_text("ra,dec,s\n30,-27,9\n31,-26,5\n29,-28,3\n")
    csv = {"right_ascension": "ra", "declination": "dec", "flux": "s", "frequency": "180 MHz"}
    sky = {"foregrounds": {"kind": "file", "path": "sky.csv", "csv": csv}, "eor": tiny(tmp_path)["sky"]["eor"]}
    assumed = {"sky.foregrounds.flux_limit": "4 Jy"}
    Path("file.yaml").write_text(yaml.safe_dump({**tiny(tmp_path), "sky": sky, "calibration": {"assumed": assumed}}))
    planned(capsys)
    told = refused(capsys, "--set", "calibration.assumed={sky.foregrounds.flux_limit: 2 Jy}")
    assert "leaves out no source: all 3 are brighter" in told
    told = refused(capsys, "--set", "calibration.assumed={sky.foregrounds.flux_limit: 20 Jy}")
    assert "calibration.assumed.sky.foregrounds.flux_limit: no source of the catalogue is as bright as 20 Jy" in told
    # A catalogue that was changed is read again.
    Path("sky.csv").write_text("ra,dec,s\n30,-27,9\n31,-26,5\n29,-28,3\n29,-29,1\n")
    planned(capsys, "--set", "calibration.assumed={sky.foregrounds.flux_limit: 2 Jy}")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("power.coherent_time=1 s", "is shorter than an integration of"),
        ("simulation.chunks=50", "simulation.chunks = 50: the EoR is simulated in"),
        ("calibration.chunks=50", "calibration.chunks = 50: there are"),
        (
            "calibration.assumed={sky.foregrounds.count: 150}",
            "calibration.assumed.sky.foregrounds.count = 150: the sky has 100 sources, and the sky model of the",
        ),
        (
            "calibration.assumed={sky.foregrounds.count: null}",
            "calibration.assumed.sky.foregrounds.count = null: the sky has 100 sources, and the sky model of the",
        ),
    ],
)
def test_settings_that_cannot_be_met_are_noted_in_a_plan(change, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    assert told not in " ".join(planned(capsys).split())
    assert told in " ".join(planned(capsys, "--set", change, "--set", "instrument.times.integration=10 s").split())


def test_a_model_for_each_group_of_an_array_without_groups_is_noted_in_a_plan(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(
        yaml.safe_dump({**tiny(tmp_path), "calibration": {"calibrator": "calamity-redundant"}})
    )
    told = "calibration.calibrator = 'calamity-redundant': no two baselines are within"
    assert told not in " ".join(planned(capsys).split())
    at = ("--set", "instrument.layout={kind: csv, path: some.csv}", "--set", "instrument.location=mwa")
    for positions, alone in (
        ("0,0,0\n14,3,0\n-6,19,0\n31,-8,0\n", True),
        # Two baselines that differ by nanometres, on edges of cells in one coordinate and in another.
        ("0,0,0\n14.5,0,1e-9\n29.000000001,0,-1e-9\n", False),
    ):
        Path("some.csv").write_text(f"east_m,north_m,up_m\n{positions}")
        assert (told in " ".join(planned(capsys, *at).split())) is alone


def test_a_run_shows_the_notes_of_its_plan(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    for name in ("study.run_study", "show.show_run"):
        monkeypatch.setattr(f"calstudy.studies.{name}", lambda *_: None)
    cli.app(["run", "file.yaml", "--set", "simulation.chunks=50"], standalone_mode=False)
    assert "note: simulation.chunks = 50" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("instrument.as_built.positions.scatter=50 m", "must be at most half of the shortest baseline"),
        ("corruption.effects=[{kind: reflection-gains, delay: 1 s}]", "corruption.effects.0.delay: 1 s must be"),
        ("outputs={store: x, runs: ./x}", "outputs.runs: 'x' is also outputs.store"),
    ],
)
def test_settings_that_can_only_be_mistakes_are_refused(change, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    assert told in refused(capsys, "--set", change)


def test_a_world_that_changes_nothing_is_refused_and_notes_of_cases_are_shown(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    world = {"calibration.assumed.sky.foregrounds.flux_limit": "2 Jy"}
    base = {key: value for key, value in tiny(tmp_path).items() if key not in ("calibration", "outputs", "variants")}
    data = {"name": "x", "experiment": base, "calibrators": {"mine": "sky-based"}, "worlds": {"ideal": {}, "a": world}}
    Path("file.yaml").write_text(yaml.safe_dump(data))
    assert "mine in a: calibration.assumed.sky.foregrounds.flux_limit" in refused(capsys)
    limits = "worlds={ideal: {}, a: {calibration.assumed.sky.foregrounds.flux_limit: 20 Jy}}"
    told = planned(capsys, "--set", limits, "--set", "simulation.chunks=50")
    assert told.count("simulation.chunks = 50") == 1


@pytest.mark.parametrize(
    ("integration", "more", "noted"),
    [("10 s", [], False), ("10 min", [], True), ("10 min", ["--set", "power.coherent_time=10 min"], False)],
)
def test_a_long_coherent_average_is_noted_in_a_plan(integration, more, noted, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    options = ["--set", f"instrument.times.integration={integration}", *more]
    assert ("are averaged coherently" in " ".join(planned(capsys, *options).split())) is noted
