"""Tables of the work that a run would do, and of its results."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.base.resources import LIBRARIES_MEMORY, free_memory, parse_memory, total_memory
from calstudy.base.table import Table
from calstudy.instrument.layouts import describe
from calstudy.products.files import REALIZATIONS
from calstudy.report.headline import PLACE, measured_numbers, read_signal
from calstudy.report.page import REPORT
from calstudy.results.reader import MANIFEST, RunFolder
from calstudy.run.execution import Budget, largest_disk, schedule
from calstudy.run.progress import duration
from calstudy.run.store import Store, require_writable
from calstudy.run.task import Task
from calstudy.studies.study import Run, Study, said_of_other_code
from calstudy.verdicts.standing import advice, standing_table
from calstudy.verdicts.tables import BY_SOLVER_MARKDOWN, CLAIMS_MARKDOWN, measured, tally

NAMED = 8
"""Number of run folders that a plan names; it counts the others."""


def _by_stage(tasks: Sequence[Task]) -> dict[str, list[Task]]:
    groups: dict[str, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[task.stage.name].append(task)
    return groups


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e7 else f"{count / 1e6:.1f} MB"


def describe_plan(study: Study, budget: Budget) -> dict[str, Any]:
    """Return the products and the cost of a run as plain JSON types; seconds on one core, and bytes.

    Raises InputError if the study does not fit, or store or run folders cannot be written.
    """
    study, workers = study.sized_to(budget)
    store = Store(study.outputs.store)
    plan = schedule(study.targets, store, study.external_keys, budget.strict)
    if plan.todo:
        require_writable(store.root, f"outputs.store = {str(store.root)!r}")
    require_writable(study.folder.parent, f"outputs.runs = {str(study.folder.parent)!r}")
    todo = {task.key for task in plan.todo}
    stages = []
    for stage, tasks in _by_stage(study.tasks).items():
        costs = [task.cost for task in tasks if task.key in todo]
        stages.append(
            {
                "stage": stage,
                "products": len(tasks),
                "to_make": len(costs),
                "seconds": sum(cost.seconds for cost in costs),
                "memory_each": max((cost.memory for cost in costs), default=0.0),
                "disk": sum(cost.disk for cost in costs),
            }
        )
    largest = max((task.cost.memory for task in plan.todo), default=0.0)
    notes = list(study.notes)
    if budget.max_memory is not None and parse_memory(budget.max_memory) > total_memory():
        notes.insert(0, f"--max-memory {budget.max_memory} is more than this machine has")
    return {
        "name": study.name,
        "setup": study.setup,
        "workers": workers,
        "stages": stages,
        "seconds": sum(task.cost.seconds for task in plan.todo),
        "memory": LIBRARIES_MEMORY + workers * largest if plan.todo else 0.0,
        "memory_free": float(free_memory()),
        "disk_while_running": largest_disk(study.targets, plan.todo),
        "disk_kept": sum(task.cost.disk for task in plan.todo if not task.temporary),
        "damaged": [f"{task.stage.name} ({task.label})" for task in plan.damaged],
        "other_code": said_of_other_code(study.targets, plan, store),
        "stand_ins": list(study.stand_ins),
        "notes": notes,
        "sites": sites(study.tasks),
        "store": str(store.root),
        "run_folders": [str(part.folder) for part in study.with_parts()],
    }


def show_plan(plan: Mapping[str, Any], console: Console) -> None:
    """Print a plan, from `describe_plan`."""
    columns = ("stage", "products", "to make", "cpu time", "memory each", "disk")
    rows = []
    for row in plan["stages"]:
        costs = (duration(row["seconds"]), _gigabytes(row["memory_each"]), _gigabytes(row["disk"]))
        rows.append((row["stage"], str(row["products"]), str(row["to_make"]), *(costs if row["to_make"] else "---")))
    Table(columns, rows, f"{plan['name']}: plan for {plan['workers']} worker(s)").show(console)
    lines = [plan["setup"]] if plan["setup"] else []
    lines += [f"damaged, will be made again: {product}" for product in plan["damaged"]]
    lines += [*plan["other_code"], _total(plan)]
    for heading, kind in (("stand-in", "stand_ins"), ("note", "notes"), ("site", "sites")):
        lines += [f"{heading}: {line}" for line in plan[kind]]
    _print(lines, console)
    folders = plan["run_folders"]
    places = [f"store: {plan['store']}", *(f"run folder: {folder}" for folder in folders[:NAMED])]
    console.print("\n".join(places), markup=False, soft_wrap=True)
    if len(folders) > NAMED:
        console.print(f"and {len(folders) - NAMED} run folders more; --json names all")


def _print(lines: Iterable[str], console: Console) -> None:
    for line in lines:
        console.print(line, markup=False)


def sites(tasks: Sequence[Task]) -> list[str]:
    """Name the sites of the arrays of simulations, once each."""
    instruments = [task.settings["instrument"] for task in tasks if "instrument" in task.settings]
    return list(dict.fromkeys(describe(found.site) for found in instruments))


def _total(plan: Mapping[str, Any]) -> str:
    if not any(row["to_make"] for row in plan["stages"]):
        return "everything is in the store: a run only writes its folder"
    return (
        f"in all: about {duration(plan['seconds'] / plan['workers'])}, "
        f"up to {_gigabytes(plan['memory'])} of memory ({_gigabytes(plan['memory_free'])} free), "
        f"{_gigabytes(plan['disk_while_running'])} of disk while running, {_gigabytes(plan['disk_kept'])} kept"
    )


def show_run(run: Run, console: Console) -> None:
    """Print products, warnings and folders of a run and its parts, and the counts of the claims."""
    for name, part in run.parts.items():
        console.print(f"\n{name}", markup=False)
        _show_products(part, console)
    if run.parts:
        console.print("")
    _show_products(run, console)
    for folder in (run.folder, *(part.folder for part in run.parts.values())):
        _show_criteria(folder, console)
    _show_claims(run.folder, console)


def _show_products(run: Run, console: Console) -> None:
    made = {task.key for task in run.made.tasks}
    if not made:
        console.print("everything was in the store: nothing was computed")
    rows = []
    for stage, tasks in _by_stage(run.tasks).items():
        records = [run.made.products[task.key].record for task in tasks if task.key in made]
        stored = sum(task.key in run.made.products and task.key not in made for task in tasks)
        seconds = sum(record["cpu_seconds"] for record in records)
        memory = max((record["peak_memory_bytes"] for record in records), default=0)
        cost = (duration(seconds), _gigabytes(memory)) if records else "--"
        rows.append((stage, str(len(records)), str(stored), *cost))
    Table(("stage", "made", "from store", "cpu time", "peak memory"), rows, "products").show(console)
    folder = run.folder
    _print([*(f"warning: {warning}" for warning in run.warnings), *_signal(RunFolder(folder))], console)
    _show_answer(RunFolder(folder), console)
    _print((f"figure: {figure}" for figure in sorted((folder / "figures").glob("*.png"))), console)
    files = {"tables": folder / "tables", "manifest": folder / MANIFEST, "report": folder / REPORT}
    _print((f"{name}: {path}" for name, path in files.items() if path.exists()), console)


def _signal(run: RunFolder) -> list[str]:
    """Return what was calibrated, T and bias of a run, if it has them, and a warning if the bias exceeds the EoR."""
    lines = [run.manifest["setup"]] if "setup" in run.manifest else []
    signal = read_signal(run)
    if signal is None:
        return [*lines, *(f"{number.name}: {number.text}" for number in measured_numbers(run))]
    numbers = ", ".join(f"{number.name} {number.text}" for number in signal.numbers)
    return [*lines, f"{PLACE}: {numbers}", *([f"warning: {signal.excess}"] if signal.excess is not None else [])]


def _show_answer(run: RunFolder, console: Console) -> None:
    """Print which calibrators of a comparison pass, or T of every point of a sweep; nothing for other runs."""
    found = run.standings()
    for table in [standing_table(found)] if found else run.shown if run.parts else []:
        table.show(console, numbers=False)
        _print([table.note, *advice(found)] if found else [], console)


def _show_criteria(folder: Path, console: Console) -> None:
    """Print the verdicts on the criteria for the realizations of an experiment; nothing for other runs."""
    path = folder / "tables" / REALIZATIONS
    if verdicts := RunFolder(folder).verdicts(path):
        lines = [f"{item.name}: {item.verdict}: {measured(item)}, must be {item.threshold}" for item in verdicts]
        _print([*lines, f"criteria: {tally(verdicts)}: {path.with_suffix('.md')}"], console)


def _show_claims(folder: Path, console: Console) -> None:
    """Print the counts of claims of a run, the contradicted ones, and the file of all; nothing without claims."""
    finished = RunFolder(folder)
    verdicts = finished.claims
    lines = [
        f"claim contradicted: {item.name}: {measured(item)}, must be {item.threshold}"
        for item in verdicts
        if item.verdict == "contradicted"
    ]
    none = "none, for the run plays no role in the papers that it names; for the reasons see"
    if finished.has_claims:
        counted = f"{tally(verdicts)}:" if verdicts else none
        lines.append(f"claims: {counted} {folder / CLAIMS_MARKDOWN}")
    if (folder / BY_SOLVER_MARKDOWN).is_file():
        lines.append(f"claims by solver: {folder / BY_SOLVER_MARKDOWN}")
    _print(lines, console)
