"""The store of products: content-addressed folders, written atomically, verified before use.

A product is a folder ``<store>/<stage>/<key>/`` of files in standard formats plus ``product.json``, its record: code,
settings and inputs from which it was made, and the SHA-256 of every file and of the record itself. A folder that exists
is complete, because it is filled under another name and renamed; a folder that does not match its record is damaged,
and is made again.

Runs share a store, and the last one removes a temporary product. Before a run looks for existing products, it writes
the keys of all that it needs to ``<store>/.runs/ID.json``, and holds the lock ``ID.lock`` as long as it lives. It takes
a key out of the file when no task that it has left needs the product. A temporary product is then removed if no other
live run names it. Runs that were killed hold no lock: their files do not count, and are removed. All of this is done
under one lock of the store.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any
from uuid import uuid4

from filelock import FileLock, Timeout

from calstudy.base.errors import InputError, error_number, errors_of_files
from calstudy.base.files import digest_json, replacing, sha256
from calstudy.run.task import Task

RECORD, DIGEST = "product.json", "digest"
"""The record of a product, and its field with the digest of all others."""
SILENT_WAIT, LONGEST_WAIT = 5.0, 24 * 3600.0
"""Seconds after which a wait for a lock is reported, and after which it ends."""
PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Stages and keys: names of folders, without separators or dots."""
KEY = re.compile(r"[0-9a-f]{32}")
"""Keys of products."""


@dataclass(frozen=True)
class Product:
    """A complete product: its folder and its record, and whether it was made now, not found."""

    path: Path
    record: Mapping[str, Any]
    made: bool = field(default=False, compare=False)

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(entry["bytes"] for entry in self.record["files"].values())


def _holder(path: Path) -> str:
    with suppress(OSError):
        if text := path.read_text(encoding="utf-8"):
            return text
    return "a process that does not say"


def _inside(name: str) -> bool:
    """Return whether a recorded file is in its product's folder, and not elsewhere by an absolute path or by dots."""
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and "\0" not in name


def require_writable(folder: Path, name: str) -> None:
    """Raise InputError, with the `name` of a field or option, if a folder cannot be created or written.

    Permissions do not tell it (nobody can create a folder in /proc): a temporary folder is made in what exists of it.
    """
    found = folder
    try:
        found = next(path for path in (folder, *folder.parents) if path.exists())
        if not found.is_dir():
            raise InputError(f"{name}: cannot be written ({found} is a file; a folder is needed)")
        with tempfile.TemporaryDirectory(prefix=".calstudy-", dir=found):
            pass
    except OSError as error:
        raise InputError(f"{name}: cannot be written ({error.strerror}); no folder can be made in {found}") from None


