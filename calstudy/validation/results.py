"""The outcome of the ladder: verdicts, and the tables that hold them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calstudy.claims.statement import Finding
from calstudy.validation.steps import Step

Verdict = Literal["PASS", "FAIL"]
COLOURS: Mapping[str, str] = {"PASS": "green", "FAIL": "bold red"}
JSON, MARKDOWN = "validation.json", "validation.md"


@dataclass(frozen=True)
class Row:
    """One criterion of one step, evaluated.

    Attributes
    ----------
    step, title, proves
        Of the step.
    quantity
        What was measured, in words.
    measured, uncertainty
        The number and its standard deviation; None if there is no finite one.
    threshold, why
        What it must be, and why that.
    verdict
        Whether it is.
    reason
        Why there is no number, or empty.
    """

    step: str
    title: str
    proves: str
    quantity: str
    measured: float | None
    uncertainty: float | None
    threshold: str
    why: str
    verdict: Verdict
    reason: str = ""

    @property
    def text(self) -> str:
        """The measured number with its uncertainty, or why there is none."""
        if self.measured is None:
            return self.reason
        if not self.uncertainty:
            return f"{self.measured:.3g}"
        # As many digits as the uncertainty leaves meaning to.
        places = max(0, 1 - math.floor(math.log10(self.uncertainty)))
        return f"{self.measured:.{places}f} ± {self.uncertainty:.2g}"


@dataclass(frozen=True)
class Outcome:
    """One step, evaluated; `remarks` are what its rung says besides numbers."""

    step: Step
    rows: tuple[Row, ...]
    remarks: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every criterion holds."""
        return all(row.verdict == "PASS" for row in self.rows)


def judge(step: Step, measurement: Mapping[str, Any]) -> Outcome:
    """Hold what was measured against the criteria of a step.

    Parameters
    ----------
    measurement
        Content of the `validate` product's measurement.json. A number that is missing or not finite fails.
    """
    rows = []
    for criterion in step.criteria:
        condition = criterion.condition(step.scale)
        found = measurement["findings"].get(criterion.measures)
        finding = None if found is None else _finding(found)
        reason = "" if finding else ("not measured" if found is None else "not a finite number")
        rows.append(
            Row(
                step=step.name,
                title=step.title,
                proves=step.proves,
                quantity=criterion.quantity,
                measured=finding.value if finding else None,
                uncertainty=finding.uncertainty if finding else None,
                threshold=str(condition),
                why=criterion.why,
                verdict="PASS" if finding is not None and condition.holds(finding) else "FAIL",
                reason=reason,
            )
        )
    return Outcome(step, tuple(rows), tuple(measurement["remarks"]))


def _finding(found: Mapping[str, float | None]) -> Finding | None:
    value, uncertainty = found["value"], found["uncertainty"]
    return None if value is None or uncertainty is None else Finding(value, uncertainty)


def failed(step: Step, reason: str) -> Outcome:
    """Return the outcome of a step that could not be measured."""
    rows = tuple(
        Row(
            step=step.name,
            title=step.title,
            proves=step.proves,
            quantity=item.quantity,
            measured=None,
            uncertainty=None,
            threshold=str(item.condition(step.scale)),
            why=item.why,
            verdict="FAIL",
            reason=reason,
        )
        for item in step.criteria
    )
    return Outcome(step, rows)


def tally(outcomes: Sequence[Outcome]) -> str:
    """Count steps and criteria in one line."""
    rows = [row for outcome in outcomes for row in outcome.rows]
    return (
        f"{sum(outcome.passed for outcome in outcomes)} of {len(outcomes)} steps pass, "
        f"{sum(row.verdict == 'PASS' for row in rows)} of {len(rows)} criteria"
    )


def to_json(outcomes: Sequence[Outcome], scale: str) -> str:
    """Return the outcomes as JSON."""
    steps = [
        {"step": outcome.step.name, "passed": outcome.passed, "remarks": list(outcome.remarks)}
        | {"criteria": [asdict(row) for row in outcome.rows]}
        for outcome in outcomes
    ]
    return json.dumps({"scale": scale, "steps": steps}, indent=1, ensure_ascii=False, allow_nan=False)


def to_markdown(outcomes: Sequence[Outcome], scale: str, notes: Sequence[str] = ()) -> str:
    """Return the outcomes as a Markdown document: the table, then what the rungs remark, then the stand-ins."""
    lines = [
        f"# Validation ladder, {scale} scale",
        "",
        tally(outcomes),
        "",
        "| step | proves | measured | | must be | why | |",
        "|---|---|---|--:|---|---|---|",
    ]
    for outcome in outcomes:
        for row in outcome.rows:
            cells = (row.step, row.proves, row.quantity, f"**{row.text}**", row.threshold, row.why, row.verdict)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    remarks = [f"- {outcome.step.name}: {remark}" for outcome in outcomes for remark in outcome.remarks]
    lines += (["", *remarks] if remarks else []) + [""]
    lines += [f"Stand-in: {note}." for note in notes] + ([""] if notes else [])
    return "\n".join(lines)


def show(outcomes: Sequence[Outcome], scale: str, console: Console) -> None:
    """Print the outcomes as a table."""
    table = Table(title=f"validation ladder, {scale} scale: {tally(outcomes)}", title_justify="left", expand=True)
    table.add_column("step", no_wrap=True)
    for heading, ratio in (("measured", 6), ("", 3), ("must be", 3)):
        table.add_column(heading, ratio=ratio)
    table.add_column("", no_wrap=True)
    for outcome in outcomes:
        for row in outcome.rows:
            colour = COLOURS[row.verdict]
            verdict = f"[{colour}]{row.verdict}[/{colour}]"
            table.add_row(row.step, escape(row.quantity), escape(row.text), escape(row.threshold), verdict)
    console.print(table)


def write_tables(outcomes: Sequence[Outcome], scale: str, folder: Path, notes: Sequence[str] = ()) -> None:
    """Write validation.json and validation.md into a folder."""
    (folder / JSON).write_text(to_json(outcomes, scale) + "\n", encoding="utf-8")
    (folder / MARKDOWN).write_text(to_markdown(outcomes, scale, notes), encoding="utf-8")
