"""Runs that share a store: the last one that needs a temporary product removes it, and killed runs do not count."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from calstudy.base.resources import Cost
from calstudy.run.execution import Lifetimes, Workers, execute, schedule
from calstudy.run.store import LEASE_LOCK, Lease, Store, needed_by_runs
from calstudy.run.task import Piece, Task, unique


class Number(Task, stage="number"):
    number: int
    data: Piece = None

    def make(self, output: Path) -> Mapping[str, Any]:
        (output / "number.txt").write_text(str(self.number))
        return {}

    def _cost(self) -> Cost:
        return Cost(1)


DATA = Number("data", number=1, temporary=True)

HOLD = """
import sys, time
from pathlib import Path
from calstudy.run.store import Lease
from calstudy.run.store import Store

with Lease(Store(Path(sys.argv[1]))).holding([sys.argv[2]]):
    print("held", flush=True)
    time.sleep(600)
"""


def total(number: int) -> Task:
    """Return what one member of an array makes from the data that all have in common."""
    return Number(f"total {number}", number=number, data=DATA)


@pytest.fixture
def store(tmp_path):
    found = Store(tmp_path / "store")
    found.prepare()
    return found


def run(target: Task, store: Store, lease: Lease) -> None:
    todo = schedule([target], store).todo
    lifetimes = Lifetimes([target], todo)
    lease.drop(lifetimes.unused())
    execute(todo, store, Workers(1, store.root / "run.log"), lambda task, _: lease.drop(lifetimes.after(task)))


def needed(store: Store) -> set[str]:
    with store.lock(*LEASE_LOCK):
        return needed_by_runs(store)


def keys(target: Task) -> list[str]:
    return [task.key for task in unique([target])]


def test_the_last_run_that_needs_a_temporary_product_removes_it(store):
    first, second = Lease(store), Lease(store)
    with second.holding(keys(total(20))):
        with first.holding(keys(total(10))):
            run(total(10), store, first)
            # The other run has not begun.
            assert store.find("number", DATA.key) is not None
        assert needed(store) == set(keys(total(20)))
        run(total(20), store, second)
        assert store.find("number", DATA.key) is None
    assert needed(store) == set()
    assert list((store.root / ".runs").iterdir()) == []
    assert all(store.verify("number", total(number).key) is not None for number in (10, 20))


def test_a_run_alone_removes_what_it_needs_no_more(store):
    lease = Lease(store)
    with lease.holding(keys(total(10))):
        run(total(10), store, lease)
        assert store.find("number", DATA.key) is None
        # The file of its lock goes with it, and that of what is kept stays.
        locks = {path.name for path in (store.root / ".locks").iterdir()}
        assert locks == {f"number-{total(10).key}.lock", "-".join(LEASE_LOCK) + ".lock"}


def test_a_run_that_was_killed_does_not_count(store):
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, store.root, DATA.key], stdout=subprocess.PIPE, text=True, cwd=Path(store.root)
    )
    with other:
        assert other.stdout.readline() == "held\n"
        assert needed(store) == {DATA.key}
        lease = Lease(store)
        with lease.holding(keys(total(10))):
            run(total(10), store, lease)
        assert store.find("number", DATA.key) is not None
        other.kill()
    assert needed(store) == set()
    lease = Lease(store)
    with lease.holding(keys(total(20))):
        run(total(20), store, lease)
    assert store.find("number", DATA.key) is None
    assert list((store.root / ".runs").iterdir()) == []
