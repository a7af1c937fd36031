"""The result of a regression, as a table for the terminal and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.base.table import Table
from calstudy.regression.comparison import ArrayComparison, ClaimComparison
from calstudy.verdicts.tables import count

REGRESSION_JSON = "regression.json"
STATUSES = ("same", "moved", "beyond")
LISTED = 20
"""Largest number of listed arrays that moved within their tolerance, the farthest first; all are in the JSON."""


@dataclass(frozen=True)
class Regression:
    """A run against a reference: names of both folders, and all comparisons."""

    reference: str
    run: str
    arrays: list[ArrayComparison]
    claims: list[ClaimComparison]

    @property
    def holds(self) -> bool:
        """True if nothing is beyond its tolerance."""
        statuses = [item.status for item in self.arrays] + [item.status for item in self.claims]
        return "beyond" not in statuses


def tally(items: Sequence[ArrayComparison | ClaimComparison]) -> str:
    """Count the statuses in one line."""
    return count([item.status for item in items], STATUSES)


def write_json(regression: Regression, folder: Path) -> Path:
    """Write ``regression.json`` into a folder; raise InputError if it cannot be written."""
    path = folder / REGRESSION_JSON
    text = json.dumps({**asdict(regression), "holds": regression.holds}, indent=1, ensure_ascii=False)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def show(regression: Regression, console: Console) -> None:
    """Print the count per figure, the arrays that moved and by how much, and the claims that moved."""
    console.print(f"{regression.reference} against {regression.run}", markup=False, highlight=False)
    for figure in dict.fromkeys(item.figure for item in regression.arrays):
        console.print(
            f"  {figure}: {tally([item for item in regression.arrays if item.figure == figure])}", markup=False
        )
    console.print(f"  claims: {tally(regression.claims) if regression.claims else 'none in the reference'}")
    arrays = list(_listed(regression.arrays))
    if arrays:
        _array_table(arrays).show(console)
        hidden = sum(item.status != "same" for item in regression.arrays) - len(arrays)
        for item in arrays:
            if item.status == "beyond":
                allowed = item.problem or f"allowed: {item.tolerance} ({item.why})"
                console.print(f"{item.figure}: {item.name}: {allowed}", markup=False)
        if hidden:
            console.print(f"... and {hidden} more that moved within their tolerance")
    claims = [item for item in regression.claims if item.status != "same"]
    if claims:
        _claim_table(claims).show(console)
    verdict = "holds" if regression.holds else "DOES NOT HOLD: what is 'beyond' is farther than its tolerance"
    console.print(f"{regression.reference}: {verdict}", markup=False, highlight=False)


def _listed(items: Sequence[ArrayComparison]) -> Iterator[ArrayComparison]:
    yield from (item for item in items if item.status == "beyond")
    moved = [item for item in items if item.status == "moved"]
    yield from sorted(moved, key=lambda item: -(item.rms or item.relative or 0))[:LISTED]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _array_table(items: Sequence[ArrayComparison]) -> Table:
    rows = []
    for item in items:
        deviations = (_number(value) for value in (item.relative, item.largest, item.rms, item.shift))
        rows.append((f"{item.figure}: {item.name}", item.status, *deviations))
    return Table(("array", "", "of largest", "largest σ", "rms σ", "mean σ"), rows, "what moved")


def _claim_table(items: Sequence[ClaimComparison]) -> Table:
    rows = []
    for item in items:
        was = f"{_number(item.reference)} {item.reference_verdict}".strip()
        now = f"{_number(item.measured)} {item.verdict}".strip()
        rows.append((item.name, item.status, was, now, _number(item.sigmas)))
    return Table(("claim", "", "was", "is", "σ"), rows, "claims that moved")
