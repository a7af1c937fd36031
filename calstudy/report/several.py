"""The page of several runs: fields that differ, their spectra and T in one chart each, and all else side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import yaml

from calstudy.base.errors import InputError
from calstudy.base.paths import leaves
from calstudy.base.table import Table
from calstudy.report.page import (
    CLAIMS_TITLE,
    POWER,
    SERIES,
    Chart,
    Contents,
    Picture,
    chart_of_curves,
    curve,
    images_of,
    page_of,
    read_contents,
    write_page,
)
from calstudy.results.reader import RunFolder, Unevaluated

ALWAYS_DIFFERENT = ("name", "description", "outputs")
"""Sections of an experiment whose differences do not concern its results."""
COLOURS = ("orange", "cyan", "magenta", "red", "black", "grey")
"""Colours of the runs in charts of all; the EoR, of the first run, is grey."""
MOST = len(COLOURS) - 1


@dataclass(frozen=True)
class Several:
    """Some runs, and their common contents.

    Names are those of the runs, or of their folders if two runs have one name. Differences are the fields of the
    experiments that differ. Claims, the papers' statements with the verdicts on all, are None if no run has any. A
    picture or table is None where a run lacks it.
    """

    contents: Sequence[Contents]
    names: Sequence[str]
    differences: Table
    charts: Sequence[Chart]
    claims: Table | None
    pictures: Sequence[Sequence[Picture | None]]
    tables: Sequence[tuple[str, Sequence[Table | None]]]


def read_several(folders: Sequence[Path]) -> Several:
    """Read run folders; raises InputError if one of them is not that of a finished run, or there are too many."""
    if not 2 <= len(folders) <= MOST:
        raise InputError(f"a page of several runs has 2 to {MOST}, not {len(folders)}")
    runs = [RunFolder(folder) for folder in folders]
    contents = [read_contents(run) for run in runs]
    names = [found.title for found in contents]
    if len(set(names)) < len(names):
        names = [folder.resolve().name for folder in folders]
    pictures = _matched([{item.name: item for item in found.pictures} for found in contents])
    tables = _matched([{item.title: item for item in found.tables} for found in contents])
    claims = tables.pop(CLAIMS_TITLE, None)
    return Several(
        contents,
        names,
        _differences([found.experiment for found in contents], names),
        _overlaid(runs, names),
        None if claims is None else _claims(claims, names),
        list(pictures.values()),
        list(tables.items()),
    )


def _matched(found: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    return {name: [one.get(name) for one in found] for name in dict.fromkeys(name for one in found for name in one)}


def _differences(texts: Sequence[str], names: Sequence[str]) -> Table:
    fields = [dict(leaves(yaml.safe_load(text) or {})) if text else {} for text in texts]
    rows = []
    for name in dict.fromkeys(name for one in fields for name in one):
        values = [one.get(name) for one in fields]
        if name.partition(".")[0] not in ALWAYS_DIFFERENT and any(value != values[0] for value in values):
            rows.append((name, *(str(one.get(name, "-")) for one in fields)))
    note = "" if rows else "The experiments do not differ."
    return Table(("field", *names), rows, "Fields that differ", note)


def _overlaid(runs: Sequence[RunFolder], names: Sequence[str]) -> list[Chart]:
    """Return P^R of all runs with the EoR of the first, and T of all, outside the wedge; none where one run has it."""
    spectra: list[dict[str, Any]] = []
    transfers: list[dict[str, Any]] = []
    for run, name, colour in zip(runs, names, COLOURS, strict=False):
        for variant in ("residual", "eor"):
            label, grey = SERIES[variant]
            with suppress(Unevaluated, InputError):
                found = run.tables.spherical(variant, "outside-wedge")
                points = (found.k, found.power.real, found.error)
                if variant == "residual":
                    spectra.append(curve(f"{label}, {name}", colour, points))
                elif all(other["colour"] != grey for other in spectra):
                    spectra.append(curve(f"{label}, {name}", grey, points))
        with suppress(Unevaluated, InputError):
            loss = run.tables.transfer("outside-wedge")
            points = (loss.k, loss.scale_free_transfer, loss.scale_free_transfer_error)
            transfers.append(curve(name, colour, points))
    charts = [
        chart_of_curves("Power spectra outside the wedge", POWER, True, spectra),
        chart_of_curves("T outside the wedge, free of the flux scale", "T", False, transfers),
    ]
    return [chart for chart in charts if sum(one["colour"] != "grey" for one in chart.data["series"]) > 1]


def _claims(found: Sequence[Table | None], names: Sequence[str]) -> Table | None:
    """Return one row for each statement, with the numbers and the verdicts of all runs."""
    rows: dict[tuple[str, ...], list[tuple[str, str] | None]] = {}
    for side, table in enumerate(found):
        for row in table.rows if table is not None else ():
            section, sentence, quantity, measured, threshold, verdict = row
            rows.setdefault((section, sentence, quantity, threshold), [None] * len(found))[side] = (measured, verdict)
    cells = [
        (*statement, *(text for texts in zip_longest(*(side or ("", "") for side in sides)) for text in texts))
        for statement, sides in rows.items()
    ]
    columns = ("section", "sentence", "measured is", "must be", *names, *(f"verdict, {name}" for name in names))
    return Table(columns, cells, CLAIMS_TITLE) if cells else None


def write_several(folders: Sequence[Path], output: Path, overwrite: bool = False) -> Path:
    """Write the page of several runs, completely or not at all, and return its path.

    Raises InputError if a folder is not that of a finished run, or the file exists and `overwrite` is false.
    """
    if output.exists() and not overwrite:
        raise InputError(f"{output}: exists; choose another --output, or --overwrite it")
    several = read_several(folders)
    page = page_of("several.html", several=several, images=[images_of(found) for found in several.contents])
    return write_page(page, output)
