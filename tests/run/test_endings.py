"""How runs end that somebody or something ends: with a sentence, a status of their own, and a line in the log."""

import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml
from command_line import run_command
from filelock import FileLock
from number_task import Number, run
from rich.console import Console
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.run import store as store_module
from calstudy.run.execution import Workers, WorkOrder, execute, perform, schedule
from calstudy.run.store import Lease, Store, leftovers, products
from calstudy.run.task import Task
from calstudy.studies import study
from calstudy.studies.folder import LOG, log_to, open_folder

KEY = "0" * 32


@pytest.fixture
def store(tmp_path) -> Store:
    found = Store(tmp_path / "store")
    found.prepare()
    return found


def test_a_wait_for_a_lock_names_who_holds_it_and_ends(store, monkeypatch):
    monkeypatch.setattr(store_module, "SILENT_WAIT", 0.05)
    monkeypatch.setattr(store_module, "LONGEST_WAIT", 0.1)
    told = []
    who = f"process {os.getpid()} on {socket.gethostname()}"
    with store.lock("stage", KEY, told.append):
        assert told == []
        refused = pytest.raises(InputError, match=f"was held for .* by {who}; end that process")
        with refused, store.lock("stage", KEY, told.append):
            pass
    assert told == [f"stage {KEY}: waits for the lock {store.root / '.locks'}/stage-{KEY}.lock, held by {who}"]
    with store.lock("stage", KEY):
        pass


def test_a_wait_of_a_worker_is_told_to_the_run(store, monkeypatch):
    monkeypatch.setattr(store_module, "SILENT_WAIT", 0.05)
    task, told = Number("wanted", number=1), []
    lock = FileLock(store.root / ".locks" / f"number-{task.key}.lock", thread_local=False)
    (store.root / ".locks").mkdir()
    lock.acquire()

    def tell(text: str) -> None:
        told.append(text)
        lock.release()

    execute(schedule([task], store).todo, store, Workers(1, store.root / "log"), warn=tell)
    assert told[0].startswith(f"number {task.key}: waits for the lock")


def test_what_another_run_made_meanwhile_is_not_counted_as_made(store, monkeypatch):
    first, second = Number("first", number=1), Number("second", number=2)
    plan = study.schedule

    def planned(targets, *arguments, **named):
        found = plan(targets, *arguments, **named)
        run(first, store)
        return found

    monkeypatch.setattr(study, "schedule", planned)
    made = study.make([first, second], store, Workers(1, store.root / "log"), Console(quiet=True))
    assert made.tasks == (second,)
    assert made.products.keys() == {first.key, second.key}