class Store:
    """A folder of products for several runs on several machines at once; it need not exist before `prepare`."""

    def __init__(self, root: Path) -> None:
        self.root = root.expanduser().resolve()

    def prepare(self) -> None:
        """Create the folder if necessary; raises InputError if it cannot be written."""
        require_writable(self.root, f"outputs.store = {str(self.root)!r}")
        with errors_of_files(f"outputs.store = {str(self.root)!r}: cannot be made"):
            self.root.mkdir(parents=True, exist_ok=True)

    def folder(self, stage: str, key: str) -> Path:
        """Return the folder of a product, which need not exist; raises ValueError if it could be outside the store."""
        if not (PLAIN.fullmatch(stage) and PLAIN.fullmatch(key)):
            raise ValueError(f"stage {stage!r} and key {key!r} of a product must be plain names")
        return self.root / stage / key

    def find(self, stage: str, key: str) -> Product | None:
        """Return the product if its record is intact and all files have their recorded sizes; they are not read."""
        folder = self.folder(stage, key)
        try:
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            recorded = record.pop(DIGEST)
            sizes = {name: (folder / name).stat().st_size for name in record["files"]}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        if recorded != digest_json(record) or not all(_inside(name) for name in sizes):
            return None
        intact = all(sizes[name] == entry["bytes"] for name, entry in record["files"].items())
        return Product(folder, record) if intact and record.get("key") == key else None

    def verify(self, stage: str, key: str) -> Product | None:
        """Return the product if every file still has its recorded SHA-256, else None."""
        if (product := self.find(stage, key)) is None:
            return None
        files = product.record["files"]
        with suppress(OSError):
            if all(sha256(product.path / name) == entry["sha256"] for name, entry in files.items()):
                return product
        return None

    def exists(self, stage: str, key: str) -> bool:
        """Return whether there is any folder under this key, intact or damaged."""
        # It may have a name that no file can have, or be in a folder that may not be read.
        return os.path.exists(self.folder(stage, key))  # noqa: PTH110

    def addresses(self) -> list[tuple[str, str]]:
        """Return stage and key of every product in the store, intact or damaged.

        Any other folder, which lacks the name of a key, or a record and the file of a lock, must not be deleted.
        """
        return [
            (path.parent.name, path.name)
            for path in sorted(self.root.glob("[!.]*/[!.]*"))
            if path.is_dir()
            and KEY.fullmatch(path.name)
            and PLAIN.fullmatch(path.parent.name)
            and ((path / RECORD).exists() or self._lock_file(path.parent.name, path.name).exists())
        ]

    def discard(self, stage: str, key: str) -> None:
        """Remove a product, if it exists; its name disappears at once."""
        folder = self.folder(stage, key)
        if os.path.lexists(folder):
            grave = folder.parent / f".discarded-{key}-{uuid4().hex}"
            folder.rename(grave)
            if grave.is_symlink():
                grave.unlink()
            else:
                shutil.rmtree(grave, ignore_errors=True)

    def remove(self, stage: str, key: str) -> None:
        """Remove a product that no run needs (`calstudy.run.store`), and the file of its lock."""
        self.discard(stage, key)
        self._lock_file(stage, key).unlink(missing_ok=True)

    def _lock_file(self, stage: str, key: str) -> Path:
        return self.root / ".locks" / f"{stage}-{key}.lock"

    @contextmanager
    def lock(self, stage: str, key: str, warn: Callable[[str], None] = lambda text: None) -> Iterator[None]:
        """Hold the right to make this product; another run that needs it waits, and then finds it made.

        After a wait of `SILENT_WAIT`, `warn` is called with a sentence that names the holder. Raises InputError if
        another process holds the lock for `LONGEST_WAIT`, or if the file system has no locks.
        """
        path = self._lock_file(stage, key)
        holder = path.with_suffix(".holder")
        path.parent.mkdir(exist_ok=True)
        # Without flock, runs would wait forever for the marker of a process that died on another host.
        lock = FileLock(path, fallback_to_soft=False)
        try:
            try:
                lock.acquire(timeout=SILENT_WAIT)
            except Timeout:
                warn(f"{stage} {key}: waits for the lock {path}, held by {_holder(holder)}")
                lock.acquire(timeout=LONGEST_WAIT)
        except Timeout:
            raise InputError(
                f"{stage} {key}: the lock {path} was held for {LONGEST_WAIT / 3600:g} h by {_holder(holder)}; end that "
                "process, and run again"
            ) from None
        except OSError as error:
            if error_number(error) not in (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK):
                raise
            raise InputError(
                f"outputs.store = {str(self.root)!r}: its file system has no locks (flock), which keep two runs from "
                "making the same product at the same time; choose another folder with --set outputs.store=DIR"
            ) from None
        try:
            with suppress(OSError):
                holder.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
            yield
        finally:
            with suppress(OSError):
                holder.unlink()
            lock.release()

    @contextmanager
    def building(self, stage: str, key: str) -> Iterator[Path]:
        """Yield an empty folder to fill, under `lock`, and then to `seal`; those that a killed run left are removed."""
        parent = self.root / stage
        parent.mkdir(exist_ok=True)
        for leftover in (*parent.glob(f".building-{key}-*"), *parent.glob(f".discarded-{key}-*")):
            shutil.rmtree(leftover, ignore_errors=True)
        folder = parent / f".building-{key}-{uuid4().hex}"
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def seal(self, folder: Path, record: Mapping[str, Any]) -> Product:
        """Record the files of a folder from `building`, and give it the name of the `stage` and `key` in the record."""
        files = {
            path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256(path)}
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        # The record as it will be read: JSON has no tuples, and only text as keys.
        complete = json.loads(json.dumps({**record, "files": files}, allow_nan=False))
        _write_record(folder, complete)
        final = self.folder(record["stage"], record["key"])
        self.discard(record["stage"], record["key"])
        folder.rename(final)
        return Product(final, complete, made=True)


