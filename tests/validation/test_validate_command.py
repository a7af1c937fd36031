"""``calstudy validate``: exit status, table, and what is kept of failures, with steps of one's own."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from ladders import load_ladder

from calstudy.cli.main import main as cli

OWN = """
from calstudy.base.errors import InputError
from calstudy.validation.step import Findings, Limit, Step
from calstudy.verdicts.criterion import AtMost, Finding

class Pretended(Step):
    number = "{number}"
    proves = "y"
    limits = {{"number": Limit("a number", AtMost(1), "because")}}

    def measure(self, runs, output):
        {body}
        return Findings({{"number": Finding({value}, 0.1)}}, ("a remark",))
"""


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def step(number: str, value: float, body: str = "pass") -> str:
    path = Path(f"step{number}.py")
    path.write_text(OWN.format(number=number, value=value, body=body))
    return str(path)


def validate(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["calstudy", "validate", *arguments])
    with pytest.raises(SystemExit) as end:
        cli()
    written = capsys.readouterr()
    return end.value.code or 0, written.out, written.err


def test_passing_is_0_failing_is_1_and_failures_are_kept(monkeypatch, capsys):
    first = step("-1", 0.5)
    assert validate(monkeypatch, capsys, first)[0] == 0
    status, out, _ = validate(monkeypatch, capsys, first, step("0.0", 1.5))
    assert status == 1
    assert "1 of 2 steps pass" in out
    (failed,) = [folder for folder in Path("runs").iterdir() if "FAIL" in (folder / "claims.md").read_text()]
    assert validate(monkeypatch, capsys, first, step("0.0", 0.7))[0] == 0
    # The step is another one now: its run has a folder of its own.
    *_, verdict = json.loads((failed / "claims.json").read_text())
    assert (verdict["quantity"], verdict["measured"], verdict["verdict"]) == ("a number", 1.5, "FAIL")
    assert "- 0.0: a remark" in (failed / "claims.md").read_text()
    assert (failed / "report.html").exists()


def test_a_step_that_cannot_be_measured_fails_alone(monkeypatch, capsys):
    broken = {
        'raise InputError("this measurement cannot be made")': "this measurement cannot be made",
        "[][0]": "step2.0.py line 12, in measure: IndexError: list index out of range",
        'return {"number": 1.0}': "its measure returned a dict, expected Findings",
    }
    files = [step("0.0", 0.5), *(step(f"{number}.0", 0.5, body) for number, body in enumerate(broken, 1))]
    status, out, _ = validate(monkeypatch, capsys, *files)
    assert status == 1
    folder = Path(re.search(r"results: (.+)", out)[1])
    verdicts = {item["name"].partition(" ")[0]: item for item in json.loads((folder / "claims.json").read_text())}
    assert {name for name, verdict in verdicts.items() if verdict["verdict"] == "PASS"} == {"0.0"}
    for number, reason in enumerate(broken.values(), 1):
        assert reason in verdicts[f"{number}.0"]["reason"]


def test_the_step_of_the_page_can_be_measured():
    page = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text()
    name, text = re.search(r"```python\n# (\S+)\n(.*?)```", page, re.DOTALL).groups()
    Path(name).write_text(text)
    ladder = load_ladder([name], "small")
    assert list(ladder.measurements) == ["0.3"]
    (criterion,) = ladder.steps[0][0].criteria.values()
    assert str(criterion.threshold) == "0.5 within 3 sigma"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["9.9"], "9.9: not a step of the ladder (there are: -1, 0.0"),
        (["--scale", "tiny"], "--scale tiny: not a scale of the ladder"),
        (["nowhere.py"], "nowhere.py"),
        (["--banana"], "--banana: not a step"),
    ],
)
def test_mistakes_are_a_sentence(arguments, sentence, monkeypatch, capsys):
    status, _, err = validate(monkeypatch, capsys, *arguments)
    assert status == 2
    assert sentence in err
