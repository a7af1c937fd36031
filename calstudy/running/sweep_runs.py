"""Run a sweep: every point with its own folder, every shared product once, and the comparison of the points."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from rich.console import Console

from calstudy.experiment.files import dump
from calstudy.experiment.sweep import Sweep
from calstudy.graph.sweeps import SweepGraph
from calstudy.report.page import write_report
from calstudy.running.execution import Crew
from calstudy.running.provenance import git_commit, machine, package_versions
from calstudy.running.runs import MANIFEST, Run, fill_folder, log_to, make, open_folder, publish, run_folder, write
from calstudy.running.store import Product, Store

POINTS, SUMMARY = "points", "summary.csv"


@dataclass(frozen=True)
class SweepRun:
    """A finished run of a sweep.

    Attributes
    ----------
    whole
        All products of all points; its folder holds `tables/summary.csv`, the figure of the signal loss against every
        varied field, the manifest, the log, and the run folders of the points under `points`.
    points
        The run of each point, by its label.
    """

    whole: Run
    points: Mapping[str, Run]


def run_sweep(sweep: Sweep, workers: int = 1, scheduler: str | None = None, console: Console | None = None) -> SweepRun:
    """Make what all points of a sweep ask for, reusing every product that is in the store.

    Parameters
    ----------
    sweep
        From `calstudy.experiment.sweep.expand`.
    workers, scheduler, console
        As for `calstudy.running.runs.run`.

    Raises
    ------
    InputError
        If the store or the run folder cannot be written, or a stage refuses its input.
    """
    base = sweep.base
    graph, store, folder = SweepGraph(sweep), Store(base.outputs.store), run_folder(base)
    store.prepare()
    open_folder(folder)
    (folder / POINTS).mkdir(exist_ok=True)
    folders = {label: folder / POINTS / label for label in graph.graphs}
    for point_folder in folders.values():
        open_folder(point_folder)
    with log_to(folder / "run.log"):
        crew = Crew(workers, folder / "run.log", scheduler)
        products, made = make(graph.targets, store, crew, console or Console(quiet=True))
        points = {label: fill_folder(folders[label], point, products, made) for label, point in graph.graphs.items()}
        summary = products[graph.summary.key]
        publish([summary], folder / "figures")
        (folder / "tables").mkdir(exist_ok=True)
        (folder / "figures" / SUMMARY).replace(folder / "tables" / SUMMARY)
        write(folder / "experiment.yaml", dump(base))
        write(folder / MANIFEST, json.dumps(_manifest(graph, summary), indent=1))
        write_report(folder)
    return SweepRun(Run(folder, products, made, tuple(graph.tasks)), points)


def _manifest(graph: SweepGraph, summary: Product) -> dict[str, Any]:
    fields = ("stage", "label", "key", "seconds", "inputs")
    return {
        "name": graph.sweep.base.name,
        "description": graph.sweep.base.description,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "stand_ins": list(graph.footnotes),
        "git_commit": git_commit(),
        "versions": package_versions(),
        "machine": machine(),
        "points": [
            {"folder": f"{POINTS}/{point.label}", "changes": dict(point.changes)} for point in graph.sweep.points
        ],
        "products": [{field: summary.record[field] for field in fields}],
    }
