"""``calstudy validate``: exit status, table, and what is kept of failures, with a measurement of one's own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import yaml

from calstudy.cli.main import main as cli

OWN = """
from calstudy.base.errors import InputError
from calstudy.validation.measurement import Findings, Measurement
from calstudy.verdicts.criterion import Finding

class Pretended(Measurement):
    value: float
    broken: str = ""

    def measure(self, inputs):
        if self.broken == "refused":
            raise InputError("this measurement cannot be made")
        if self.broken == "error":
            return [][0]
        if self.broken == "wrong":
            return {"number": 1.0}
        return Findings({"number": Finding(self.value, 0.1)}, ("a remark",))
"""


@pytest.fixture
def ladder(tmp_path, monkeypatch) -> Path:
    """A folder of steps beside a measurement of one's own."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "ladder"
    folder.mkdir()
    (folder / "pretended.py").write_text(OWN)
    return folder


def step(folder: Path, name: str, value: float, broken: str = "") -> None:
    criterion = {"measures": "number", "quantity": "a number", "must": {"at_most": 1}, "why": "because"}
    content = {"step": name, "title": "x", "proves": "y", "measurement": "pretended.py"}
    content["parameters"] = {"value": value, "broken": broken}
    (folder / f"{name}.yaml").write_text(yaml.safe_dump({**content, "criteria": [criterion]}))


def validate(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["calstudy", "validate", *arguments])
    with pytest.raises(SystemExit) as end:
        cli()
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
    broken = {
        "refused": "this measurement cannot be made",
        "error": "pretended.py line 14, in measure: IndexError: list index out of range",
        "wrong": "pretended: its measure returned a dict, expected Findings",
    }
    for number, name in enumerate(broken, 1):
        step(ladder, f"{number}.0", 0.5, name)
    status, _, _ = validate(monkeypatch, capsys, "--ladder", str(ladder))
    assert status == 1
    steps = {item["step"]: item for item in json.loads(Path("validation/validation.json").read_text())["steps"]}
    assert {name for name, found in steps.items() if found["passed"]} == {"0.0"}
    for number, reason in enumerate(broken.values(), 1):
        assert reason in steps[f"{number}.0"]["criteria"][0]["reason"]


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