def keep(product: Product) -> None:
    """Make a temporary product one that stays; in a read-only store nothing is changed."""
    with suppress(OSError):
        _write_record(product.path, {**product.record, "temporary": False})


def _write_record(folder: Path, record: Mapping[str, Any]) -> None:
    text = json.dumps({**record, DIGEST: digest_json(record)}, indent=1, sort_keys=True)
    with replacing(folder / RECORD) as stream:
        stream.write(text.encode())


def products(store: Store) -> Iterator[Product]:
    """Yield all complete products of a store."""
    for address in store.addresses():
        if (product := store.find(*address)) is not None:
            yield product


@dataclass(frozen=True)
class Leftover:
    """A folder that a run fills, or a killed one left: key of its product, bytes, seconds since its last change."""

    path: Path
    key: str
    size: int
    age: float


def leftovers(store: Store) -> list[Leftover]:
    """Return the folders of a store that are not products."""
    found = []
    for path in sorted([*store.root.glob("*/.building-*"), *store.root.glob("*/.discarded-*")]):
        with suppress(OSError):  # A run in progress may have renamed it.
            files = [file.stat() for file in (path, *path.rglob("*"))]
            size, changed = sum(file.st_size for file in files[1:]), max(file.st_mtime for file in files)
            # As `Store.building` and `Store.discard` name them.
            key = path.name.split("-")[1]
            found.append(Leftover(path, key, size, max(0.0, time.time() - changed)))
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
            inputs = known[key].record.get("inputs", {}) if key in known else {}
            waiting += [needed for _, needed in inputs.values()]
    return [product for key, product in known.items() if key not in used]


LEASES = ".runs"
LEASE_LOCK = ("runs", "leases")
"""The name of the lock of all leases, as that of a product."""


class Lease:
    """The products that a run still needs, by key; without `holding` it needs none."""

    def __init__(self, store: Store) -> None:
        self._store, self._path = store, store.root / LEASES / f"{uuid4().hex}.json"
        self._keys: set[str] = set()

    @contextmanager
    def holding(self, keys: Iterable[str]) -> Iterator[None]:
        """Name products as needed within the block."""
        self._keys = set(keys)
        lock = FileLock(self._path.with_suffix(".lock"), fallback_to_soft=False)
        with self._store.lock(*LEASE_LOCK):
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
        """Give up tasks, and remove their temporary products that nobody needs; a read-only store stays as it is."""
        found = {task.key: self._store.find(task.stage.name, task.key) for task in tasks}
        temporary = {key: product for key, product in found.items() if product and product.record.get("temporary")}
        if not temporary and self._keys.isdisjoint(found):
            return
        with suppress(OSError), self._store.lock(*LEASE_LOCK):
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
    """Return the keys of what live runs need, except those of one file; `store.lock(*LEASE_LOCK)` must be held."""
    found: set[str] = set()
    for path in (store.root / LEASES).glob("*.json"):
        if path == but:
            continue
        lock = FileLock(path.with_suffix(".lock"), fallback_to_soft=False)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            # The run may end at this moment.
            with suppress(FileNotFoundError):
                found.update(json.loads(path.read_text(encoding="utf-8")))
        else:
            _remove(path)
            lock.release()
    return found


def _remove(path: Path) -> None:
    for suffix in (".json", ".new", ".lock"):
        path.with_suffix(suffix).unlink(missing_ok=True)
