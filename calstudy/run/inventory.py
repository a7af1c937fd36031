"""List the products of a store and the runs of a folder, and find products that no run refers to."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calstudy.base.errors import InputError
from calstudy.run.store import Product, Store

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class RunEntry:
    """A finished run: its folder, the name of the study, the size of all files in bytes, and its products' keys."""

    folder: Path
    name: str
    finished: datetime
    size: int
    keys: frozenset[str]


def list_runs(folder: Path) -> list[RunEntry]:
    """Return the finished runs in a folder and its subfolders, the latest first; raises InputError without a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of runs")
    found = []
    for path in sorted(folder.rglob(MANIFEST)):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            finished = datetime.fromisoformat(content["finished"])
            keys = frozenset(entry["key"] for entry in content.get("products", []))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        size = sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
        found.append(RunEntry(path.parent, str(content.get("name", "")), finished, size, keys))
    return sorted(found, key=lambda entry: entry.finished, reverse=True)


def products(store: Store) -> Iterator[Product]:
    """Yield all complete products of a store."""
    for address in store.addresses():
        if (product := store.find(*address)) is not None:
            yield product


@dataclass(frozen=True)
class Leftover:
    """A folder that a killed run was filling or removing, or that a run is filling now.

    `size` is that of its files in bytes, `age` the time since its last change in seconds.
    """

    path: Path
    size: int
    age: float


def leftovers(store: Store) -> list[Leftover]:
    """Return the folders of a store that are not products."""
    found = []
    for path in sorted([*store.root.glob("*/.building-*"), *store.root.glob("*/.discarded-*")]):
        with suppress(OSError):  # A run in progress may have renamed it.
            files = [file.stat() for file in (path, *path.rglob("*"))]
            size, changed = sum(file.st_size for file in files[1:]), max(file.st_mtime for file in files)
            found.append(Leftover(path, size, max(0.0, time.time() - changed)))
    return found


def age_of(product: Product) -> float:
    """Return the seconds since a product was made."""
    made = datetime.fromisoformat(str(product.record["started"]))
    return (datetime.now(UTC) - made).total_seconds()


def unreferenced(found: Iterable[Product], runs: Iterable[RunEntry]) -> list[Product]:
    """Return the products that no run names, and from which no such product was made."""
    known = {product.record["key"]: product for product in found}
    waiting, used = [key for run in runs for key in run.keys], set()
    while waiting:
        key = waiting.pop()
        if key not in used:
            used.add(key)
            waiting += _inputs(known[key].record) if key in known else []
    return [product for key, product in known.items() if key not in used]


def _inputs(record: Any) -> list[str]:
    return [str(key) for _, key in record.get("inputs", {}).values()]
