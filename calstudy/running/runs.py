"""Runs: make what an experiment asks for, and leave a folder that says what was made and from what."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

from rich.console import Console

from calstudy.errors import InputError
from calstudy.experiment.files import dump
from calstudy.experiment.model import Experiment
from calstudy.graph.estimates import estimate
from calstudy.graph.tasks import Graph, Task, unique
from calstudy.report.page import write_report
from calstudy.running.execution import Crew, drop_temporary, execute, schedule
from calstudy.running.progress import report
from calstudy.running.provenance import git_commit, machine, package_versions, seeds
from calstudy.running.store import Product, Store, digest_json

logger = logging.getLogger(__name__)
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes
    ----------
    folder
        Holds the resolved experiment, the manifest, the log, figures and tables.
    products
        By key.
    made
        Tasks whose products this run made; the others were in the store.
    tasks
        All tasks of the experiment whose products the run made or looked at.
    """

    folder: Path
    products: dict[str, Product]
    made: tuple[Task, ...]
    tasks: tuple[Task, ...]

    @property
    def warnings(self) -> list[str]:
        """What the stages warn of, with the product that it is about."""
        records = [product.record for product in self.products.values()]
        return [
            f"{record['stage']} ({record['label']}): {text}"
            for record in records
            for text in record["notes"].get("warnings", [])
        ]


def run_folder(experiment: Experiment) -> Path:
    """Return the folder of this experiment's runs: its name and a digest of all that it says.

    The same experiment has the same folder; a changed one never overwrites it.
    """
    pieces = {"simulation": {"chunks"}, "calibration": {"models_at_once"}}
    without = {"outputs": {"store", "runs"}, "scales": True, **pieces}
    content = experiment.model_dump(mode="json", exclude=without)
    return experiment.outputs.runs.expanduser().resolve() / f"{experiment.name}-{digest_json(content)[:8]}"


def open_folder(folder: Path) -> None:
    """Make a run folder, or refuse one that holds what no run wrote; raises InputError."""
    results = {"report.html", "figures", "tables", "points", "claims.json", "claims.md", "regression.json"}
    known = results | {MANIFEST, "experiment.yaml", "run.log"}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in folder.iterdir() if path.name not in known and path.name[0] != ".")
        (folder / "run.log").touch()
    except OSError as error:
        raise InputError(f"outputs.runs = {str(folder.parent)!r}: cannot be written ({error.strerror})") from None
    if strangers:
        raise InputError(
            f"outputs.runs: {folder} holds {strangers[0]!r}, which no run wrote; move it or choose another folder"
        )


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append what calstudy logs, and warnings, to a file."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root, package = logging.getLogger(), logging.getLogger("calstudy")
    level = package.level
    root.addHandler(handler)
    package.setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        package.setLevel(level)
        root.removeHandler(handler)
        handler.close()


def write(path: Path, text: str) -> None:
    """Write a text file so that it is there whole or not at all."""
    partial = path.with_name(f".{path.name}-{uuid4().hex}")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def publish(products: list[Product], folder: Path) -> None:
    """Copy the files of products into a folder of the run, each whole or not at all."""
    folder.mkdir(exist_ok=True)
    for product in products:
        for name in product.record["files"]:
            partial = folder / f".{name}-{uuid4().hex}"
            shutil.copyfile(product.path / name, partial)
            partial.replace(folder / name)


def product_entries(tasks: Sequence[Task], products: dict[str, Product], made: set[str]) -> list[dict[str, Any]]:
    """Return what a manifest says of every product: what it was made from, what it took, and by which run."""
    entries = []
    for task in tasks:
        if task.key in products:
            record = products[task.key].record
            fields = (
                "stage",
                "label",
                "key",
                "notes",
                "seconds",
                "cpu_seconds",
                "peak_memory_bytes",
                "started",
                "inputs",
            )
            entries.append({**{field: record[field] for field in fields}, "made_by_this_run": task.key in made})
    return entries


def _manifest(experiment: Experiment, graph: Graph, products: dict[str, Product], made: set[str]) -> dict[str, Any]:
    return {
        "name": experiment.name,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "stand_ins": list(graph.footnotes),
        "seeds": seeds(experiment.model_dump(mode="json")),
        "git_commit": git_commit(),
        "versions": package_versions(),
        "machine": machine(),
        "products": product_entries(graph.tasks, products, made),
    }


def make(
    targets: Sequence[Task], store: Store, crew: Crew, console: Console
) -> tuple[dict[str, Product], tuple[Task, ...]]:
    """Make products and all that they need, as far as it is not in the store, and tell how it goes.

    Returns
    -------
    products
        By key: those that were made or looked at, and all others behind them that are still in the store.
    made
        The tasks whose products were made.
    """
    plan = schedule(targets, store)
    for task in plan.damaged:
        message = f"{task.stage} ({task.label}): the product in the store is damaged, and is made again"
        logger.warning(message)
        console.print(message, markup=False)
    costs = {task.key: estimate(task).seconds for task in plan.todo}
    with report(plan.todo, costs, console) as show:

        def done(task: Task, product: Product) -> None:
            logger.info("%s (%s): %.1f s", task.stage, task.label, product.record["seconds"])
            show(task, product)

        products = execute(plan.todo, store, crew, done)
    products |= plan.ready
    drop_temporary(targets, store)
    for task in unique(targets):
        if task.key not in products and (found := store.find(task.stage, task.key)) is not None:
            products[task.key] = found
    return products, plan.todo


def fill_folder(folder: Path, graph: Graph, products: dict[str, Product], made: Sequence[Task]) -> Run:
    """Put what an experiment asked for into its run folder: figures, tables, claims, manifest, the experiment itself.

    Parameters
    ----------
    folder
        From `run_folder`, after `open_folder`.
    graph
        Of the experiment.
    products, made
        From `make`; products and tasks that are not the experiment's are passed over.
    """
    own = {task.key for task in graph.tasks}
    own_products = {key: product for key, product in products.items() if key in own}
    own_made = tuple(task for task in made if task.key in own)
    publish([products[task.key] for task in graph.figures], folder / "figures")
    publish([products[task.key] for task in graph.tables], folder / "tables")
    publish([products[graph.claims.key]], folder)
    write(folder / "experiment.yaml", dump(graph.experiment))
    manifest = _manifest(graph.experiment, graph, own_products, {task.key for task in own_made})
    write(folder / MANIFEST, json.dumps(manifest, indent=1))
    write_report(folder)
    return Run(folder, own_products, own_made, tuple(graph.tasks))


def run(experiment: Experiment, workers: int = 1, scheduler: str | None = None, console: Console | None = None) -> Run:
    """Make the figures and spectra of an experiment, reusing every product that is in the store.

    Parameters
    ----------
    experiment
        Validated.
    workers
        Worker processes on this machine.
    scheduler
        Address of a running dask scheduler to use instead, or None.
    console
        Where progress is written; nowhere if None.

    Raises
    ------
    InputError
        If the experiment has a sweep, the store or the run folder cannot be written, or a stage refuses its input.
    """
    if experiment.sweep:
        raise InputError(f"{experiment.name}: has a sweep, and so is several experiments; run it with run_sweep")
    graph, store, folder = Graph(experiment), Store(experiment.outputs.store), run_folder(experiment)
    store.prepare()
    open_folder(folder)
    with log_to(folder / "run.log"):
        crew = Crew(workers, folder / "run.log", scheduler)
        products, made = make(graph.targets, store, crew, console or Console(quiet=True))
        return fill_folder(folder, graph, products, made)
