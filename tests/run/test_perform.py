"""Making one product: mistakes of a user end in a sentence, defects in a traceback, and neither in a hanging run."""

import errno
import logging
import socket
import subprocess
import sys
import traceback
from dataclasses import replace
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import pytest
from number_task import Number, run

from calstudy.base.errors import DiskError, ExperimentError, InputError
from calstudy.base.resources import Cost
from calstudy.base.user_code import UserCodeError, load_file
from calstudy.run import execution
from calstudy.run.execution import Lifetimes, WorkOrder, largest_disk, perform, schedule
from calstudy.run.store import Lease, Store, products
from calstudy.run.task import Task

EXIT_INPUT = 2


class Newer(Number, stage="number", version=2):
    """The same in a later version."""


class Sized(Number, stage="number"):
    """A number of a known size."""

    def _cost(self) -> Cost:
        return Cost(1, disk=100.0)


def failing(error: BaseException, label: str) -> Task:
    """Return a task that raises an error after it has written a file."""

    class Failing(Task, stage="failing"):
        def make(self, output: Path) -> dict:
            (output / "half").write_text("half")
            raise error

    return Failing(label)


@pytest.fixture
def store(tmp_path) -> Store:
    found = Store(tmp_path / "store")
    found.prepare()
    return found


def test_a_product_is_made_from_its_inputs_and_pieces_and_recorded(store):
    first = Number("first", number=1)
    piece = Number("piece", number=20)
    total = Number("total", number=300, needed={"first": first}, piece=piece)
    run(total, store)
    product = store.verify("number", total.key)
    assert (product.path / "number").read_text() == "321"
    assert product.record["notes"] == {"number": 321}
    assert product.record["inputs"] == {"first": ["number", first.key], "piece": ["number", piece.key]}
    assert product.record["stage_version"] == 1


class Warned(Task, stage="warned"):
    """A stage whose code logs warnings."""

    warnings: tuple[str, ...]

    def make(self, output: Path) -> dict:
        logger = logging.getLogger("calstudy.power.spectra")
        for text in ("left out", "left out", "flagged"):
            logger.warning(text)
        logger.info("crossing")
        other = Thread(target=logger.warning, args=("of another thread",))
        other.start()
        other.join()
        return {"number": 1, "warnings": self.warnings} if self.warnings else {"number": 1}


def test_warnings_that_the_package_logs_are_in_the_record(store):
    for task, expected in (
        (Warned("one", warnings=()), ["left out", "flagged"]),
        (Warned("two", warnings=("own",)), ["own", "left out", "flagged"]),
    ):
        run(task, store)
        assert store.verify("warned", task.key).record["notes"] == {"number": 1, "warnings": expected}


class Copied(Task, stage="copied"):
    """A copy of a file."""

    source: Path

    def make(self, output: Path) -> dict:
        (output / "copy").write_bytes(self.source.read_bytes())
        return {}


@pytest.mark.parametrize("change", [lambda path: path.write_text("changed"), Path.unlink])
def test_a_file_that_changes_after_the_plan_gives_no_product(store, tmp_path, change):
    source = tmp_path / "data"
    source.write_text("as planned")
    task = Copied("copy", source=source)
    order = WorkOrder.of(task, store)
    change(source)
    with pytest.raises((InputError, FileNotFoundError)) as found:
        perform(order)
    assert isinstance(found.value, FileNotFoundError) or "was changed or removed while the run" in str(found.value)
    assert store.find("copied", task.key) is None
    source.write_text("as planned")
    assert (perform(order).path / "copy").read_text() == "as planned"


def test_a_product_of_an_older_version_is_not_found_and_left_alone(store):
    old = Number("total", number=1)
    run(old, store)
    new = Newer("total", number=1)
    plan = schedule([new], store)
    assert (plan.todo, plan.damaged) == ((new,), ())
    run(new, store)
    assert all(store.verify("number", task.key) is not None for task in (old, new))
    assert schedule([new], store).todo == ()


