"""Members of a collection that were run before, here or elsewhere: their tables come from their run folders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.run.store import Store, digest_file
from calstudy.studies.collection import Collection
from calstudy.studies.experiment import ExperimentStudy
from calstudy.studies.folder import MANIFEST
from calstudy.studies.study import Study

TABLES = "tables"


@dataclass(frozen=True)
class FinishedRun:
    """The folder of a finished run, or a reference that keeps its tables.

    Attributes
    ----------
    folder
        Has ``manifest.json`` and ``tables/``.
    manifest
        Its content.
    tables
        Entries of the products whose files are its tables, by key.
    """

    folder: Path
    manifest: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, Any]]

    def has(self, study: ExperimentStudy) -> bool:
        """Return whether these are the tables of a study: same settings, same versions of the stages."""
        return all(task.key in self.tables for task in study.tables)


def find_finished(folders: Sequence[Path]) -> list[FinishedRun]:
    """Return the finished runs among these folders and directly below them.

    Raises
    ------
    InputError
        If a folder neither is one nor holds any.
    """
    found = []
    for folder in folders:
        paths = (
            [folder] if (folder / MANIFEST).is_file() else sorted(path.parent for path in folder.glob(f"*/{MANIFEST}"))
        )
        if not paths:
            raise InputError(f"--finished {folder}: is not the folder of a finished run, and holds none")
        found += [_read(path) for path in paths]
    return found


def _read(folder: Path) -> FinishedRun:
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        tables = {entry["key"]: entry for entry in manifest.get("products", []) if "files" in entry}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"--finished {folder}: its {MANIFEST} cannot be read ({error})") from None
    return FinishedRun(folder, manifest, tables)


def with_finished(collection: Study, folders: Sequence[Path], console: Console) -> Collection:
    """Return a collection whose members are taken from finished runs, as far as these are of the same study.

    The tables of such a member are put into the store; the member itself is not run again.

    Parameters
    ----------
    collection
        Its store gets the tables.
    folders
        Run folders or references, or folders that hold some.
    console
        Is told where each member comes from, and why a run of its name is left out.

    Raises
    ------
    InputError
        If the study is not a collection, no member is found, a table is not what its run wrote, or the store cannot be
        written.
    """
    if not isinstance(collection, Collection):
        raise InputError("--finished: only a collection (a file with the key 'experiments') takes members from runs")
    runs, store = find_finished(folders), Store(collection.outputs.store)
    taken = {}
    for name, study in collection.studies.items():
        if not isinstance(study, ExperimentStudy):
            continue
        run = next((run for run in runs if run.has(study)), None)
        if run is not None:
            taken[name] = run
            console.print(f"{name}: taken from {run.folder}, finished {run.manifest['finished']}", markup=False)
            continue
        for other in runs:
            if other.manifest.get("name") == name:
                console.print(f"{name}: {other.folder} is left out ({_reason(other)}); will be run", markup=False)
    if not taken:
        given = ", ".join(str(folder) for folder in folders)
        members = ", ".join(collection.members)
        raise InputError(f"--finished {given}: no finished run of a member is there (members: {members})")
    store.prepare()
    for name, run in taken.items():
        _import(run, collection.studies[name], store)
    return collection.without({name: run.folder for name, run in taken.items()})


def _reason(run: FinishedRun) -> str:
    if not (run.folder / TABLES).is_dir():
        return "it has no tables"
    if not run.tables:
        return "its manifest does not list the files of its tables; it is of an older version"
    return "other settings, or another version of a stage"


def _import(run: FinishedRun, study: Any, store: Store) -> None:
    """Put the tables of a run into a store, under the keys of the products that they are the files of."""
    for task in study.tables:
        entry = run.tables[task.key]
        for name, digest in entry["files"].items():
            path = run.folder / TABLES / name
            if Path(name).name != name or not path.is_file() or digest_file(path) != digest:
                raise InputError(
                    f"--finished {run.folder}: {TABLES}/{name} is not what the run wrote; it was changed or lost"
                )
    for task in study.tables:
        stage, entry = task.stage.name, run.tables[task.key]
        with store.lock(stage, task.key):
            if store.verify(stage, task.key) is not None:
                continue
            with store.building(stage, task.key) as folder:
                for name in entry["files"]:
                    shutil.copyfile(run.folder / TABLES / name, folder / name)
                record = {key: value for key, value in entry.items() if key not in ("files", "made_by_this_run")}
                origin = {key: run.manifest.get(key) for key in ("name", "finished", "git_commit")}
                store.seal(folder, {**record, "stage": stage, "temporary": False, "from_run": origin})
