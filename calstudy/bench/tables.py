"""Tables of measurements: on the terminal, as CSV, and as Markdown for the documentation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table as TerminalTable

from calstudy.errors import InputError

SUFFIXES = (".csv", ".md")


def require_writable(path: Path) -> None:
    """Raise InputError unless a table can be written to this path; called before anything is measured."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"--output {path}: the name must end in {' or '.join(SUFFIXES)}")
    if not path.absolute().parent.is_dir():
        raise InputError(f"--output {path}: there is no folder {path.absolute().parent}")


def show(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], console: Console) -> None:
    """Print a table; the first column to the left, the others to the right."""
    table = TerminalTable(title=title, title_justify="left")
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def write(path: Path, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table as CSV or Markdown, whichever the path's ending says; see `require_writable`."""
    require_writable(path)
    if path.suffix == ".csv":
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([headings, *rows])
        return
    marks = ["---", *["--:"] * (len(headings) - 1)]
    lines = ["| " + " | ".join(row) + " |" for row in (headings, marks, *rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