def test_a_store_that_can_only_be_read_keeps_its_temporary_products(store, monkeypatch):
    piece = Number("piece", number=20, temporary=True)
    total = Number("total", number=300, piece=piece)
    run(total, store)

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patched:
        patched.setattr(Store, "discard", refuse)
        Lease(store).drop(Lifetimes([total], ()).unused())
    assert store.find("number", piece.key) is not None
    Lease(store).drop(Lifetimes([total], ()).unused())
    assert store.find("number", piece.key) is None
    assert store.find("number", total.key) is not None


def chain(*, temporary: bool) -> tuple[Task, Task, Task, Task]:
    """Return a product, two that are made from it, and one that is made from these two."""
    data = Number("data", number=1, temporary=temporary)
    halves = [Number(f"half {value}", number=value, needed={"data": data}, temporary=temporary) for value in (2, 3)]
    return data, halves[0], halves[1], Number("total", number=0, needed={"a": halves[0], "b": halves[1]})


def test_a_kept_product_without_an_intact_record_is_made_again_for_its_warnings(store):
    """Of four products, the total is what a run is for, and the first half is damaged."""
    data, half, _, total = chain(temporary=False)
    run(total, store)
    assert schedule([total], store).todo == ()
    path = store.folder("number", half.key) / "product.json"
    path.write_text(path.read_text().replace('"number": 3', '"number": 4'))
    plan = schedule([total], store)
    assert plan.todo == plan.damaged == (half,)
    run(total, store)
    assert schedule([total], store).todo == ()
    assert store.verify("number", half.key).record["notes"] == {"number": 3}
    # What is not there at all was removed by somebody, who had finished with it.
    store.discard("number", data.key)
    assert schedule([total], store).todo == ()


def test_a_temporary_product_is_dropped_after_the_last_task_that_needs_it_and_not_before(store):
    *_, total = chain(temporary=True)
    todo = schedule([total], store).todo
    lifetimes = Lifetimes([total], todo)
    assert lifetimes.unused() == []
    dropped = {task.label: {item.label for item in lifetimes.after(task)} for task in todo}
    assert dropped == {"data": set(), "half 2": set(), "half 3": {"data"}, "total": {"half 2", "half 3"}}


def test_a_run_that_was_interrupted_drops_nothing_that_it_still_needs(store):
    """With the first half made, the data stay for the second; with the total made, nothing is needed any more."""
    data, first, second, total = chain(temporary=True)
    run(first, store)
    todo = schedule([total], store).todo
    assert todo == (second, total)
    assert Lifetimes([total], todo).unused() == []
    run(total, store)
    Lease(store).drop(Lifetimes([total], schedule([total], store).todo).unused())
    assert all(store.find("number", task.key) is None for task in (data, first, second))
    assert schedule([total], store).todo == ()


def test_a_product_that_another_part_of_the_run_keeps_is_not_temporary(store):
    kept, fleeting = chain(temporary=False), chain(temporary=True)
    run(kept[-1], store)
    for targets in ([kept[-1], fleeting[-1]], [fleeting[-1], kept[-1]]):
        assert Lifetimes(targets, ()).unused() == []


def test_a_product_that_another_run_made_to_be_kept_is_not_dropped(store):
    kept, fleeting = chain(temporary=False), chain(temporary=True)
    run(kept[1], store)
    run(fleeting[-1], store)
    Lease(store).drop(Lifetimes([fleeting[-1]], ()).unused())
    found = [store.find("number", task.key) is not None for task in fleeting]
    # Data and first half were made to be kept, the second half was not; the total is not temporary.
    assert found == [True, True, False, True]


def test_a_temporary_product_that_a_later_run_keeps_is_not_dropped(store):
    """A run that was interrupted has made the first half as a temporary product; it resumes after another run."""
    kept, fleeting = chain(temporary=False), chain(temporary=True)
    run(fleeting[1], store)
    Lifetimes([kept[1]], ()).keep_found(store)
    run(fleeting[-1], store)
    Lease(store).drop(Lifetimes([fleeting[-1]], ()).unused())
    found = [store.verify("number", task.key) is not None for task in kept]
    assert found == [True, True, False, True]


