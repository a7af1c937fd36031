"""``calstudy validate``: exit status, table, and what is kept of failures, with a rung that costs nothing."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import pytest
import yaml

from calstudy import cli
from calstudy.claims.statement import Finding
from calstudy.errors import InputError
from calstudy.validation import rungs
from calstudy.validation.evidence import Evidence, Measurement


def measure(evidence: Evidence) -> Measurement:
    value = evidence.parameters["value"]
    if value == "broken":
        raise InputError("this rung cannot measure")
    return Measurement({"number": Finding(value, 0.1)}, ("a remark",))


@pytest.fixture
def ladder(tmp_path, monkeypatch) -> Path:
    module = types.ModuleType("calstudy.validation.pretended")
    module.measure = measure
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(rungs, "RUNGS", {**rungs.RUNGS, "pretended": rungs.Rung("pretended", rungs._nothing)})
    monkeypatch.setattr("calstudy.graph.validation.RUNGS", rungs.RUNGS)
    monkeypatch.setattr("calstudy.stages.validation.RUNGS", rungs.RUNGS)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "ladder"
    folder.mkdir()
    return folder


def step(folder: Path, name: str, value: object) -> None:
    criterion = {"measures": "number", "quantity": "a number", "must": {"at_most": 1}, "why": "because"}
    content = {"step": name, "title": "x", "proves": "y", "rung": "pretended", "parameters": {"value": value}}
    (folder / f"{name}.yaml").write_text(yaml.safe_dump({**content, "criteria": [criterion]}))


def validate(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["calstudy", "validate", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    written = capsys.readouterr()
    return end.value.code or 0, written.out, written.err


def test_passing_is_0_failing_is_1_and_failures_are_kept(ladder, monkeypatch, capsys):
    step(ladder, "-1", 0.5)
    assert validate(monkeypatch, capsys, "-1", "--ladder", str(ladder))[0] == 0
    step(ladder, "0.0", 1.5)
    status, out, _ = validate(monkeypatch, capsys, "--ladder", str(ladder))
    assert status == 1
    assert "1 of 2 steps pass" in out
    assert [path.name.partition("-")[0] for path in Path("validation/failed").iterdir()] == ["0.0"]
    step(ladder, "0.0", 0.7)
    assert validate(monkeypatch, capsys, "--ladder", str(ladder))[0] == 0
    (kept,) = Path("validation/failed").iterdir()
    manifest = json.loads((kept / "manifest.json").read_text())
    assert manifest["criteria"] == [{"quantity": "a number", "measured": 1.5, "verdict": "FAIL", "reason": ""}]
    assert "a remark" in Path("validation/validation.md").read_text()


def test_a_step_that_cannot_be_measured_fails_alone(ladder, monkeypatch, capsys):
    step(ladder, "0.0", 0.5)
    step(ladder, "1.0", "broken")
    status, _, _ = validate(monkeypatch, capsys, "--ladder", str(ladder))
    assert status == 1
    steps = {item["step"]: item for item in json.loads(Path("validation/validation.json").read_text())["steps"]}
    assert steps["0.0"]["passed"] and not steps["1.0"]["passed"]
    assert "this rung cannot measure" in steps["1.0"]["criteria"][0]["reason"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["9.9"], "9.9: not a step of the ladder (there are: -1, 0.0"),
        (["--scale", "tiny"], "--scale tiny: not a scale of the ladder"),
        (["--ladder", "nowhere"], "nowhere: holds no steps"),
        (["--banana"], "--banana: not a step"),
    ],
)
def test_mistakes_are_a_sentence(arguments, sentence, monkeypatch, capsys):
    status, _, err = validate(monkeypatch, capsys, *arguments)
    assert status == 2
    assert sentence in err
