"""Members of a collection that were run before, whose tables come from their run folders."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.results.reader import MANIFEST, RunFolder
from calstudy.run.store import Product, Store
from calstudy.run.task import Task
from calstudy.studies.kinds.collection import Collection
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.study import Study

TABLES = "tables"


@dataclass(frozen=True)
class FinishedRun:
    """A finished run, or a reference with its tables.

    The folder has ``manifest.json``, whose content is `manifest`, and ``tables/``. `tables` are the manifest's
    entries, by key, of the products that these are made of.
    """

    folder: Path
    manifest: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, Any]]

    @property
    def described(self) -> str:
        """The folder, and the time when the run finished."""
        return f"{self.folder} (finished {self.manifest.get('finished', 'at an unknown time')})"

    def refusal(self, study: ExperimentStudy) -> str | None:
        """Return why a study cannot be taken from this run, or None if its tables are present and unchanged."""
        if not self.tables:
            return (
                "its manifest does not list the files of its tables: it is of an older version, or not of an experiment"
            )
        if not all(task.key in self.tables for task in study.tables):
            return "its tables are of other settings, or another version of a stage"
        for task in study.tables:
            for name, digest in self.tables[task.key]["files"].items():
                path = self.folder / TABLES / name
                if Path(name).name != name or not path.is_file() or sha256(path) != digest:
                    return f"{TABLES}/{name} is not what the run wrote: it was changed or lost"
        return None


def find_finished(folders: Sequence[Path]) -> list[FinishedRun]:
    """Return the readable finished runs among these folders and directly below them.

    Raises InputError if a folder neither is one nor contains any.
    """
    found = []
    for folder in folders:
        inside = (
            [folder] if (folder / MANIFEST).is_file() else sorted(path.parent for path in folder.glob(f"*/{MANIFEST}"))
        )
        runs = [run for path in inside if (run := _read(path)) is not None]
        if not runs:
            raise InputError(f"--finished {folder}: is not the folder of a finished run, and holds none")
        found += runs
    return found


def _read(folder: Path) -> FinishedRun | None:
    run = RunFolder(folder)
    try:
        tables = {entry["key"]: entry for entry in run.products if isinstance(entry.get("files"), dict)}
    except (InputError, KeyError, TypeError, AttributeError):
        return None
    return FinishedRun(folder, run.manifest, tables)


def with_finished(collection: Study, folders: Sequence[Path], console: Console, *, planned: bool = False) -> Collection:
    """Return a collection whose members are taken from finished runs of the same studies.

    The tables of such a member are put into the store of the collection, and it is not run again. The console shows the
    run of each member, and the reason why a run of its name is not used. With `planned`, the store does not change.
    Raises InputError if the study is not a collection, no member is found, the store has other results of a member, or
    it cannot be written.
    """
    if not isinstance(collection, Collection):
        raise InputError("--finished: only a collection (a file with the key 'experiments') takes members from runs")
    runs, store = find_finished(folders), Store(collection.outputs.store)
    taken: dict[str, tuple[FinishedRun, list[Task]]] = {}
    for name, study in collection.studies.items():
        if (reason := _needs_more(collection, name, study)) is not None:
            console.print(f"{name}: will be run ({reason})", markup=False)
            continue
        if (run := _choose(name, study, runs, console)) is not None:
            taken[name] = run, study.tables
    if not taken:
        given = ", ".join(str(folder) for folder in folders)
        members = ", ".join(collection.members)
        raise InputError(f"--finished {given}: no finished run of a member is there (members: {members})")
    for run, tables in taken.values():
        for task in tables:
            there = store.verify(task.stage.name, task.key)
            if there is not None:
                _require_same(there, run.tables[task.key]["files"], run, store)
            elif not planned:
                _put(task, run, store)
    return collection.without({name: run.folder for name, (run, _) in taken.items()})


def _choose(name: str, study: ExperimentStudy, runs: Sequence[FinishedRun], console: Console) -> FinishedRun | None:
    """Return the run that a member is taken from, or None; print the choice, or the reasons against it."""
    refusals = {run.folder: run.refusal(study) for run in runs}
    for run in runs:
        if refusals[run.folder] is None:
            console.print(f"{name}: taken from {run.described}", markup=False)
            return run
    for other in runs:
        if other.manifest.get("name") == name:
            console.print(f"{name}: {other.folder} is left out; {refusals[other.folder]}", markup=False)
    console.print(f"{name}: will be run", markup=False)
    return None


def _needs_more(collection: Collection, name: str, study: ExperimentStudy) -> str | None:
    """Return the reason why a collection needs more of a member than its tables, or None."""
    if not study.keeps_tables:
        return "it has realizations; such members are always run"
    tables = {task.key for task in study.tables}
    others = {task.key for task in study.tasks} - tables
    for task in collection.own:
        for needed in task.needs.values():
            if needed.key in others:
                return f"{task.label} needs of {name} what is no table: {needed.stage.name} ({needed.label})"
    return None


def _put(task: Task, run: FinishedRun, store: Store) -> None:
    """Put a table of a run into a store, under the key of its product."""
    entry, stage = run.tables[task.key], task.stage.name
    store.prepare()
    with store.lock(stage, task.key), store.building(stage, task.key) as folder:
        try:
            for name in entry["files"]:
                shutil.copyfile(run.folder / TABLES / name, folder / name)
            kept = {key: value for key, value in entry.items() if key not in ("files", "made_by_this_run")}
            record = {"lineage": "", **kept}
            origin = {key: run.manifest.get(key) for key in ("name", "finished", "git_commit")}
            store.seal(folder, {**record, "stage": stage, "temporary": False, "from_run": origin})
        except OSError as error:
            raise InputError(f"outputs.store = {str(store.root)!r}: cannot be written ({error.strerror})") from None


def _require_same(there: Product, files: Mapping[str, str], run: FinishedRun, store: Store) -> None:
    """Raise InputError if a table of the store differs from that of a run: two runs of a study differ by rounding."""
    found = {name: file["sha256"] for name, file in there.record["files"].items()}
    other = next((name for name in {**files, **found} if files.get(name) != found.get(name)), None)
    if other is not None:
        raise InputError(
            f"--finished {run.folder}: {TABLES}/{other} differs from that of the same study in the store {store.root}; "
            "leave this folder out to use the store, or use another store with --set outputs.store=DIR"
        )
