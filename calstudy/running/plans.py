"""Show what a run would do, and what it did, as tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from calstudy.claims.tables import CLAIMS_JSON, CLAIMS_MARKDOWN, from_json, measured, tally
from calstudy.experiment.collection import Collection
from calstudy.experiment.model import Experiment
from calstudy.experiment.runtime import RuntimeStudy
from calstudy.graph.collections import CollectionGraph
from calstudy.graph.estimates import LIBRARIES_MEMORY, Cost, estimate
from calstudy.graph.runtimes import RuntimeGraph
from calstudy.graph.sweeps import SweepGraph
from calstudy.graph.tasks import Graph, Task
from calstudy.resources import free_memory
from calstudy.running.collection_runs import CollectionRun
from calstudy.running.execution import schedule
from calstudy.running.progress import duration
from calstudy.running.runs import Run
from calstudy.running.store import Store


def _by_stage(tasks: Sequence[Task]) -> dict[str, list[Task]]:
    groups: dict[str, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[task.stage].append(task)
    return groups


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e7 else f"{count / 1e6:.1f} MB"


def show_plan(
    study: Experiment | Collection | RuntimeStudy,
    graph: Graph | CollectionGraph | SweepGraph | RuntimeGraph,
    folders: Sequence[Path],
    workers: int,
    console: Console,
) -> None:
    """Print the stages of an experiment or a collection, what is in the store, and what the rest will take.

    Parameters
    ----------
    study, graph
        What is planned, and its tasks.
    folders
        Its run folders.
    workers
        Worker processes.
    console
        Where it is written.
    """
    store = Store(study.outputs.store)
    plan = schedule(graph.targets, store)
    todo = {task.key for task in plan.todo}
    table = Table(title=f"{study.name}: plan for {workers} worker(s)", title_justify="left")
    for heading, justify in (("stage", "left"), ("products", "right"), ("to make", "right"), ("cpu time", "right")):
        table.add_column(heading, justify=justify)
    table.add_column("memory each", justify="right")
    table.add_column("disk", justify="right")
    for stage, tasks in _by_stage(graph.tasks).items():
        costs = [estimate(task) for task in tasks if task.key in todo]
        table.add_row(
            stage,
            str(len(tasks)),
            str(len(costs)),
            duration(sum(cost.seconds for cost in costs)) if costs else "-",
            _gigabytes(max(cost.memory for cost in costs)) if costs else "-",
            _gigabytes(sum(cost.disk for cost in costs)) if costs else "-",
        )
    console.print(table)
    for task in plan.damaged:
        console.print(f"damaged, will be made again: {task.stage} ({task.label})", markup=False)
    _total([estimate(task) for task in plan.todo], plan.todo, workers, console)
    for note in graph.footnotes:
        console.print(f"stand-in: {note}", markup=False)
    console.print(f"store: {store.root}", markup=False, soft_wrap=True)
    for folder in folders:
        console.print(f"run folder: {folder}", markup=False, soft_wrap=True)


def _total(costs: list[Cost], tasks: Sequence[Task], workers: int, console: Console) -> None:
    if not costs:
        console.print("everything is in the store: a run only writes its folder")
        return
    kept = sum(cost.disk for cost, task in zip(costs, tasks, strict=True) if not task.temporary)
    memory = LIBRARIES_MEMORY + workers * max(cost.memory for cost in costs)
    console.print(
        f"in all: about {duration(sum(cost.seconds for cost in costs) / workers)}, "
        f"up to {_gigabytes(memory)} of memory ({_gigabytes(free_memory())} free), "
        f"{_gigabytes(sum(cost.disk for cost in costs))} of disk while running, {_gigabytes(kept)} kept"
    )


def show_result(result: Run, console: Console) -> None:
    """Print what a run made, what it warns of, and where its results are."""
    made = {task.key for task in result.made}
    if not made:
        console.print("everything was in the store: nothing was computed")
    table = Table(title="products", title_justify="left")
    table.add_column("stage")
    for heading in ("made", "from store", "cpu time", "peak memory"):
        table.add_column(heading, justify="right")
    for stage, tasks in _by_stage(result.tasks).items():
        records = [result.products[task.key].record for task in tasks if task.key in made]
        stored = sum(task.key in result.products and task.key not in made for task in tasks)
        table.add_row(
            stage,
            str(len(records)),
            str(stored),
            duration(sum(record["cpu_seconds"] for record in records)) if records else "-",
            _gigabytes(max(record["peak_memory_bytes"] for record in records)) if records else "-",
        )
    console.print(table)
    for warning in result.warnings:
        console.print(f"warning: {warning}", markup=False)
    for figure in sorted((result.folder / "figures").glob("*.png")):
        console.print(f"figure: {figure}", markup=False)
    console.print(f"tables: {result.folder / 'tables'}\nmanifest: {result.folder / 'manifest.json'}", markup=False)


def show_collection_result(result: CollectionRun, console: Console) -> None:
    """Print what the members of a collection made, and where the results and the combined ones are."""
    for name, member in result.members.items():
        console.print(f"\n{name}", markup=False)
        show_result(member, console)
    console.print(f"\ncombined: {result.folder}", markup=False)
    for figure in sorted((result.folder / "figures").glob("*.png")):
        console.print(f"figure: {figure}", markup=False)


def show_claims(folder: Path, console: Console) -> None:
    """Print how many of the paper's claims hold in a run, which fail, and where all of them are."""
    claims = from_json((folder / CLAIMS_JSON).read_text(encoding="utf-8"))
    for claim in claims:
        if claim.verdict == "FAIL":
            console.print(f"claim FAILS: {claim.name}: {measured(claim)}, must be {claim.threshold}", markup=False)
    console.print(f"claims: {tally(claims)}: {folder / CLAIMS_MARKDOWN}", markup=False)
