"""The products that live runs need, so that runs share a store and the last one removes a temporary product.

Before a run looks for existing products, it writes the keys of all that it needs to ``<store>/.runs/ID.json``, and
holds the lock ``ID.lock`` as long as it lives. It takes a key out of the file when no task that it has left needs the
product. A temporary product is then removed if no other live run names it. Runs that were killed hold no lock: their
files do not count, and are removed. All of this is done under one lock of the store.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from filelock import FileLock, Timeout

from calstudy.run.store import Store
from calstudy.run.task import Task

FOLDER = ".runs"
LOCK = ("runs", "leases")
"""The name of the lock of all leases, as that of a product."""


class Lease:
    """The products that a run still needs, by key; without `holding` it needs none."""

    def __init__(self, store: Store) -> None:
        self._store, self._path = store, store.root / FOLDER / f"{uuid4().hex}.json"
        self._keys: set[str] = set()

    @contextmanager
    def holding(self, keys: Iterable[str]) -> Iterator[None]:
        """Name products as needed within the block."""
        self._keys = set(keys)
        lock = FileLock(self._path.with_suffix(".lock"), fallback_to_soft=False)
        with self._store.lock(*LOCK):
            self._path.parent.mkdir(exist_ok=True)
            lock.acquire(timeout=0)
            self._write()
        try:
            yield
        finally:
            self._keys.clear()
            _remove(self._path)
            lock.release()

    def drop(self, tasks: Iterable[Task]) -> None:
        """Give up tasks, and remove those of their products that were made as temporary ones and that nobody needs.

        Products that a run made to be kept stay, and so does everything in a read-only store.
        """
        given_up = list(tasks)
        found = {task.key: self._store.find(task.stage.name, task.key) for task in given_up}
        temporary = {
            key: product for key, product in found.items() if product is not None and product.record.get("temporary")
        }
        if not temporary and self._keys.isdisjoint(found):
            return
        with suppress(OSError), self._store.lock(*LOCK):
            if self._keys:
                self._keys.difference_update(found)
                self._write()
            needed = needed_by_runs(self._store, self._path)
            for key, product in temporary.items():
                if key not in needed:
                    self._store.remove(product.record["stage"], key)

    def _write(self) -> None:
        new = self._path.with_suffix(".new")
        new.write_text(json.dumps(sorted(self._keys)), encoding="utf-8")
        new.replace(self._path)


def needed_by_runs(store: Store, but: Path | None = None) -> set[str]:
    """Return the keys of the products that live runs need, except those of one file; takes `store.lock(*LOCK)`."""
    found: set[str] = set()
    for path in (store.root / FOLDER).glob("*.json"):
        if path == but:
            continue
        lock = FileLock(path.with_suffix(".lock"), fallback_to_soft=False)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            # The run may end at this moment.
            with suppress(FileNotFoundError):
                found.update(json.loads(path.read_text(encoding="utf-8")))
            continue
        _remove(path)
        lock.release()
    return found


def _remove(path: Path) -> None:
    for suffix in (".json", ".new", ".lock"):
        path.with_suffix(suffix).unlink(missing_ok=True)
