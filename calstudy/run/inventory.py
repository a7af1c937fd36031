"""List the products of a store, and find products that no run refers to."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calstudy.run.store import Product, Store


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


def unreferenced(found: Iterable[Product], named: Iterable[str]) -> list[Product]:
    """Return the products without a key that a run names, and from which no such product was made."""
    known = {product.record["key"]: product for product in found}
    waiting, used = list(named), set()
    while waiting:
        key = waiting.pop()
        if key not in used:
            used.add(key)
            waiting += _inputs(known[key].record) if key in known else []
    return [product for key, product in known.items() if key not in used]


def _inputs(record: Any) -> list[str]:
    return [str(key) for _, key in record.get("inputs", {}).values()]