def test_the_disk_of_a_plan_counts_what_is_there_at_one_time(store):
    pieces = [Sized(f"piece {index}", number=index, temporary=True) for index in range(5)]
    reduced = [Sized(f"reduced {index}", number=1, needed={"piece": piece}) for index, piece in enumerate(pieces)]
    # One piece at a time, beside what was reduced before and is being reduced.
    assert largest_disk(reduced, schedule(reduced, store).todo) == 100 * 6


@pytest.mark.parametrize("error", [ValueError("index 3 is wrong"), KeyError("gains"), TypeError("no"), LookupError()])
def test_a_defect_of_a_stage_reaches_the_caller_as_it_is_with_its_traceback(store, error):
    task = failing(error, "defect")
    with pytest.raises(type(error)) as caught:
        run(task, store)
    assert type(caught.value) is type(error)
    assert str(caught.value) == str(error)
    assert "make" in [frame.name for frame in traceback.extract_tb(caught.value.__traceback__)]


@pytest.mark.parametrize(
    "error",
    [
        InputError("sky.eor.seed = 3: no"),
        ExperimentError(["a: no", "b: no"]),
        UserCodeError("own.py line 3, in calibrate: ValueError: no"),
    ],
)
def test_a_refusal_of_a_stage_passes_as_it_is(store, error):
    with pytest.raises(InputError) as caught:
        run(failing(error, "refusal"), store)
    assert (type(caught.value), str(caught.value)) == (type(error), str(error))


def test_what_failed_leaves_no_product_and_no_lock(store):
    task = failing(ValueError("no"), "defect")
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            perform(WorkOrder.of(task, store))
    assert not store.exists("failing", task.key)
    assert list((store.root / "failing").iterdir()) == []


def test_an_input_that_vanished_is_told_in_a_sentence(store):
    first = Number("first", number=1)
    with pytest.raises(InputError, match=r"number \(second\): its input number/\w+ was removed or damaged"):
        perform(WorkOrder.of(Number("second", number=2, needed={"first": first}), store))


def flip_a_digit(store: Store, task: Task) -> None:
    """Damage a product that keeps its size, as a disk does."""
    path = store.folder("number", task.key) / "number"
    path.write_text(str(9 - int(path.read_text())))


def test_what_is_damaged_after_the_plan_is_read_by_nobody_and_made_again(store):
    first = Number("first", number=1)
    second = Number("second", number=2, needed={"first": first})
    for task in (first, second):
        perform(WorkOrder.of(task, store))
    flip_a_digit(store, second)
    assert (perform(WorkOrder.of(second, store)).path / "number").read_text() == "3"
    flip_a_digit(store, first)
    with pytest.raises(InputError, match=r"number \(third\): its input number/\w+ was removed or damaged"):
        perform(WorkOrder.of(Number("third", number=3, needed={"first": first}), store))


PROGRAM = """
import os, resource, signal, sys
from pathlib import Path
from calstudy.base.errors import InputError
from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.store import Store
from calstudy.run.task import Task

def leave(output):
    sys.exit(3)

def interrupt(output):
    raise KeyboardInterrupt

def require_path(output):
    assert "PYTHONSAFEPATH" not in os.environ
    return {{}}

def write_much(output):
    (output / "much").write_bytes(bytes(10**6))
    return {{}}

def write_hdf5(output):
    import h5py
    with h5py.File(output / "much.h5", "w") as file:
        file["much"] = list(range(10**5))
    return {{}}

class Held:
    def __del__(self, touch=Path("freed").touch):
        touch()

held = []

def hold(output):
    held.append(Held())
    return {{}}

class Made(Task, stage="stage"):
    def make(self, output):
        return {make}(output)

def limit():
    # Longer files cannot be written, whoever asks: EFBIG, as on a full disk.
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10**5, 10**5))

if __name__ == "__main__":
    store = Store(Path("store"))
    store.prepare()
    {before}
    tasks = schedule([Made("label")], store).todo
    try:
        execute(tasks, store, Workers({workers}, Path("run.log")))
    except InputError as error:
        print(error)
        sys.exit(2)
"""


