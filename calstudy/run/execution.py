"""Run the tasks of an experiment that are not done yet, as a dask graph, on this machine or on a cluster."""

from __future__ import annotations

import atexit
import logging
import os
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from calstudy.base import ranks
from calstudy.base.errors import InputError
from calstudy.base.identity import digest_json
from calstudy.base.resources import cores
from calstudy.run.perform import WorkOrder, perform
from calstudy.run.provenance import of_other_code
from calstudy.run.store import Product, Store
from calstudy.run.task import Task, unique

if TYPE_CHECKING:
    from distributed import Client, Future

logger = logging.getLogger(__name__)

BEGUN, WAITS = "begun", "waits"
"""Topics under which workers report to the scheduler what they begin to make, and for whose lock they wait."""


@dataclass(frozen=True)
class Schedule:
    """Which tasks of a run must be made, and which products are there already.

    Attributes
    ----------
    todo
        Tasks to make, every one after its inputs.
    ready
        Products that the run needs and that are intact.
    damaged
        Tasks whose product was there, but not as it was written; they are in `todo`.
    again
        Keys of intact products of other code that are to be made again; their tasks are in `todo`.
    """

    todo: tuple[Task, ...]
    ready: dict[str, Product]
    damaged: tuple[Task, ...]
    again: frozenset[str]


@dataclass(frozen=True)
class Workers:
    """The processes that make the products.

    Attributes
    ----------
    count
        Worker processes to start on this machine; with one, the work is done in this process.
    log
        File to which worker processes of this machine append what they write to standard error.
    scheduler
        Address of a running dask scheduler whose workers to use instead, or None.
    """

    count: int
    log: Path
    scheduler: str | None = None


def found_of(tasks: Iterable[Task], store: Store) -> dict[str, Product]:
    """Return the products of tasks that are in a store, by key, without reading their files."""
    products = {task.key: store.find(task.stage.name, task.key) for task in tasks}
    return {key: product for key, product in products.items() if product is not None}


def schedule(targets: Sequence[Task], store: Store, given: Container[str] = (), strict: bool = False) -> Schedule:
    """Find out what must be made: the targets and what they need, as far as it is not in the store, intact.

    Parameters
    ----------
    targets
        What is wanted.
    store
        Where it is looked for.
    given
        Keys of products that will be there.
    strict
        Whether products that are of other code or other versions of packages are made again.
    """
    other: Container[str] = ()
    if strict:
        tasks = unique(targets)
        other = of_other_code(tasks, found_of(tasks, store))
    again: set[str] = set()
    todo: dict[str, Task] = {}
    ready: dict[str, Product] = {}
    damaged: list[Task] = []

    def visit(task: Task) -> None:
        if task.key in todo or task.key in ready or task.key in given:
            return
        product = store.verify(task.stage.name, task.key)
        if product is not None and task.key not in other:
            ready[task.key] = product
            return
        if product is not None:
            again.add(task.key)
        elif store.exists(task.stage.name, task.key):
            damaged.append(task)
        for needed in task.needs.values():
            visit(needed)
        todo[task.key] = task

    for task in targets:
        visit(task)
    return Schedule(tuple(todo.values()), ready, tuple(damaged), frozenset(again))


def _write_errors_to(path: Path) -> None:
    """Append what this process and its libraries write to standard error to a file from now on."""
    with path.open("a") as file:
        os.dup2(file.fileno(), 2)


