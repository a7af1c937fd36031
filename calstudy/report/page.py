"""The report of a run, or of two side by side, as one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any
from uuid import uuid4

import yaml

from calstudy.base.errors import InputError
from calstudy.base.paths import leaves
from calstudy.base.table import Table
from calstudy.report.contents import CLAIMS_TITLE, Contents, Picture, read_contents
from calstudy.results.folder import RunFolder

REPORT = "report.html"
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


def render(contents: Contents) -> str:
    """Return the page with its pictures, style and script."""
    return _page("page.html", contents=contents, images=_images(contents))


def render_pair(pair: Pair) -> str:
    """Return the page of two runs side by side."""
    return _page("pair.html", pair=pair, images=[_images(pair.first), _images(pair.second)])


def _page(template: str, **values: Any) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("calstudy.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    css, script = ((Path(__file__).parent / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return environment.get_template(template).render(css=css, script=script, **values)


def _images(contents: Contents) -> dict[str, str]:
    return {picture.name: base64.b64encode(picture.path.read_bytes()).decode("ascii") for picture in contents.pictures}


def write_report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run, completely or not at all, and return its path.

    Raises InputError for other folders.
    """
    return _write(render(read_contents(RunFolder(folder))), folder / REPORT)


def write_pair(first: Path, second: Path, output: Path, overwrite: bool = False) -> Path:
    """Write the page of two runs, completely or not at all, and return its path.

    Raises InputError if a folder is not that of a finished run, or the file exists and `overwrite` is false.
    """
    if output.exists() and not overwrite:
        raise InputError(f"{output}: exists; choose another --output, or --overwrite it")
    return _write(render_pair(read_pair((first, second))), output)


def _write(page: str, path: Path) -> Path:
    partial = path.with_name(f".{path.name}-{uuid4().hex}")
    try:
        partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    partial.replace(path)
    return path
