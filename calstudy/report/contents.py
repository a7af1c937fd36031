"""The contents of a run folder, as the tables of its report."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calstudy.base.table import Table
from calstudy.report.charts import Chart, read_charts
from calstudy.report.headline import Number, read_headline, read_signal
from calstudy.results.folder import EXPERIMENT, MANIFEST, RunFolder
from calstudy.run.progress import duration
from calstudy.verdicts.standing import answers, standing_table
from calstudy.verdicts.tables import CLAIMS_JSON, tally, verdict_table

CLAIMS_TITLE = "Claims of the paper"


@dataclass(frozen=True)
class Picture:
    """A figure of the report: the png, its other files relative to the run folder, and charts of its arrays."""

    name: str
    caption: str
    path: Path
    files: Sequence[str] = ()
    charts: Sequence[Chart] = ()


@dataclass(frozen=True)
class Contents:
    """All contents of a report.

    Facts are short statements by name, such as the time, the machine and versions. Answers say which calibrators of a
    comparison pass. Pictures and tables are in the order of the page, below the headline. Files, tables and records,
    are relative to the run folder. Parts are the run folders of which this one consists: name and relative path of
    their reports. The experiment is the resolved file, or empty.
    """

    title: str
    description: str
    setup: str
    facts: Mapping[str, str]
    stand_ins: Sequence[str]
    warnings: Sequence[str]
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    headline: Sequence[Number] = ()
    answers: Sequence[str] = ()
    files: Sequence[str] = ()
    parts: Sequence[tuple[str, str]] = field(default=())
    experiment: str = ""


def read_contents(run: RunFolder) -> Contents:
    """Read the folder of a finished run of any study; raises InputError for others."""
    manifest = run.manifest
    experiment = run.path / EXPERIMENT
    text = experiment.read_text(encoding="utf-8") if experiment.is_file() else ""
    sky_model = f" Sky model: {manifest['sky_model']}." if "sky_model" in manifest else ""
    found = run.standings()
    tables = [
        standing_table(found) if found else None,
        _claims(run),
        *run.shown,
        _convergence(run.products, sky_model),
        _simulation(run.products),
        _stages(run.products),
    ]
    signal = read_signal(run)
    excess = [] if signal is None or signal.excess is None else [signal.excess]
    return Contents(
        title=run.name,
        description=manifest.get("description") or (run.content.get("description", "") if text else ""),
        setup=manifest.get("setup", ""),
        facts=_facts(manifest),
        stand_ins=manifest.get("stand_ins", []),
        warnings=[
            *excess,
            *manifest.get("warnings", []),
            *(f"{label}: {text}" for label, text in _warnings(run.products)),
        ],
        pictures=_pictures(run),
        tables=[table for table in tables if table is not None],
        headline=read_headline(run),
        answers=answers(found),
        files=_files(run.path),
        parts=_parts(run),
        experiment=text,
    )


def _facts(manifest: Mapping[str, Any]) -> dict[str, str]:
    facts = {"finished": manifest.get("finished"), "commit": manifest.get("git_commit")}
    facts["sky model of the calibrator"] = manifest.get("sky_model")
    machine = manifest.get("machine", {})
    if machine:
        facts["machine"] = f"{machine['cores']} cores, {machine['memory_gb']} GB, {machine['system']}"
    seeds = manifest.get("seeds", {})
    facts["seeds"] = ", ".join(f"{name} {value}" for name, value in seeds.items())
    versions = manifest.get("versions", {})
    facts["versions"] = ", ".join(f"{name} {value}" for name, value in versions.items() if value)
    return {name: str(value) for name, value in facts.items() if value}


def _warnings(products: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    return [
        (f"{item['stage']} ({item['label']})", text)
        for item in products
        for text in item.get("notes", {}).get("warnings", [])
    ]


def _pictures(run: RunFolder) -> list[Picture]:
    """Return the pictures of the manifest in its order and with its captions, then others by name."""
    found = {path.stem: path for path in sorted((run.path / "figures").glob("*.png"))}
    drawn = [item for item in run.products if item["stage"] == "figure"]
    captions = {item["label"]: item.get("notes", {}).get("caption", "") for item in drawn}
    captions = run.manifest.get("captions", captions)
    order = [name for name in captions if name in found]
    order += [name for name in found if name not in captions]
    return [_picture(name, captions.get(name, ""), found[name]) for name in order]


def _picture(name: str, caption: str, path: Path) -> Picture:
    others = [path.with_suffix(suffix) for suffix in (".pdf", ".npz")]
    files = [f"figures/{other.name}" for other in others if other.is_file()]
    return Picture(name, caption, path, files, read_charts(others[1]) if others[1].is_file() else ())


def _files(folder: Path) -> list[str]:
    tables = sorted(path for path in (folder / "tables").glob("*") if path.is_file())
    records = [folder / name for name in ("claims.md", CLAIMS_JSON, EXPERIMENT, MANIFEST, "run.log")]
    return [str(path.relative_to(folder)) for path in (*records, *tables) if path.is_file()]


def _parts(run: RunFolder) -> list[tuple[str, str]]:
    # Members may come from references, which have no page.
    pages = {name: part.path.resolve() / "report.html" for name, part in run.parts.items()}
    return [(name, os.path.relpath(page, run.path.resolve())) for name, page in pages.items() if page.is_file()]


def _claims(run: RunFolder) -> Table | None:
    """Return the verdicts on the papers' statements, or a sentence without a role in any paper; None without papers."""
    if not run.has_claims:
        return None
    claims = run.claims
    evaluated = [claim for claim in claims if claim.measured is not None]
    if not evaluated:
        reasons = [text for item in run.products for text in item.get("notes", {}).get("without_role", [])]
        return Table((), (), CLAIMS_TITLE, " ".join(reasons)) if reasons else None
    others = len(claims) - len(evaluated)
    lacking = f" {others} further claims were not evaluated; claims.md says why." if others else ""
    return verdict_table(evaluated, CLAIMS_TITLE, f"{tally(claims)}.{lacking}")


