"""Tables: for the terminal, as Markdown, CSV and JSON, and in reports; numbers with their uncertainty."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table as TerminalTable

COLOURS = {
    "PASS": "green",
    "FAIL": "bold red",
    "supported": "green",
    "contradicted": "bold red",
    "undecided": "yellow",
    "not evaluated": "dim",
    "same": "green",
    "moved": "yellow",
    "beyond": "bold red",
}
"""Terminal colours of verdicts, and of comparisons with a reference."""
LARGE = 1e5
"""Numbers above this are written with an exponent."""


@dataclass(frozen=True)
class Table:
    """A table of texts, or of numbers for CSV; each row has as many cells as there are columns.

    Cells with the name of an outcome are coloured. The note, which may be empty, is a sentence below the title.
    Markdown and CSV have neither title nor note.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    note: str = ""

    @property
    def outcomes(self) -> list[str]:
        """The outcomes in the table, once each."""
        return sorted({cell for row in self.rows for cell in row} & set(COLOURS))

    def show(self, console: Console, numbers: bool = True) -> None:
        """Print it with coloured outcomes; with `numbers`, all columns but the first are aligned to the right."""
        table = TerminalTable(title=escape(self.title), title_justify="left")
        for index, column in enumerate(self.columns):
            table.add_column(column, justify="right" if index and numbers else "left", overflow="fold")
        for row in self.rows:
            table.add_row(*(coloured(cell) for cell in row))
        console.print(table)

    def markdown(self, numbers: bool = True) -> str:
        """Return it in Markdown; with `numbers`, all columns but the first are aligned to the right."""
        marks = ["---", *["--:" if numbers else "---"] * (len(self.columns) - 1)]
        rows = ([plain_text(cell).replace("|", "\\|") for cell in row] for row in (self.columns, marks, *self.rows))
        return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"

    @classmethod
    def of_records(cls, records: Sequence[Mapping[str, Any]], first: str | None = None) -> Table:
        """Return the table of records, with empty cells where a record lacks a column; of none, the `first` column."""
        columns = list(dict.fromkeys(column for record in records for column in record)) or [first or ""]
        return cls(columns, [[record.get(column, "") for column in columns] for record in records])

    def csv(self) -> str:
        """Return it as CSV."""
        text = io.StringIO()
        csv.writer(text).writerows([self.columns, *self.rows])
        return text.getvalue()

    def write_csv(self, path: Path) -> None:
        """Write it as CSV."""
        path.write_text(self.csv(), encoding="utf-8", newline="")


def to_json(tables: Sequence[Table]) -> str:
    """Return tables as JSON."""
    return json.dumps([asdict(table) for table in tables], indent=1, ensure_ascii=False)


def from_json(text: str) -> list[Table]:
    """Return the tables that `to_json` wrote."""
    return [Table(**{**table, "rows": [tuple(row) for row in table["rows"]]}) for table in json.loads(text)]


def plain_text(text: str) -> str:
    """Return a text in one line, without tags and entities of HTML but with its Markdown."""
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", re.sub(r"&(?=#?\w+;)", "&amp;", text))


def one_line(text: str) -> str:
    """Return a text of others as one line of at most 1000 characters, without HTML and with Markdown escaped."""
    return re.sub(r"([\\`*_\[\]|!#~]|:(?=//))", r"\\\1", plain_text(text[:1000])).strip()


def coloured(text: str) -> str:
    """Return a cell as markup of the terminal, in its colour if it is the name of an outcome or a status."""
    return f"[{COLOURS[text]}]{text}[/]" if text in COLOURS else escape(text)


def number(value: float, uncertainty: float | None = None) -> str:
    """Write a number with three digits, or with its uncertainty and both to two digits of the uncertainty."""
    if not uncertainty:
        return f"{value:.3g}"
    if not math.isfinite(uncertainty):
        return f"{value:.3g} (error not known)"
    large = LARGE <= abs(value) < math.inf
    places = 1 - math.floor(math.log10(uncertainty)) + (math.floor(math.log10(abs(value))) if large else 0)
    size = f"{value:.{min(15, max(0, places))}{'e' if large else 'f'}}"
    if large and uncertainty >= 100:
        return f"{size} ± {uncertainty:.1e}"
    decimals = max(0, 1 - math.floor(math.log10(uncertainty)))
    return f"{size} ± {uncertainty:.{min(15, decimals)}f}"


def two_digits(value: float) -> str:
    """Write a number with two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.10g}"
