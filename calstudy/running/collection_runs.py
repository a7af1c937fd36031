"""Run a collection: every member with its own run folder, every shared product once, and what compares them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.experiment.collection import Collection
from calstudy.graph.collections import CollectionGraph
from calstudy.report.page import write_report
from calstudy.running.execution import Crew
from calstudy.running.runs import MANIFEST, Run, fill_folder, log_to, make, open_folder, publish, run_folder, write
from calstudy.running.store import Product, Store, digest_json


@dataclass(frozen=True)
class CollectionRun:
    """A finished run of a collection.

    Attributes
    ----------
    folder
        Holds the combined figures and claims, a manifest that names the members' run folders, and the log.
    products
        The collection's own, by key.
    members
        The run of each member, by its name.
    """

    folder: Path
    products: Mapping[str, Product]
    members: Mapping[str, Run]


def collection_folder(collection: Collection) -> Path:
    """Return the folder of a collection's runs: its name and a digest of what it and its members say."""
    content = {
        "members": {name: run_folder(experiment).name for name, experiment in collection.members.items()},
        "roles": dict(collection.roles),
        "figures": list(collection.figures),
    }
    return collection.outputs.runs.expanduser().resolve() / f"{collection.name}-{digest_json(content)[:8]}"


def run_collection(collection: Collection, workers: int, scheduler: str | None, console: Console) -> CollectionRun:
    """Make what all members and the collection ask for, reusing every product that is in the store.

    Parameters
    ----------
    collection
        Validated.
    workers, scheduler, console
        As for `calstudy.running.runs.run`.

    Raises
    ------
    InputError
        If the store or a run folder cannot be written, or a stage refuses its input.
    """
    graph, store, folder = CollectionGraph(collection), Store(collection.outputs.store), collection_folder(collection)
    store.prepare()
    folders = {name: run_folder(experiment) for name, experiment in collection.members.items()}
    with ExitStack() as logs:
        for needed in (folder, *folders.values()):
            open_folder(needed)
            logs.enter_context(log_to(needed / "run.log"))
        products, made = make(graph.targets, store, Crew(workers, folder / "run.log", scheduler), console)
        members = {name: fill_folder(folders[name], graph.graphs[name], products, made) for name in collection.members}
        publish([products[task.key] for task in graph.figures], folder / "figures")
        publish([products[graph.claims.key]], folder)
        write(folder / MANIFEST, json.dumps(_manifest(graph, folders), indent=1))
        write_report(folder)
    return CollectionRun(folder, {task.key: products[task.key] for task in graph.own}, members)


def _manifest(graph: CollectionGraph, folders: Mapping[str, Path]) -> dict[str, Any]:
    collection = graph.collection
    return {
        "name": collection.name,
        "description": collection.description,
        "members": {name: folder.name for name, folder in folders.items()},
        "roles": dict(collection.roles),
        "stand_ins": list(graph.footnotes),
        "products": [{"stage": task.stage, "label": task.label, "key": task.key} for task in graph.own],
    }