def _convergence(products: Sequence[Mapping[str, Any]], sky_model: str) -> Table | None:
    found = [item for item in products if item["stage"] == "calibrate"]
    rows = [
        (
            item["label"],
            ", ".join(f"{count} {status}" for status, count in item["notes"]["by_status"].items()),
            f"{item['notes']['median_steps']:g}" if "median_steps" in item["notes"] else "",
            f"{item['notes']['median_seconds_per_solve']:.2f} s",
        )
        for item in found
    ]
    columns = ("calibration of", "solves", "median steps", "median time per solve")
    return Table(columns, rows, "Solver convergence", sky_model.strip()) if rows else None


def _simulation(products: Sequence[Mapping[str, Any]]) -> Table | None:
    rows = []
    for item in products:
        if item["stage"] == "simulate":
            check = item["notes"].get("interpolation")
            floors = item["notes"].get("delay_floor", {})
            rows.append(
                (
                    item["label"],
                    f"{check['max_error']:.1e}" if check else "not interpolated",
                    ", ".join(f"{floor['worst_db']} dB ({taper})" for taper, floor in floors.items()),
                )
            )
    columns = ("component", "largest interpolation error", "delay floor beyond the horizon")
    note = "Errors relative to the rms; the floor is that of the worst baseline."
    return Table(columns, rows, "Accuracy of the simulation", note) if rows else None


def _stages(products: Sequence[Mapping[str, Any]]) -> Table | None:
    stages: dict[str, list[Mapping[str, Any]]] = {}
    for item in products:
        if "cpu_seconds" in item:
            stages.setdefault(item["stage"], []).append(item)
    rows = [
        (
            stage,
            str(len(items)),
            str(sum(item["made_by_this_run"] for item in items)),
            duration(sum(item["seconds"] for item in items)),
            duration(sum(item["cpu_seconds"] for item in items)),
            f"{max(item['peak_memory_bytes'] for item in items) / 1e9:.2f} GB",
        )
        for stage, items in stages.items()
    ]
    columns = ("stage", "products", "made by this run", "time", "cpu time", "peak memory of the process")
    note = "Time and memory when each product was made, by this run or an earlier one."
    return Table(columns, rows, "Stages", note) if rows else None
