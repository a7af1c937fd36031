"""The validation ladder at small scale: steps on shared products, and what they leave behind.

All steps take minutes: ``pytest -m slow tests/validation``. Without ``-m slow``, the quickest are measured.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from ladders import load_ladder
from rich.console import Console

from calstudy.run.execution import Budget
from calstudy.validation.ladder import Ladder, run_ladder
from calstudy.verdicts.criterion import Verdict

pytestmark = pytest.mark.chain

STEPS = ["-1", "0.0", "0.1", "0.2", "1.0", "2.0", "2.1", "2.2", "2.3", "2.4", "3.0", "4.0", "4.1"]
KNOWN_FAILURES = {"2.1 fitted"}
"""What fails, and why: experiments/validation/README.md."""
NOT_AT_THIS_SCALE = {"4.0", "4.1"}
"""Sixteen antennas lose up to a third of the signal to gains and flux scale; the full scale decides."""
QUICK = ["0.0", "0.1", "2.1"]
"""Noise, a flat EoR, and calibrations: seconds each. The last is the one that fails."""


@dataclass(frozen=True)
class Measured:
    """Steps that were run, their names, and what was found."""

    ladder: Ladder
    names: list[str]
    folder: Path
    verdicts: list[Verdict]


def test_the_small_scale_calibrates_as_the_full_one():
    """Its experiments are of a file of its own, whose defaults differ from the published files': weights, for one."""
    full, small = (
        {(step.number, name): item.calibration for step, found in ladder.steps for name, item in found.items()}
        for ladder in (load_ladder(STEPS, scale, []) for scale in ("full", "small"))
    )
    assert full.keys() == small.keys()
    for place, calibration in full.items():
        assert calibration.with_defaults("chunks") == small[place].with_defaults("chunks"), place


@pytest.fixture(scope="module", params=["quick", pytest.param("all", marks=pytest.mark.slow)])
def measured(request, tmp_path_factory) -> Measured:
    folder = tmp_path_factory.mktemp("ladder")
    names = QUICK if request.param == "quick" else STEPS
    ladder = load_ladder(names, "small", [f"outputs.store={folder / 'store'}", f"outputs.runs={folder / 'runs'}"])
    return Measured(ladder, names, *run_ladder(ladder, Budget(1), Console(file=io.StringIO())))


def test_every_step_is_measured_and_none_fails_that_is_not_known_to(measured):
    steps = [verdict.name.partition(" ")[0] for verdict in measured.verdicts]
    assert list(dict.fromkeys(steps)) == measured.names
    failures = set()
    for step, verdict in zip(steps, measured.verdicts, strict=True):
        assert verdict.measured is not None, (verdict.name, verdict.reason)
        if verdict.verdict == "FAIL" and step not in NOT_AT_THIS_SCALE:
            failures.add(verdict.name)
    assert failures == {failure for failure in KNOWN_FAILURES if failure.partition(" ")[0] in measured.names}


def test_the_tables_tell_value_threshold_and_reason(measured):
    for row in json.loads((measured.folder / "claims.json").read_text()):
        assert row["verdict"] in ("PASS", "FAIL")
        assert row["threshold"]
        assert row["why"]
        assert row["quantity"]
    table = (measured.folder / "claims.md").read_text()
    assert all(f"| {name} " in table for name in measured.names)
    assert all(f"\n- {name}: " in table for name in measured.names)


def test_the_folder_has_the_numbers_of_each_step_and_the_products_behind_them(measured):
    manifest = json.loads((measured.folder / "manifest.json").read_text())
    assert list(manifest["steps"]) == measured.names
    assert sum(item["stage"] == "validate" for item in manifest["products"]) == len(measured.names)
    for name in measured.names:
        assert (measured.folder / "tables" / name / "measurement.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("measured", ["all"], indirect=True)
def test_the_basin_has_a_figure_and_a_table(measured):
    names = {path.name for path in (measured.folder / "tables" / "2.2").iterdir()}
    assert names >= {"basin.png", "basin.pdf", "basin.csv"}


def test_a_second_run_measures_nothing_and_finds_the_same(measured):
    text = io.StringIO()
    folder, verdicts = run_ladder(measured.ladder, Budget(1), Console(file=text))
    assert "validate" not in text.getvalue()
    assert (folder, verdicts) == (measured.folder, measured.verdicts)


def test_the_table_of_results_has_the_limits_of_today():
    lines = (Path(__file__).parents[2] / "experiments" / "validation" / "README.md").read_text().splitlines()
    steps = [step for step, _ in load_ladder().steps]
    for step in steps:
        rows = [line for line in lines if line.startswith(f"| {step.number} |")]
        written = [row.split(" | ")[-3] for row in rows]
        assert written == [str(criterion.threshold) for criterion in step.criteria.values()], step.number
    count = sum(len(step.limits) for step in steps)
    passed = sum(line.endswith("| PASS |") for line in lines)
    assert f"{len(steps)} steps pass, {passed} of {count} criteria" in "\n".join(lines)
