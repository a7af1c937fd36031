"""Make the missing products of an experiment as a dask graph, on this machine or on a cluster."""

from __future__ import annotations

import atexit
import errno
import logging
import os
import re
import shutil
import socket
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from graphlib import TopologicalSorter
from importlib import import_module
from numbers import Integral
from pathlib import Path
from threading import get_ident
from typing import TYPE_CHECKING, Any

from pydantic_core import to_jsonable_python

from calstudy import __version__
from calstudy.base.errors import DiskError, InputError, refusal_of_disk
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.quiet import errors_written_to, write_errors_to
from calstudy.base.resources import Usage, cores, free_memory, parse_memory
from calstudy.base.user_code import user_code
from calstudy.run.provenance import git_commit, libraries, lineage, made_with, of_other_code, processor
from calstudy.run.store import Product, Store, keep
from calstudy.run.task import Task, unique

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

logger = logging.getLogger(__name__)

SPARE = 10e6
"""Bytes that must be free beside the estimated size of a product before it is made."""


@dataclass(frozen=True, kw_only=True)
class WorkOrder:
    """A task without the tasks behind it, as sent to a worker, and what the one who sends it would make it with.

    `content` is the identity of its settings in the plan, `disk` the estimated size of the product in bytes.
    """

    task: Task
    key: str
    inputs: Mapping[str, tuple[str, str]]
    store: Path
    again: bool
    made_with: Mapping[str, Any]
    content: Any
    disk: float

    @classmethod
    def of(cls, task: Task, store: Store, again: bool = False) -> WorkOrder:
        """Return the order for `task`; with `again`, its product is made even if it exists."""
        inputs = {name: (needed.stage.name, needed.key) for name, needed in task.needs.items()}
        return cls(
            task=task.given({name: name for name in inputs}),
            key=task.key,
            inputs=inputs,
            store=store.root,
            again=again,
            made_with=made_with(task),
            content=task.content,
            disk=task.cost.disk,
        )

    @property
    def name(self) -> str:
        """The stage and the label of the product."""
        return f"{self.task.stage.name} ({self.task.label})"


def perform(order: WorkOrder, warn: Callable[[str], None] = logger.warning) -> Product:
    """Make the ordered product, or return it if another run has made it meanwhile.

    Raises InputError if the worker has other code, an input was removed or damaged, the stage refuses a value, or the
    store cannot be written, or a user's code fails. Any other error of a stage is a bug, and passes with its traceback.
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
        with store.lock(order.task.stage.name, order.key, warn):
            existing = store.verify(order.task.stage.name, order.key)
            if existing is not None and not (order.again and _is_of_other_code(existing, order, store)):
                return existing
            return _make(order, store)
    except InputError:
        raise
    except (SystemExit, KeyboardInterrupt) as error:
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
    """Raise DiskError if a product has no room on the disk, where HDF5 would crash when it closes a file."""
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
    """Return why a file of the store could not be written, or None for any other error."""
    if not root.is_dir():
        return "it was removed while it was written"
    name = getattr(error, "filename", None)
    if isinstance(name, str) and not Path(name).is_relative_to(root):
        return None
    return refusal_of_disk(error)


def _verified_inputs(order: WorkOrder, store: Store) -> dict[str, Product]:
    products = {}
    for name, (stage, key) in order.inputs.items():
        if (product := store.verify(stage, key)) is None:
            raise InputError(
                f"{order.name}: its input {stage}/{key} was removed or damaged while the run was going on; run again "
                "to rebuild it"
            )
        products[name] = product
    return products


def _is_of_other_code(product: Product, order: WorkOrder, store: Store) -> bool:
    """Whether another run has not made the product again, by this code and from inputs as they are now."""
    inputs = [product.record["lineage"] for product in _verified_inputs(order, store).values()]
    return bool(product.record["lineage"] != lineage(order.made_with, inputs))


class _Collector(logging.Handler):
    """Keeps the warnings that are logged in one thread."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.thread = get_ident()
        self.sentences: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the text of a record."""
        if record.thread == self.thread:
            self.sentences.append(record.getMessage())


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the warnings that the package logs in this thread within the block."""
    collector, package = _Collector(), logging.getLogger("calstudy")
    package.addHandler(collector)
    try:
        yield collector.sentences
    finally:
        package.removeHandler(collector)