@contextmanager
def _errors_written_to(path: Path) -> Iterator[None]:
    """Append what is written to standard error within the block to a file."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        _write_errors_to(path)
        yield
    finally:
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)


def _set_up_worker(log: Path) -> None:
    """Prepare a process of this machine for orders."""
    _write_errors_to(log)
    # Orders need it when they arrive, in one thread, and stages in another: two threads that import it at once can lock
    # each other out (`_frozen_importlib._DeadlockError`).
    import_module("astropy.units")
    # Python would free the objects of all libraries one by one, which takes seconds; products are files.
    atexit.register(os._exit, 0)


@contextmanager
def _local_client(workers: int, log: Path) -> Iterator[Client]:
    """Start workers on this machine: a thread of this process if there is one, else processes that share the cores."""
    import dask
    from distributed import Client, LocalCluster

    threads = str(max(1, cores() // workers))
    environment = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TF_NUM_INTRAOP_THREADS"), threads)
    settings = {
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.admin.tick.limit": "10 m",
        "distributed.worker.memory.terminate": False,
        "distributed.comm.timeouts.connect": "60 s",
        "distributed.scheduler.allowed-failures": 2,
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=workers > 1,
            memory_limit=0,
            # The scheduler serves HTTP in any case: to this machine only, on any free port.
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        if workers > 1:
            client.run(_set_up_worker, log)
        with _errors_written_to(log) if workers == 1 else nullcontext():
            yield client


@contextmanager
def _client(workers: Workers) -> Iterator[Client]:
    if workers.scheduler is None:
        with _local_client(workers.count, workers.log) as client:
            yield client
        return
    from distributed import Client

    try:
        client = Client(workers.scheduler, timeout="20 s")
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {workers.scheduler}: cannot connect ({error})") from None
    with client:
        yield client


def _announce_and_perform(order: WorkOrder) -> Product:
    """Tell the scheduler, which outlives this process, what this worker begins to make; and make it."""
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(BEGUN, {"worker": worker.address, "product": f"{order.stage.name} ({order.label})"})
    return perform(order, lambda text: worker.log_event(WAITS, text))


def _last_begun(client: Client, worker: str) -> str | None:
    """Return what a worker that died was making, if word of it had reached the scheduler."""
    begun = [event["product"] for _, event in client.get_events(BEGUN) or () if event["worker"] == worker]
    return begun[-1] if begun else None


class _Queue:
    """Hands tasks to the workers, each once all that it needs is made.

    The scheduler knows of no dependencies. If a worker dies, what it was making is made again, but not what it had made
    before: products are files, and temporary ones may have been dropped.
    """

    def __init__(self, tasks: Sequence[Task], store: Store, client: Client, again: Container[str]) -> None:
        self._store, self._client, self._again = store, client, again
        self._priority = {task.key: -place for place, task in enumerate(tasks)}
        self._tasks = {task.key: task for task in tasks}
        self._missing = {
            task.key: {needed.key for needed in task.needs.values()} & self._tasks.keys() for task in tasks
        }
        self._users: dict[str, list[str]] = {task.key: [] for task in tasks}
        for key, missing in self._missing.items():
            for needed in missing:
                self._users[needed].append(key)

    def first(self) -> dict[Future, Task]:
        """Submit the tasks that need nothing."""
        return self._submit(key for key, missing in self._missing.items() if not missing)

    def after(self, task: Task) -> dict[Future, Task]:
        """Submit the tasks that needed nothing but this one any more."""
        users = self._users[task.key]
        for key in users:
            self._missing[key].discard(task.key)
        return self._submit(key for key in users if not self._missing[key])

    def _submit(self, keys: Iterable[str]) -> dict[Future, Task]:
        return {self._future(self._tasks[key]): self._tasks[key] for key in keys}

    def _future(self, task: Task) -> Future:
        return self._client.submit(
            _announce_and_perform,
            WorkOrder.of(task, self._store, task.key in self._again),
            key=f"{task.stage.name}-{task.key}-{digest_json(str(self._store.root))[:8]}",
            priority=self._priority[task.key],
            pure=False,
        )


def execute(
    tasks: Sequence[Task],
    store: Store,
    workers: Workers,
    done: Callable[[Task, Product], None] = lambda task, product: None,
    told: Callable[[str], None] = logger.warning,
    again: Container[str] = (),
) -> dict[str, Product]:
    """Make the products of `tasks`, which are in an order that respects their inputs.

    Parameters
    ----------
    tasks
        From `schedule`.
    store
        Where they go; on a file system that all workers share.
    workers
        Who does the work.
    done
        Called after each product.
    told
        Called with a sentence for each wait for the lock of another run.
    again
        Keys of products that are made even if they are there.

    Returns
    -------
    dict
        The products by key.

    Raises
    ------
    InputError
        If the scheduler cannot be reached or is lost, a worker dies repeatedly, or a stage refuses its input.
    """
    products: dict[str, Product] = {}
    if not tasks:
        return products
    if ranks.count() > 1:
        return _execute_here(tasks, store, done, again)
    from distributed import CancelledError, KilledWorker, as_completed

    with _client(workers) as client:
        client.subscribe_topic(WAITS, lambda event: told(event[1]))
        queue = _Queue(tasks, store, client, again)
        futures = queue.first()
        completed = as_completed(futures)
        for future in completed:
            task = futures.pop(future)
            try:
                product = future.result()
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
            # The client would have a result that it holds computed again if its worker dies.
            future.release()
            products[task.key] = product
            started = queue.after(task)
            futures |= started
            completed.update(started)
            done(task, product)
    return products


def _execute_here(
    tasks: Sequence[Task], store: Store, done: Callable[[Task, Product], None], again: Container[str]
) -> dict[str, Product]:
    """Make products one after the other in the main thread, where MPI may be used."""
    products = {}
    for task in tasks:
        products[task.key] = perform(WorkOrder.of(task, store, task.key in again))
        done(task, products[task.key])
    return products


class Lifetimes:
    """How long each temporary product of a run is needed: until the last task that needs it is made.

    Parameters
    ----------
    targets
        What the run is for. A product is temporary if all tasks that make it say so.
    todo
        The tasks that the run makes, from `schedule`.
    """

    def __init__(self, targets: Iterable[Task], todo: Sequence[Task]) -> None:
        tasks = _all_tasks(targets)
        kept = {task.key for task in tasks if not task.temporary}
        self._temporary = {task.key: task for task in tasks if task.key not in kept}
        self._users = dict.fromkeys(self._temporary, 0)
        for task in todo:
            for key in self._needed_by(task):
                self._users[key] += 1

    def _needed_by(self, task: Task) -> set[str]:
        return {needed.key for needed in task.needs.values()} & self._temporary.keys()

    def unused(self) -> list[Task]:
        """Return the temporary products that no task needs that is still to be made."""
        return [self._temporary[key] for key, count in self._users.items() if count == 0]

    def after(self, task: Task) -> list[Task]:
        """Count a task as made; return the temporary products that it was the last to need."""
        needed = self._needed_by(task)
        for key in needed:
            self._users[key] -= 1
        return [self._temporary[key] for key in needed if self._users[key] == 0]


def _all_tasks(targets: Iterable[Task]) -> list[Task]:
    """Return targets and all that they need; tasks that make the same product are all among them."""
    found: dict[int, Task] = {}
    waiting = list(targets)
    while waiting:
        task = waiting.pop()
        if id(task) not in found:
            found[id(task)] = task
            waiting += task.needs.values()
    return list(found.values())


def drop(tasks: Iterable[Task], store: Store) -> None:
    """Remove the products of tasks, as far as they are there and were made as temporary ones.

    What another run made to be kept stays, and so does everything in a store that can only be read.
    """
    for task in tasks:
        product = store.find(task.stage.name, task.key)
        if product is not None and product.record.get("temporary"):
            with suppress(OSError):
                store.discard(task.stage.name, task.key)


def largest_disk(targets: Iterable[Task], todo: Sequence[Task]) -> float:
    """Return the most bytes that the products of a run are estimated to hold at once, if it goes in its order."""
    lifetimes, sizes = Lifetimes(targets, todo), {task.key: task.cost.disk for task in todo}
    held = largest = 0.0
    for task in todo:
        held += sizes[task.key]
        largest = max(largest, held)
        held -= sum(sizes.get(dropped.key, 0.0) for dropped in lifetimes.after(task))
    return largest