def program(
    folder: Path, make: str, workers: int = 1, before: str = "", name: str = "program.py"
) -> subprocess.CompletedProcess:
    """Run a stage in a process of its own, which must end by itself."""
    (folder / name).write_text(PROGRAM.format(make=make, workers=workers, before=before))
    command = [sys.executable, name]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False, timeout=120)


@pytest.mark.parametrize(("make", "workers"), [("leave", 1), ("leave", 2), ("interrupt", 1), ("interrupt", 2)])
def test_a_stage_that_exits_ends_the_run_with_a_traceback(tmp_path, make, workers):
    result = program(tmp_path, make, workers)
    assert result.returncode == 1
    assert "RuntimeError: stage (label): the process was told to exit" in result.stderr
    assert f"in {make}" in result.stderr


@pytest.mark.chain
def test_workers_take_no_file_of_the_working_folder_for_a_module_of_python(tmp_path):
    (tmp_path / "signal.py").write_text("raise ImportError('not this one')")
    (tmp_path / "code").mkdir()
    result = program(tmp_path, "require_path", workers=2, name="code/program.py")
    assert result.returncode == 0, result.stderr
    assert "not this one" not in result.stderr


@pytest.mark.chain
def test_workers_end_at_once_and_do_not_free_what_libraries_hold(tmp_path):
    result = program(tmp_path, "hold", workers=2)
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "freed").exists()


DYING = """
import os, signal, time
from pathlib import Path
from calstudy.run import execution
from calstudy.run.execution import Lifetimes, Workers, execute, schedule
from calstudy.run.store import Lease
from calstudy.run.store import Store
from calstudy.run.task import Input, Task

class Made(Task, stage="stage"):
    name: str
    data: Input = None

    def make(self, output):
        with open("made", "a") as log:
            log.write(self.name + " ")
        if self.name == "last" and not Path("died").exists():
            Path("died").touch()
            time.sleep(1)
            os.kill(os.getpid(), signal.SIGKILL)
        return {}

if __name__ == "__main__":
    store = Store(Path("store"))
    store.prepare()
    data = Made("data", name="data", temporary=True)
    result = Made("result", name="result", data=data)
    last = Made("last", name="last", data=result)
    todo = schedule([last], store).todo
    lifetimes = Lifetimes([last], todo)
    execute(todo, store, Workers(2, Path("run.log")), lambda task, product: Lease(store).drop(lifetimes.after(task)))
    print(store.find("stage", last.key) is not None, store.find("stage", data.key) is None)
"""


@pytest.mark.chain
def test_what_a_dead_worker_had_made_is_not_made_again(tmp_path):
    """A worker is killed once while it makes the last product; the temporary data were dropped before."""
    (tmp_path / "program.py").write_text(DYING)
    command = [sys.executable, "program.py"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, timeout=120)
    assert result.stdout.split() == ["True", "True"], result.stderr
    assert (tmp_path / "made").read_text().split() == ["data", "result", "last", "last"]


KILLING = """
import os, signal, time
from pathlib import Path
from calstudy.base.errors import InputError
from calstudy.run.execution import Workers, execute
from calstudy.run.store import Store
from calstudy.run.task import Task

def task(name):
    class Made(Task, stage=name):
        def make(self, output):
            time.sleep(0.2)
            if self.stage.name == "guilty":
                os.kill(os.getpid(), signal.SIGKILL)
            return {}
    return Made("label")

if __name__ == "__main__":
    store = Store(Path("store"))
    store.prepare()
    names = ["first", "second", "third", "guilty"]
    try:
        execute([task(name) for name in names], store, Workers(2, Path("run.log")))
    except InputError as error:
        print(error)
"""


