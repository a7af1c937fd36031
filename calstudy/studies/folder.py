"""Run folders: what a run leaves for people, written whole or not at all, never in a folder that holds other files."""

from __future__ import annotations

import json
import logging
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

from calstudy.base.errors import InputError, exit_status
from calstudy.base.identity import digest_json
from calstudy.run.provenance import git_commit, machine, of_other_code, other_code, package_versions
from calstudy.run.store import Product
from calstudy.run.task import Task
from calstudy.verdicts.tables import CLAIMS_FILES

MANIFEST, EXPERIMENT, LOG = "manifest.json", "experiment.yaml", "run.log"
LEFTOVER = re.compile(r"\..+-[0-9a-f]{32}")
POINTS, CASES = "points", "cases"
"""Folders of the run folders of a sweep's points, and of the experiments of a comparison's cases."""


def run_folder(runs: Path, name: str, content: Any) -> Path:
    """Return the folder of a study's runs: its name and a digest of all that it says.

    The same study has the same folder; a changed one never overwrites it.

    Parameters
    ----------
    runs
        Folder of run folders.
    name
        Of the study.
    content
        JSON-able: what decides its results.
    """
    return runs.expanduser().resolve() / f"{name}-{digest_json(content)[:8]}"


def open_folder(folder: Path) -> None:
    """Make a run folder, or refuse one that holds what no run wrote; raises InputError."""
    results = {"report.html", "figures", "tables", POINTS, CASES, "regression.json"}
    known = results | {MANIFEST, EXPERIMENT, LOG, *CLAIMS_FILES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in folder.iterdir() if path.name not in known and path.name[0] != ".")
        (folder / LOG).touch()
        _remove_leftovers(folder)
    except OSError as error:
        raise InputError(f"outputs.runs = {str(folder.parent)!r}: cannot be written ({error.strerror})") from None
    if strangers:
        raise InputError(
            f"outputs.runs: {folder} holds {strangers[0]!r}, which no run wrote; move it or choose another folder"
        )


class _LogFile(logging.FileHandler):
    """A log whose disk may be full: the run says so itself, and not with a traceback for each line."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Leave the line out."""


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append what calstudy logs, and warnings, to a file; and at the end how the block ended, with the exit status."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root, package = logging.getLogger(), logging.getLogger("calstudy")
    level = package.level
    root.addHandler(handler)
    package.setLevel(logging.INFO)
    logging.captureWarnings(True)
    ended: BaseException | None = None
    try:
        yield
    except BaseException as error:
        ended = error
        raise
    finally:
        why = "" if ended is None else f": {str(ended) or type(ended).__name__}"
        text = f"ended with status {exit_status(ended)}{why}"
        how = logging.INFO if ended is None else logging.ERROR
        handler.handle(package.makeRecord(__name__, how, __file__, 0, text, (), None))
        logging.captureWarnings(False)
        package.setLevel(level)
        root.removeHandler(handler)
        handler.close()


def _remove_leftovers(folder: Path) -> None:
    """Remove files that a killed run was writing; those of the last minute may be those of another run."""
    for path in folder.rglob(".*"):
        if LEFTOVER.fullmatch(path.name) and time.time() - path.stat().st_mtime > 60:
            path.unlink(missing_ok=True)


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


def write_manifest(folder: Path, name: str, fields: Mapping[str, Any]) -> None:
    """Write manifest.json: the fields of a study, with time, commit, versions and machine.

    Parameters
    ----------
    folder
        Run folder.
    name
        Of the study.
    fields
        What the study says itself; it may replace the machine.
    """
    manifest = {
        "name": name,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": git_commit(),
        "versions": package_versions(),
        "machine": machine(),
        "other_code": other_code([entry["stage"] for entry in fields.get("products", ()) if "made_with" in entry]),
        **fields,
    }
    write(folder / MANIFEST, _as_json(manifest))
    _remove_leftovers(folder)


def _as_json(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as JSON with a line for each product; comparisons have more than a thousand."""
    if not manifest.get("products"):
        return json.dumps(manifest, indent=1)
    text = json.dumps({key: value for key, value in manifest.items() if key != "products"}, indent=1)
    lines = ",\n  ".join(json.dumps(entry) for entry in manifest["products"])
    return text.removesuffix("\n}") + f',\n "products": [\n  {lines}\n ]\n}}'


RECORDED = ("label", "key", "notes", "seconds", "cpu_seconds", "peak_memory_bytes", "started", "inputs", "lineage")
"""Fields of a product's record that a manifest repeats."""
MADE_WITH = ("made_with", "git_commit", "processor", "libraries")
"""The same for products of other code."""


def product_entries(
    tasks: Sequence[Task], products: Mapping[str, Product], made: Sequence[Task], tables: Sequence[Task] = ()
) -> list[dict[str, Any]]:
    """Return what a manifest says of every product: what it was made from, what it took, and by which run.

    A product that is of other code or other versions of packages than the run has what it was made with.

    Parameters
    ----------
    tasks
        Whose products.
    products
        By key; tasks without one are left out.
    made
        The tasks whose products this run made.
    tables
        The tasks whose files are the tables of the run folder. Their entries have the SHA-256 of each file.
    """
    keys, published = {task.key for task in made}, {task.key for task in tables}
    other = of_other_code(tasks, {task.key: products[task.key] for task in tasks if task.key in products})
    entries = []
    for task in tasks:
        if task.key in products:
            record = products[task.key].record
            entry = {"stage": task.stage.name, **{field: record[field] for field in RECORDED}}
            if task.key in published:
                entry["files"] = {name: file["sha256"] for name, file in record["files"].items()}
            if task.key in other:
                entry |= {field: record.get(field) for field in MADE_WITH}
            entries.append({**entry, "made_by_this_run": task.key in keys})
    return entries
