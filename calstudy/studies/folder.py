"""Run folders: each file is written completely or not at all, never into a folder with files of other origin."""

from __future__ import annotations

import json
import logging
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calstudy.base.errors import InputError, errors_of_files, exit_status
from calstudy.base.files import replacing, write_text
from calstudy.experiment.model import Folders
from calstudy.results.reader import EXPERIMENT, MANIFEST
from calstudy.run.provenance import git_commit, machine, of_other_code, other_code, package_versions
from calstudy.run.store import Product, require_writable
from calstudy.run.task import Task, unique
from calstudy.verdicts.tables import CLAIMS_FILES

LOG = "run.log"
LEFTOVER = re.compile(r"\..+-[0-9a-f]{32}")


def open_folder(folder: Path, subfolders: Sequence[str]) -> None:
    """Make a run folder, which may have figures, tables and subfolders; raises InputError if no run wrote its files."""
    results = {"report.html", "figures", "tables", *subfolders, "regression.json"}
    known = results | {MANIFEST, EXPERIMENT, LOG, *CLAIMS_FILES}
    with errors_of_files(f"outputs.runs = {str(folder.parent)!r}: cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in folder.iterdir() if path.name not in known and path.name[0] != ".")
        (folder / LOG).touch()
        _remove_leftovers(folder)
    if strangers:
        raise InputError(
            f"outputs.runs: {folder} holds {strangers[0]!r}, which no run wrote; move it or choose another folder"
        )


def folder_of_runs(outputs: Folders) -> Path:
    """Return the folder of runs, and make it if it does not exist; raises InputError if it cannot be written."""
    runs = outputs.runs.expanduser()
    require_writable(runs, f"outputs.runs = {str(runs)!r}")
    runs.mkdir(parents=True, exist_ok=True)
    return runs


class _LogFile(logging.FileHandler):
    """A log file whose write errors print no traceback for each line: a full disk is reported by the run itself."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Omit the line."""


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append the log of calstudy, warnings, and finally the outcome of the block with its exit status, to a file."""
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
    """Remove partial files of a killed run, except those of the last minute, which may belong to another run."""
    for path in folder.rglob(".*"):
        # Another run of the same study may have given it its name meanwhile.
        with suppress(FileNotFoundError):
            if LEFTOVER.fullmatch(path.name) and time.time() - path.stat().st_mtime > 60:
                path.unlink()


def publish(products: list[Product], folder: Path) -> None:
    """Copy the files of products into a folder of the run, each completely or not at all."""
    folder.mkdir(exist_ok=True)
    for product in products:
        for name in product.record["files"]:
            with (product.path / name).open("rb") as made, replacing(folder / name) as file:
                shutil.copyfileobj(made, file)


def write_manifest(folder: Path, name: str, fields: Mapping[str, Any]) -> None:
    """Write manifest.json: the fields of a study, with time, commit, versions and machine, which they may replace."""
    manifest = {
        "name": name,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": git_commit(),
        "versions": package_versions(),
        "machine": machine(),
        "other_code": other_code([entry["stage"] for entry in fields["products"] if "made_with" in entry]),
        **fields,
    }
    write_text(folder / MANIFEST, manifest_text(manifest))
    _remove_leftovers(folder)


def manifest_text(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as JSON, with a line for each product: comparisons have more than a thousand."""
    lines = ",\n  ".join(json.dumps(entry) for entry in manifest["products"])
    others = {name: value for name, value in manifest.items() if name != "products"}
    text = json.dumps(others, indent=1).removesuffix("\n}")
    return f'{text},\n "products": [\n  {lines}\n ]\n}}'


RECORDED = ("label", "key", "notes", "seconds", "cpu_seconds", "peak_memory_bytes", "started", "inputs", "lineage")
"""Fields of a product's record that a manifest repeats."""
MADE_WITH = ("made_with", "git_commit", "processor", "libraries")
"""Further fields for products of other code."""


def product_entries(
    tasks: Sequence[Task], products: Mapping[str, Product], made: Sequence[Task], tables: Sequence[Task] = ()
) -> list[dict[str, Any]]:
    """Return the manifest's entry of every product that there is: its inputs, its cost, and whether this run made it.

    Products of other code or other package versions than the run's also have these versions. The entries of `tables`,
    whose files are the tables of the run folder, have the SHA-256 of each file.
    """
    keys, published = {task.key for task in made}, {task.key for task in tables}
    found = [task for task in tasks if task.key in products]
    other = of_other_code(unique(found), {task.key: products[task.key] for task in found})
    entries = []
    for task in found:
        record = products[task.key].record
        entry = {"stage": task.stage.name, **{field: record[field] for field in RECORDED}}
        if task.key in published:
            entry["files"] = {name: file["sha256"] for name, file in record["files"].items()}
        if task.key in other:
            entry |= {field: record.get(field) for field in MADE_WITH}
        entries.append({**entry, "made_by_this_run": task.key in keys})
    return entries