@pytest.mark.chain
def test_the_product_that_kills_its_worker_is_named(tmp_path):
    (tmp_path / "program.py").write_text(KILLING)
    command = [sys.executable, "program.py"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, timeout=120)
    assert result.stdout.startswith("guilty (label): its worker process died repeatedly"), result.stderr


def test_what_a_worker_began_last_is_known_by_its_address(store):
    with execution._local_client(1, store.root / "run.log") as client:
        for name in ("first", "last"):
            order = WorkOrder.of(Number(name, number=len(name)), store)
            client.submit(execution._announce_and_perform, order).result()
        (address,) = client.scheduler_info()["workers"]
        assert execution._last_begun(client, address) == "number (last)"
        assert execution._last_begun(client, "tcp://elsewhere:1") is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"source": "0"}, "other code of calstudy"),
        ({"versions": {"numpy": "1.0"}}, r"numpy missing \(here 1.0\)"),
        ({"files": {"pyradiosky/gleam.vot": "0"}}, "another file pyradiosky/gleam.vot"),
    ],
)
def test_a_worker_with_other_code_makes_nothing(change, sentence, store):
    """It would make products whose keys are those of another program."""
    order = WorkOrder.of(Number("first", number=1), store)
    other = replace(order, made_with={**order.made_with, **change})
    with pytest.raises(InputError, match=rf"^number \(first\): the worker on {socket.gethostname()} has {sentence}; "):
        perform(other)
    assert not list(products(store))
    assert perform(order).path.is_dir()


@pytest.mark.parametrize("make", ["write_much", "write_hdf5"])
def test_a_product_that_cannot_be_written_is_told_in_a_sentence(tmp_path, make):
    result = program(tmp_path, make, before="limit()")
    assert result.returncode == EXIT_INPUT, result.stderr
    assert result.stdout.startswith(f"outputs.store = '{tmp_path / 'store'}': stage (label) could not be written (")
    assert "make room or choose another folder" in result.stdout
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(("total", "spare", "made"), [(1e12, 101, True), (1e12, 99, False), (0, 99, True)])
def test_a_product_is_made_only_where_its_disk_has_room(total, spare, made, store, monkeypatch):
    """HDF5 crashes at some of the places where a write can fail, before anybody can say why."""
    task = Sized("sized", number=1)
    disk = SimpleNamespace(total=total, free=execution.SPARE + spare)
    monkeypatch.setattr(execution.shutil, "disk_usage", lambda path: disk)
    order = WorkOrder.of(task, store)
    if made:
        perform(order)
    else:
        with pytest.raises(DiskError, match=r"number \(sized\) could not be written \(No space left on device\); make"):
            perform(order)
    assert (store.verify("number", task.key) is not None) is made


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_only_files_of_the_store_are_taken_for_it(store, number, tmp_path):
    inside, outside = (OSError(number, "no", str(folder / "file")) for folder in (store.root, tmp_path))
    with pytest.raises(InputError, match=r"outputs\.store"):
        perform(WorkOrder.of(failing(inside, "inside"), store))
    with pytest.raises(OSError, match="no") as caught:
        perform(WorkOrder.of(failing(outside, "outside"), store))
    assert caught.value is outside


def test_a_full_disk_is_one_for_products_of_users_files_as_well(store, tmp_path):
    (tmp_path / "own.py").write_text(
        "import errno\nfrom calstudy.run.task import Task\n\n\nclass Own(Task, stage='own'):\n"
        "    def make(self, output):\n        raise OSError(errno.ENOSPC, 'full', str(output / 'file'))\n"
    )
    with pytest.raises(
        DiskError, match=r"outputs\.store = .*: own \(\) could not be written \(No space left on device\)"
    ):
        perform(WorkOrder.of(load_file(tmp_path / "own.py").Own(""), store))