def _make(order: WorkOrder, store: Store) -> Product:
    from threadpoolctl import threadpool_limits

    _require_room(order)
    task, inputs = order.task, _verified_inputs(order, store)
    started = datetime.now(UTC)
    logging.captureWarnings(True)
    with store.building(task.stage.name, order.key) as folder:
        # Most products of matrices are many and small: threads in each cost more than they gain.
        one_thread, users = threadpool_limits(limits=1, user_api="blas"), user_code(disk_passes=True)
        with Usage() as usage, _warnings() as found, one_thread, users:
            notes = task.given({name: product.path for name, product in inputs.items()}).make(folder)
        if found:
            notes = {**notes, "warnings": [*notes.get("warnings", ()), *dict.fromkeys(found)]}
        _require_unchanged(order)
        own = made_with(task)
        record = {
            "stage": task.stage.name,
            "stage_version": task.stage.version,
            "key": order.key,
            "label": task.label,
            "settings": to_jsonable_python(task.settings),
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


def _require_unchanged(order: WorkOrder) -> None:
    """Raise InputError if a file that was read is not the one of the plan, which the product's key names."""
    try:
        unchanged = identity(order.task.settings) == order.content
    except FileNotFoundError:
        unchanged = False
    if not unchanged:
        raise InputError(
            f"{order.name}: a file that it reads was changed or removed while the run was going on; run again when the "
            "file is complete"
        )


BEGUN, WAITS = "begun", "waits"
"""Topics under which workers report to the scheduler the products that they begin, and their waits for locks."""


@dataclass(frozen=True)
class Schedule:
    """Tasks to make, every one after its inputs, with those of damaged products and the keys of what is made again."""

    todo: tuple[Task, ...]
    damaged: tuple[Task, ...]
    again: frozenset[str]


@dataclass(frozen=True)
class Budget:
    """Resources of a run.

    Without a number of workers there is one for each core within the memory; `max_memory` of all workers together is
    such as "6 GB", by default all that is free. That of a running dask scheduler is not checked. A `strict` run also
    makes products of other code or other versions of packages again.
    """

    workers: int | None = None
    max_memory: str | None = None
    scheduler: str | None = None
    strict: bool = False

    def __post_init__(self) -> None:
        if self.workers is not None and not (isinstance(self.workers, Integral) and self.workers >= 1):
            raise InputError(
                f"workers = {self.workers!r}: must be a whole number of at least 1, or None for one per core"
            )
        if self.max_memory is not None and not isinstance(self.max_memory, str):
            raise InputError(f"max_memory = {self.max_memory!r}: must be a text with a unit, such as '6 GB'")
        named, address = str(self.scheduler), r"(\w+://)?\S+:\d+|inproc://\S+"
        # Of a name that is too long, Path.is_file raises OSError.
        is_file = os.path.isfile(named)  # noqa: PTH113
        if self.scheduler is not None and not re.fullmatch(address, named) and not is_file:
            raise InputError(
                f"scheduler = {self.scheduler!r}: must be an address, such as 'tcp://host:8786', or the scheduler file "
                "that a running dask cluster wrote"
            )

    @property
    def memory(self) -> float:
        """Memory of all workers together, bytes."""
        return free_memory() if self.max_memory is None else parse_memory(self.max_memory)


@dataclass(frozen=True)
class Workers:
    """The processes that make the products: `count` of this machine, or those of a running dask scheduler.

    With one, the work is done in this process. They append their standard error to the file `log`. `scheduler` is an
    address, or the file that has it.
    """

    count: int
    log: Path
    scheduler: str | None = None


def found_of(tasks: Iterable[Task], store: Store) -> dict[str, Product]:
    """Return the existing products of tasks by key, without reading their files."""
    products = {task.key: store.find(task.stage.name, task.key) for task in tasks}
    return {key: product for key, product in products.items() if product is not None}


def without_record(targets: Sequence[Task], store: Store) -> list[Task]:
    """Return the targets, and kept inputs, whose folders have no intact record: a run would lose their warnings."""
    kept = [task for task in unique(targets) if not task.temporary]
    found = found_of(kept, store)
    return [task for task in kept if task.key not in found and store.exists(task.stage.name, task.key)]


def schedule(
    targets: Sequence[Task], store: Store, given: Container[str] = (), strict: bool = False, quick: bool = False
) -> Schedule:
    """Find the tasks to make: the targets and all that they need, but those intact in the store, or with `given` keys.

    Those of `without_record` are made again, and with `strict` products of other code or other versions of packages. A
    `quick` look reads no files of products, and misses damaged ones behind what is intact.
    """
    other: Container[str] = ()
    if strict:
        tasks = unique(targets)
        other = of_other_code(tasks, found_of(tasks, store))
    look, lost = (store.find, []) if quick else (store.verify, without_record(targets, store))
    again: set[str] = set()
    todo: dict[str, Task] = {}
    intact: set[str] = set()
    damaged: list[Task] = []

    def visit(task: Task) -> None:
        if task.key in todo or task.key in intact or task.key in given:
            return
        product = look(task.stage.name, task.key)
        if product is not None and task.key not in other:
            intact.add(task.key)
            return
        if product is not None:
            again.add(task.key)
        elif store.exists(task.stage.name, task.key):
            damaged.append(task)
        for needed in task.needs.values():
            visit(needed)
        todo[task.key] = task

    for task in (*targets, *lost):
        visit(task)
    return Schedule(tuple(todo.values()), tuple(damaged), frozenset(again))


def _set_up_worker(log: Path) -> None:
    """Prepare a process of this machine for orders."""
    write_errors_to(log)
    # It was for the start of this process, and not for what users' code starts.
    os.environ.pop("PYTHONSAFEPATH", None)
    # Orders need it when they arrive, in one thread, and stages in another: two threads that import it at once can lock
    # each other out (`_frozen_importlib._DeadlockError`).
    import_module("astropy.units")
    # Python would free the objects of all libraries one by one, which takes seconds; products are files.
    atexit.register(os._exit, 0)


@contextmanager
def _local_client(workers: int, log: Path) -> Iterator[Client]:
    """Start workers on this machine: one thread of this process, or several processes that share the cores."""
    import dask
    from distributed import Client

    threads = str(max(1, cores() // workers))
    environment = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TF_NUM_INTRAOP_THREADS"), threads)
    settings = {
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.admin.tick.limit": "10 m",
        # Nobody looks at dask's own profile and load; every 10 ms, and 500 ms, they take time from the work.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.system-monitor.interval": "10 s",
        "distributed.worker.memory.terminate": False,
        "distributed.comm.timeouts.connect": "60 s",
        "distributed.scheduler.allowed-failures": 2,
    }
    with (
        dask.config.set(settings),
        # The thread that works here may be at another product when the run ends, and closes last.
        errors_written_to(log) if workers == 1 else nullcontext(),
        _cluster(workers) as cluster,
        Client(cluster) as client,
    ):
        if workers > 1:
            client.run(_set_up_worker, log)
        yield client


def _cluster(workers: int) -> LocalCluster:
    from distributed import LocalCluster

    # A new process would take signal.py of the working folder for Python's own, before it has the path of this one.
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=workers > 1,
            memory_limit=0,
            # The scheduler serves HTTP in any case: to this machine only, on any free port.
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        # Worker processes import the script, and would run it again.
        raise InputError(
            "worker processes cannot be started; in a Python script, put what runs studies below `if __name__ == "
            f'"__main__":`, or use workers=1 ({error})'
        ) from None
    finally:
        os.environ.pop("PYTHONSAFEPATH", None)


def _client(workers: Workers) -> AbstractContextManager[Client]:
    if workers.scheduler is None:
        return _local_client(workers.count, workers.log)
    from distributed import Client

    path = Path(workers.scheduler)
    address = {"scheduler_file": str(path)} if path.is_file() else {"address": workers.scheduler}
    try:
        return Client(**address)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"--scheduler {workers.scheduler}: cannot connect ({error})") from None


def _announce_and_perform(order: WorkOrder) -> Product:
    """Report to the scheduler, which outlives this process, the product that this worker begins, and make it."""
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(BEGUN, {"worker": worker.address, "product": order.name})
    return perform(order, lambda text: worker.log_event(WAITS, text))


def _last_begun(client: Client, worker: str) -> str | None:
    """Return the product that a dead worker was making, if the worker had reported it."""
    begun = [event["product"] for _, event in client.get_events(BEGUN) or () if event["worker"] == worker]
    return begun[-1] if begun else None


def execute(
    tasks: Sequence[Task],
    store: Store,
    workers: Workers,
    done: Callable[[Task, Product], None] = lambda task, product: None,
    warn: Callable[[str], None] = logger.warning,
    again: Container[str] = (),
) -> dict[str, Product]:
    """Make the products of `tasks`, and return them by key.

    Tasks are from `schedule`, ordered so that each follows its inputs. `done` is called after each product, and `warn`
    with a sentence for each wait for the lock of another run. Products with keys in `again` are made even if they
    exist. Raises InputError as `perform`, and if the scheduler cannot be reached or is lost, or a worker dies
    repeatedly.
    """
    products: dict[str, Product] = {}
    if not tasks:
        return products
    from distributed import as_completed

    by_key, places = {task.key: task for task in tasks}, {task.key: place for place, task in enumerate(tasks)}
    # The scheduler does not know the dependencies. If a worker dies, its current product is made again, but not its
    # earlier ones: products are files, and temporary ones may have been removed.
    inputs = {task.key: [need.key for need in task.needs.values()] for task in tasks}
    order = TopologicalSorter({key: [need for need in needs if need in places] for key, needs in inputs.items()})
    order.prepare()

    def ready(client: Client) -> dict[Future, Task]:
        """Submit the tasks whose inputs are all made, each once."""
        futures = {}
        for key in order.get_ready():
            task = by_key[key]
            future = client.submit(
                _announce_and_perform,
                WorkOrder.of(task, store, key in again),
                key=f"{task.stage.name}-{key}-{digest_json(str(store.root))[:8]}",
                priority=-places[key],
                pure=False,
            )
            futures[future] = task
        return futures

    with _client(workers) as client, _end_announced(workers, warn):
        client.subscribe_topic(WAITS, lambda event: warn(event[1]))
        futures = ready(client)
        completed = as_completed(futures)
        for future in completed:
            task = futures.pop(future)
            products[task.key] = product = _result(future, task, client, workers)
            # Otherwise the client would compute this result again if its worker dies.
            future.release()
            order.done(task.key)
            started = ready(client)
            futures |= started
            completed.update(started)
            done(task, product)
    return products


@contextmanager
def _end_announced(workers: Workers, warn: Callable[[str], None]) -> Iterator[None]:
    """Say what an interrupted run waits for: a process ends at once, and a thread of this one when its work is done."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        if workers.count == 1 and workers.scheduler is None:
            warn("the run ends when the product that it is making, or waits for, is finished")
        raise


def _result(future: Future, task: Task, client: Client, workers: Workers) -> Product:
    """Return a product that a worker has made; raises InputError if a process was lost."""
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        # All tasks that were assigned to the worker fail, not only the one that it was making.
        begun = _last_begun(client, error.last_worker.address) or f"{task.stage.name} ({task.label})"
        raise InputError(
            f"{begun}: its worker process died repeatedly, for want of memory or by a crash of code that it "
            "runs; use fewer --workers, or smaller chunks, and run again: finished products are kept"
        ) from None
    except CancelledError:
        where = "" if workers.scheduler is None else f"--scheduler {workers.scheduler}: "
        raise InputError(
            f"{where}the dask scheduler was lost before {task.stage.name} ({task.label}) was made; run again: "
            "finished products are kept"
        ) from None


class Lifetimes:
    """Lifetimes of the products of a run that all of its tasks call temporary: until the last task that needs them."""

    def __init__(self, targets: Iterable[Task], todo: Sequence[Task]) -> None:
        # Also different tasks that make the same product.
        tasks = unique(targets, by=id)
        self._kept = {task.key: task for task in tasks if not task.temporary}
        self._temporary = {task.key: task for task in tasks if task.key not in self._kept}
        self._users = dict.fromkeys(self._temporary, 0)
        for task in todo:
            for key in self._needed_by(task):
                self._users[key] += 1

    def _needed_by(self, task: Task) -> set[str]:
        return {needed.key for needed in task.needs.values()} & self._temporary.keys()

    def keep_found(self, store: Store) -> None:
        """Make temporary products of other runs stay if this run keeps them."""
        for product in found_of(self._kept.values(), store).values():
            if product.record.get("temporary"):
                keep(product)

    def unused(self) -> list[Task]:
        """Return the tasks of temporary products that no remaining task needs."""
        return [self._temporary[key] for key, count in self._users.items() if count == 0]

    def after(self, task: Task) -> list[Task]:
        """Count a task as made; return the tasks of temporary products that no remaining task needs any more."""
        needed = self._needed_by(task)
        for key in needed:
            self._users[key] -= 1
        return [self._temporary[key] for key in needed if self._users[key] == 0]


def largest_disk(targets: Iterable[Task], todo: Sequence[Task]) -> float:
    """Estimate the largest total size, in bytes, of the products of a run at one time, if it follows its order."""
    lifetimes, sizes = Lifetimes(targets, todo), {task.key: task.cost.disk for task in todo}
    held = largest = 0.0
    for task in todo:
        held += sizes[task.key]
        largest = max(largest, held)
        held -= sum(sizes.get(dropped.key, 0.0) for dropped in lifetimes.after(task))
    return largest
