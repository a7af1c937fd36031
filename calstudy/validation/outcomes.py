"""The outcomes of the steps of the validation ladder, and the tables that contain them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.validation.steps import Step
from calstudy.verdicts.criterion import Finding, Verdict
from calstudy.verdicts.tables import as_json, show_verdicts, to_markdown

JSON, MARKDOWN = "validation.json", "validation.md"


@dataclass(frozen=True)
class Outcome:
    """One step, the verdicts on its criteria, and the remarks of its measurement."""

    step: Step
    verdicts: tuple[Verdict, ...]
    remarks: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every criterion holds."""
        return all(verdict.verdict == "PASS" for verdict in self.verdicts)


def judge(step: Step, measurement: Mapping[str, Any]) -> Outcome:
    """Compare the content of measurement.json with the criteria; a number that is missing or not finite fails."""
    verdicts = []
    for name, criterion in step.criteria.items():
        found = measurement["findings"].get(name)
        if found is None:
            verdicts.append(_fail(criterion.unevaluated("not measured")))
        elif None in found.values():
            verdicts.append(_fail(criterion.unevaluated("not a finite number")))
        else:
            verdicts.append(criterion.judge(Finding(found["value"], found["uncertainty"])))
    return Outcome(step, tuple(verdicts), tuple(measurement["remarks"]))


def failed(step: Step, reason: str) -> Outcome:
    """Return the outcome of a step that could not be measured."""
    return Outcome(step, tuple(_fail(criterion.unevaluated(reason)) for criterion in step.criteria.values()))


def _fail(verdict: Verdict) -> Verdict:
    """Return a verdict as a failure: a step without a number does not pass."""
    return replace(verdict, verdict="FAIL")


def tally(outcomes: Sequence[Outcome]) -> str:
    """Count steps and criteria in one line."""
    verdicts = _verdicts(outcomes)
    return (
        f"{sum(outcome.passed for outcome in outcomes)} of {len(outcomes)} steps pass, "
        f"{sum(verdict.verdict == 'PASS' for verdict in verdicts)} of {len(verdicts)} criteria"
    )


def _verdicts(outcomes: Sequence[Outcome]) -> list[Verdict]:
    return [verdict for outcome in outcomes for verdict in outcome.verdicts]


def _title(scale: str) -> str:
    return f"Validation ladder, {scale} scale"


def show(outcomes: Sequence[Outcome], scale: str, console: Console) -> None:
    """Print the outcomes as a table."""
    show_verdicts(_verdicts(outcomes), _title(scale), console, "step", tally(outcomes))


def write_tables(outcomes: Sequence[Outcome], scale: str, folder: Path, notes: Sequence[str] = ()) -> None:
    """Write validation.json and validation.md into an existing folder.

    `outcomes` are in the order of the steps, and `notes` name the substitutes for the paper's inputs.
    """
    steps = [
        {
            "step": outcome.step.name,
            "title": outcome.step.title,
            "proves": outcome.step.proves,
            "passed": outcome.passed,
            "remarks": list(outcome.remarks),
            "criteria": as_json(outcome.verdicts),
        }
        for outcome in outcomes
    ]
    content = json.dumps({"scale": scale, "steps": steps}, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / JSON).write_text(content + "\n", encoding="utf-8")
    text = to_markdown(_verdicts(outcomes), _title(scale), ("step", "proves"), tally(outcomes), notes)
    remarks = [f"- {outcome.step.name}: {remark}\n" for outcome in outcomes for remark in outcome.remarks]
    (folder / MARKDOWN).write_text("".join([text, "\n", *remarks]), encoding="utf-8")
