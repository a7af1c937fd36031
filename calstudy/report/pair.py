"""Two runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import yaml

from calstudy.base.paths import leaves
from calstudy.base.table import Table
from calstudy.report.contents import CLAIMS_TITLE, Contents, Picture, read_contents
from calstudy.results.folder import RunFolder

ALWAYS_DIFFERENT = ("name", "description", "outputs")
"""Sections of an experiment whose differences do not concern its results."""


@dataclass(frozen=True)
class Pair:
    """Two runs, and their common contents.

    Names are those of the runs, or of their folders if both runs have one name. Differences are the fields of the
    experiments that differ. Claims, the papers' statements with the verdicts on both, are None if neither run has
    any. A picture or table is None where one of the runs lacks it.
    """

    first: Contents
    second: Contents
    names: tuple[str, str]
    differences: Table
    claims: Table | None
    pictures: list[tuple[Picture | None, Picture | None]]
    tables: list[tuple[str, Table | None, Table | None]]


def read_pair(folders: tuple[Path, Path]) -> Pair:
    """Read two run folders; raises InputError if one of them is not that of a finished run."""
    first, second = (read_contents(RunFolder(folder)) for folder in folders)
    names = (first.title, second.title)
    if first.title == second.title:
        names = (folders[0].resolve().name, folders[1].resolve().name)
    pictures = _matched({item.name: item for item in first.pictures}, {item.name: item for item in second.pictures})
    tables = _matched({item.title: item for item in first.tables}, {item.title: item for item in second.tables})
    claims = tables.pop(CLAIMS_TITLE, None)
    return Pair(
        first,
        second,
        names,
        _differences(first.experiment, second.experiment, names),
        None if claims is None else _claims(*claims, names),
        list(pictures.values()),
        [(title, *both) for title, both in tables.items()],
    )


def _matched(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {name: (first.get(name), second.get(name)) for name in [*first, *second]}


def _differences(first: str, second: str, names: tuple[str, str]) -> Table:
    fields = [dict(leaves(yaml.safe_load(text) or {})) if text else {} for text in (first, second)]
    rows = [
        (name, *(str(found.get(name, "-")) for found in fields))
        for name in dict.fromkeys([*fields[0], *fields[1]])
        if fields[0].get(name) != fields[1].get(name) and name.partition(".")[0] not in ALWAYS_DIFFERENT
    ]
    note = "" if rows else "The experiments do not differ."
    return Table(("field", *names), rows, "Fields that differ", note)


def _claims(first: Table | None, second: Table | None, names: tuple[str, str]) -> Table | None:
    """Return one row for each statement, with the numbers and the verdicts of both runs."""
    rows: dict[tuple[str, ...], list[tuple[str, str] | None]] = {}
    for side, table in enumerate((first, second)):
        for row in table.rows if table is not None else ():
            section, sentence, quantity, measured, threshold, verdict = row
            rows.setdefault((section, sentence, quantity, threshold), [None, None])[side] = (measured, verdict)
    cells = [
        (*statement, *(text for pair in zip_longest(*(side or ("", "") for side in sides)) for text in pair))
        for statement, sides in rows.items()
    ]
    columns = ("section", "sentence", "measured is", "must be", *names, *(f"verdict, {name}" for name in names))
    return Table(columns, cells, CLAIMS_TITLE) if cells else None
