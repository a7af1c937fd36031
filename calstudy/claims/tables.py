"""Evaluated claims as JSON for programs, Markdown for documents, and a table for the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calstudy.claims.statement import Claim

COLOURS = {"PASS": "green", "FAIL": "bold red", "not evaluated": "dim"}
CLAIMS_JSON, CLAIMS_MARKDOWN = "claims.json", "claims.md"


def number(value: float | None) -> str:
    """Write a number with three digits."""
    return "" if value is None else f"{value:.3g}"


def measured(claim: Claim) -> str:
    """Write the measured number and its uncertainty, or why there is none."""
    if claim.measured is None:
        return claim.reason
    return f"{number(claim.measured)} ± {number(claim.uncertainty)}" if claim.uncertainty else number(claim.measured)


def tally(claims: Sequence[Claim]) -> str:
    """Count the verdicts in one line."""
    verdicts = [claim.verdict for claim in claims]
    return ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in COLOURS)


def to_json(claims: Sequence[Claim]) -> str:
    """Return claims as a JSON list."""
    return json.dumps([asdict(claim) for claim in claims], indent=1, ensure_ascii=False, allow_nan=False)


def from_json(text: str) -> list[Claim]:
    """Return the claims that `to_json` wrote."""
    return [Claim(**{**item, "runs": tuple(item["runs"])}) for item in json.loads(text)]


def to_markdown(claims: Sequence[Claim], title: str, notes: Sequence[str] = ()) -> str:
    """Return claims as a Markdown document, one table per section of the paper.

    Parameters
    ----------
    claims
        Evaluated.
    title
        Name of the run.
    notes
        What stands in for the paper's own ingredients.
    """
    lines = [f"# Claims of the paper: {title}", "", tally(claims), ""]
    lines += [f"Stand-in: {note}." for note in notes] + ([""] if notes else [])
    for section in dict.fromkeys(claim.section for claim in claims):
        lines += [
            f"## {section}",
            "",
            "| claim | the paper | measured | must be | why | |",
            "|---|---|---|---|---|---|",
        ]
        for claim in claims:
            if claim.section == section:
                where = f"; {', '.join(claim.runs)}" if claim.runs else ""
                cells = (
                    claim.name,
                    claim.sentence,
                    f"**{measured(claim)}** ({claim.quantity}{where})",
                    claim.threshold,
                    claim.why,
                    claim.verdict,
                )
                lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def show_table(claims: Sequence[Claim], title: str, console: Console) -> None:
    """Print the evaluated claims as a table, and after it those that could not be, by what they lack."""
    table = Table(title=f"{title}: {tally(claims)}", title_justify="left", show_lines=True, expand=True)
    for heading, ratio in (("claim", 5), ("measured", 4), ("must be", 2)):
        table.add_column(heading, ratio=ratio)
    table.add_column("", no_wrap=True)
    lacking: dict[str, list[str]] = {}
    for claim in claims:
        if claim.verdict == "not evaluated":
            lacking.setdefault(claim.reason, []).append(claim.name)
            continue
        what = f"[bold]{claim.name}[/bold]\n{escape(claim.sentence)}"
        value = f"{escape(measured(claim))}\n[dim]{escape(claim.quantity)}[/dim]"
        colour = COLOURS[claim.verdict]
        table.add_row(what, value, escape(claim.threshold), f"[{colour}]{claim.verdict}[/{colour}]")
    console.print(table)
    for reason, names in lacking.items():
        console.print(f"not evaluated: {', '.join(names)}: {reason}", markup=False)


def write_claims(claims: Sequence[Claim], folder: Path, title: str, notes: Sequence[str] = ()) -> None:
    """Write claims.json and claims.md into a folder."""
    (folder / CLAIMS_JSON).write_text(to_json(claims) + "\n", encoding="utf-8")
    (folder / CLAIMS_MARKDOWN).write_text(to_markdown(claims, title, notes), encoding="utf-8")