def test_a_file_system_without_locks_is_refused(store, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.ENOSYS, "not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(InputError, match="its file system has no locks"), store.lock("stage", KEY):
        pass


def test_a_worker_without_the_store_says_so_and_where_it_is(tmp_path):
    order = WorkOrder.of(Number("label", number=1), Store(tmp_path / "elsewhere"))
    with pytest.raises(InputError, match=f"the worker on {socket.gethostname()} has no such folder"):
        perform(order)


class Wait(Task, stage="wait"):
    begun: str

    def make(self, output: Path) -> dict:
        Path(self.begun).touch()
        time.sleep(60)
        return {}


def test_a_lost_scheduler_ends_the_run_with_a_sentence(store, tmp_path):
    code = (
        "from distributed import LocalCluster\nimport time\n"
        "with LocalCluster(n_workers=1, processes=False, protocol='tcp', dashboard_address=None) as cluster:\n"
        "    print(cluster.scheduler_address, flush=True)\n    time.sleep(120)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment) as cluster:
        address, begun = cluster.stdout.readline().strip(), tmp_path / "begun"

        def kill() -> None:
            while not begun.exists():
                time.sleep(0.05)
            cluster.kill()

        killer = threading.Thread(target=kill, daemon=True)
        killer.start()
        task = Wait("long", begun=str(begun))
        try:
            with pytest.raises(InputError, match=f"--scheduler {address}: the dask scheduler was lost before wait"):
                execute([task], store, Workers(1, tmp_path / "log", address))
        finally:
            cluster.kill()


def test_what_killed_runs_left_is_listed_and_deleted_and_no_product(store, capsys, monkeypatch):
    task = Number("whole", number=1)
    run(task, store)
    [whole] = products(store)
    for name in (f".building-{KEY}-ab", f".discarded-{KEY}-cd"):
        folder = store.root / "number" / name
        folder.mkdir()
        (folder / "product.json").write_text((whole.path / "product.json").read_text())
        (folder / "number").write_text("1")
    assert [item.path.name for item in leftovers(store)] == [f".building-{KEY}-ab", f".discarded-{KEY}-cd"]
    assert [product.path for product in products(store)] == [whole.path]
    assert run_command(capsys, "store", store.root) == (0, "")
    assert run_command(capsys, "store", store.root, "--delete", "--older-than", "1h") == (0, "")
    assert len(leftovers(store)) == 2
    later = time.time() + 7200
    monkeypatch.setattr("calstudy.run.store.time.time", lambda: later)
    assert run_command(capsys, "store", store.root, "--delete", "--older-than", "1h") == (0, "")
    assert leftovers(store) == []
    assert [product.path for product in products(store)] == [whole.path]


def test_what_a_run_is_filling_is_not_deleted_as_left_over(store, capsys, monkeypatch):
    """A product may be written at its end only: an old folder is no proof of a killed run."""
    with Lease(store).holding([KEY]), store.building("number", KEY) as folder:
        later = time.time() + 7200
        monkeypatch.setattr("calstudy.run.store.time.time", lambda: later)
        assert run_command(capsys, "store", store.root, "--delete", "--older-than", "1h") == (0, "")
        assert folder.is_dir()


def test_leftovers_of_publishing_are_removed_from_run_folders(tmp_path):
    figures = tmp_path / "figures"
    figures.mkdir()
    old, new, other = (figures / name for name in (f".a.pdf-{KEY}", f".b.pdf-{KEY}", ".hidden"))
    for path in (old, new, other):
        path.touch()
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    open_folder(tmp_path, ())
    assert [path.exists() for path in (old, new, other)] == [False, True, True]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (None, "INFO calstudy.studies.folder: ended with status 0"),
        (InputError("not allowed"), "ERROR calstudy.studies.folder: ended with status 2: not allowed"),
        (KeyboardInterrupt(), "ERROR calstudy.studies.folder: ended with status 130: KeyboardInterrupt"),
        (ZeroDivisionError("division"), "ERROR calstudy.studies.folder: ended with status 1: division"),
    ],
)
def test_the_log_says_how_a_run_ended(error, line, tmp_path):
    def end() -> None:
        with log_to(tmp_path / LOG):
            if error is not None:
                raise error

    if error is None:
        end()
    else:
        with pytest.raises(type(error)):
            end()
    assert (tmp_path / LOG).read_text().rstrip().endswith(line)


def test_sigterm_ends_a_run_as_an_interrupt_with_a_status_of_its_own(tmp_path):
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    command = [sys.executable, "-m", "calstudy", "run", "study.yaml", "--workers", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, text=True, env=environment, **pipes) as process:
        while process.poll() is None and not list(tmp_path.glob("store/*/.building-*")):
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        said, message = process.communicate(timeout=120)
    assert process.returncode == 143
    assert message.strip() == "calstudy: terminated; what is in the store is kept, and a run goes on from there"
    assert "the run ends when the product that it is making, or waits for, is finished" in said
    [log] = tmp_path.glob(f"runs/*/{LOG}")
    assert "ended with status 143: SIGTERM" in log.read_text()


@pytest.mark.parametrize("content", ["null", "[1]", '[{"verdict": "PA', '[{"section": "x"}]', "", "{}"])
def test_damaged_claims_are_named(content, tmp_path):
    from calstudy.report.headline import read_headline
    from calstudy.results.reader import RunFolder

    (tmp_path / "manifest.json").write_text(json.dumps({"name": "study"}))
    (tmp_path / "claims.json").write_text(content)
    with pytest.raises(InputError, match=r"claims.json: is damaged; write it again: calstudy claims"):
        read_headline(RunFolder(tmp_path))
    (tmp_path / "claims.json").write_text(json.dumps([]))
    assert read_headline(RunFolder(tmp_path)) == []
