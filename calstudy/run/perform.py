"""Make one product: the unit of work that is sent to a worker."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calstudy import __version__
from calstudy.base.errors import DiskError, InputError, refusal_of_disk
from calstudy.base.resources import Usage
from calstudy.base.schema import plain
from calstudy.run.provenance import git_commit, libraries, lineage, made_with, processor
from calstudy.run.store import Product, Store
from calstudy.run.task import Task

logger = logging.getLogger(__name__)

SPARE = 10e6
"""Bytes that must be free beside the estimated size of a product before it is made."""


@dataclass(frozen=True, kw_only=True)
class WorkOrder:
    """A task without the tasks behind it, as sent to a worker, and what the one who sends it would make it with.

    `disk` is the estimated size of the product in bytes.
    """

    task: Task
    key: str
    inputs: Mapping[str, tuple[str, str]]
    store: Path
    again: bool
    made_with: Mapping[str, Any]
    disk: float

    @classmethod
    def of(cls, task: Task, store: Store, again: bool = False) -> WorkOrder:
        """Return the order for `task`; with `again`, its product is made even if it exists."""
        own = made_with(task)
        inputs = {name: (needed.stage.name, needed.key) for name, needed in task.needs.items()}
        bare = task.given({name: name for name in inputs})
        return cls(
            task=bare, key=task.key, inputs=inputs, store=store.root, again=again, made_with=own, disk=task.cost.disk
        )

    @property
    def name(self) -> str:
        """The stage and the label of the product."""
        return f"{self.task.stage.name} ({self.task.label})"


def perform(order: WorkOrder, told: Callable[[str], None] = logger.warning) -> Product:
    """Make the ordered product, or return it if another run has made it meanwhile.

    Raises InputError if the worker has other code, an input was removed or damaged, the stage refuses a value, or the
    store cannot be written. Any other error of a stage is a bug, and passes with its traceback.
    """
    store = Store(order.store)
    if not store.root.is_dir():
        raise InputError(
            f"outputs.store = {str(store.root)!r}: {order.name}: the worker on "
            f"{socket.gethostname()} has no such folder; all workers must see the store under this path"
        )
    if other := _other(order.made_with, made_with(order.task)):
        raise InputError(
            f"{order.name}: the worker on {socket.gethostname()} has {other}; install the same version of calstudy and "
            "of its packages on all workers, and start them again"
        )
    try:
        with store.lock(order.task.stage.name, order.key, told):
            existing = None if order.again else store.verify(order.task.stage.name, order.key)
            return existing if existing is not None else _make(order, store)
    except InputError:
        raise
    except SystemExit as error:
        # It would end the thread of the worker silently, and the run would wait for it forever.
        raise RuntimeError(f"{order.name}: the process was told to exit") from error
    except (OSError, RuntimeError) as error:
        reason = _unwritable(error, store.root)
        if reason is None:
            raise
        raise _disk_error(order, reason) from None


def _disk_error(order: WorkOrder, reason: str) -> DiskError:
    return DiskError(
        f"outputs.store = {str(order.store)!r}: {order.name} could not be written ({reason}); "
        "make room or choose another folder with --set outputs.store=DIR, and run again: finished products are kept"
    )


def _require_room(order: WorkOrder) -> None:
    """Raise DiskError if a product has no room on the disk.

    HDF5 crashes where the disk is full when it closes a file of which it could not write the head.
    """
    disk = shutil.disk_usage(order.store)
    # Some file systems of networks do not say their size.
    if disk.total > 0 and disk.free < order.disk + SPARE:
        raise _disk_error(order, os.strerror(errno.ENOSPC))


def _other(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Return in a few words what a worker would make a product with, if it differs from here; else an empty text."""
    parts = ["other code of calstudy"] if here["source"] != there["source"] else []
    for name, version in here["versions"].items():
        if (found := there["versions"].get(name)) != version:
            parts.append(f"{name} {found or 'missing'} (here {version or 'missing'})")
    parts += [f"another file {name}" for name, digest in here["files"].items() if there["files"].get(name) != digest]
    return ", ".join(parts)


def _unwritable(error: OSError | RuntimeError, root: Path) -> str | None:
    """Return the reason why a file of the store could not be written, or None for any other error."""
    if not root.is_dir():
        return "it was removed while it was written"
    name = getattr(error, "filename", None)
    if isinstance(name, str) and not Path(name).is_relative_to(root):
        return None
    return refusal_of_disk(error)


def _verified_inputs(order: WorkOrder, store: Store) -> dict[str, Product]:
    products = {name: store.verify(*address) for name, address in order.inputs.items()}
    damaged = [f"{order.inputs[name][0]}/{order.inputs[name][1]}" for name, found in products.items() if found is None]
    if damaged:
        raise InputError(
            f"{order.name}: its input {damaged[0]} was removed or damaged while the run was "
            "going on; run again to rebuild it"
        )
    return {name: product for name, product in products.items() if product is not None}


def _make(order: WorkOrder, store: Store) -> Product:
    _require_room(order)
    task, inputs = order.task, _verified_inputs(order, store)
    started = datetime.now(UTC)
    logging.captureWarnings(True)
    with store.building(task.stage.name, order.key) as folder:
        with Usage() as usage:
            notes = task.given({name: product.path for name, product in inputs.items()}).make(folder)
        own = made_with(task)
        record = {
            "stage": task.stage.name,
            "stage_version": task.stage.version,
            "key": order.key,
            "label": task.label,
            "settings": plain(task.settings),
            "inputs": order.inputs,
            "notes": notes,
            "temporary": task.temporary,
            "calstudy": __version__,
            "made_with": own,
            "lineage": lineage(own, [product.record["lineage"] for product in inputs.values()]),
            "git_commit": git_commit(),
            "processor": processor(),
            "libraries": libraries(),
            "started": started.isoformat(timespec="seconds"),
            "seconds": round(usage.seconds, 3),
            "cpu_seconds": round(usage.cpu_seconds, 3),
            "peak_memory_bytes": usage.peak_memory,
        }
        return store.seal(folder, record)
