"""The validation ladder at small scale: steps on shared products, and what they leave behind.

All steps take minutes: ``pytest -m slow tests/validation``. Without ``-m slow``, the quickest are measured.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console

from calstudy.validation.ladder import LadderRun, run_ladder
from calstudy.validation.outcomes import JSON, MARKDOWN
from calstudy.validation.steps import load_ladder

STEPS = ["-1", "0.0", "0.1", "0.2", "1.0", "2.0", "2.1", "2.2", "2.3", "3.0", "4.0", "4.1"]
KNOWN_FAILURES = {("2.1", "fitted")}
"""What fails, and why: docs/validation.md."""
NOT_AT_THIS_SCALE = {"4.0", "4.1"}
"""Sixteen antennas lose up to a third of the signal to gains and flux scale; the full scale decides."""
QUICK = ["0.0", "0.1", "2.1"]
"""Noise, a flat EoR, and calibrations: seconds each. The last is the one that fails."""


@dataclass(frozen=True)
class Measured:
    """Steps that were run, and their names."""

    run: LadderRun
    names: list[str]


@pytest.fixture(scope="module", params=["quick", pytest.param("all", marks=pytest.mark.slow)])
def ladder(request, tmp_path_factory) -> Measured:
    folder = tmp_path_factory.mktemp("ladder")
    names = QUICK if request.param == "quick" else STEPS
    steps = load_ladder(names, "small", [f"outputs.store={folder / 'store'}"])
    run = run_ladder(steps, folder / "store", folder / "validation", 1, Console(file=io.StringIO()))
    return Measured(run, names)


def test_every_step_is_measured_and_none_fails_that_is_not_known_to(ladder):
    assert [outcome.step.name for outcome in ladder.run.outcomes] == ladder.names
    failures = set()
    for outcome in ladder.run.outcomes:
        for verdict, finding in zip(outcome.verdicts, outcome.step.criteria, strict=True):
            assert verdict.measured is not None, (verdict.name, verdict.reason)
            if verdict.verdict == "FAIL" and outcome.step.name not in NOT_AT_THIS_SCALE:
                failures.add((outcome.step.name, finding))
    assert failures == {failure for failure in KNOWN_FAILURES if failure[0] in ladder.names}


def test_the_tables_tell_value_threshold_and_reason(ladder):
    written = json.loads((ladder.run.folder / JSON).read_text())
    assert [step["step"] for step in written["steps"]] == ladder.names
    for step in written["steps"]:
        for row in step["criteria"]:
            assert row["verdict"] in ("PASS", "FAIL")
            assert row["threshold"]
            assert row["why"]
            assert row["quantity"]
    table = (ladder.run.folder / MARKDOWN).read_text()
    assert all(f"| {name} " in table for name in ladder.names)


def test_failed_results_are_kept_with_their_manifest(ladder):
    failed = {outcome.step.name for outcome in ladder.run.outcomes if not outcome.passed}
    assert failed
    kept = {folder.name.rpartition("-")[0]: folder for folder in (ladder.run.folder / "failed").iterdir()}
    assert kept.keys() == failed
    for folder in kept.values():
        manifest = json.loads((folder / "manifest.json").read_text())
        assert not manifest["passed"]
        assert manifest["products"][-1]["stage"] == "validate"
        assert manifest["git_commit"] is None or manifest["git_commit"]
        assert (folder / "measurement.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("ladder", ["all"], indirect=True)
def test_the_basin_has_a_figure_and_a_table(ladder):
    assert {path.name for path in (ladder.run.folder / "2.2").iterdir()} >= {"basin.png", "basin.pdf", "basin.csv"}


def test_a_second_run_measures_nothing_and_finds_the_same(ladder):
    steps = [outcome.step for outcome in ladder.run.outcomes]
    text, folder = io.StringIO(), ladder.run.folder
    again = run_ladder(steps, folder.parent / "store", folder, 1, Console(file=text))
    assert "validate" not in text.getvalue()
    assert again.outcomes == ladder.run.outcomes


def test_the_table_of_results_has_the_criteria_of_today():
    lines = (Path(__file__).parents[2] / "experiments" / "validation" / "README.md").read_text().splitlines()
    steps = load_ladder()
    for step in steps:
        rows = [line for line in lines if line.startswith(f"| {step.name} |")]
        written = [row.split(" | ")[-3] for row in rows]
        assert written == [str(item.threshold) for item in step.criteria.values()], step.name
    count = sum(len(step.criteria) for step in steps)
    passed = sum(line.endswith("| PASS |") for line in lines)
    assert f"{len(steps)} steps pass, {passed} of {count} criteria" in "\n".join(lines)
