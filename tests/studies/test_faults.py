"""Faults: whatever happens to a run, it ends as an undisturbed one, or says in a sentence what to do."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from fault_runs import REFUSED, differences, finish, results, start, study

from calstudy.experiment.files import validate
from calstudy.run.execution import schedule
from calstudy.run.store import RECORD, Store
from calstudy.studies.kinds.experiment import ExperimentStudy

NOBODY = 65534

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    assert finish(start(folder)) == 0
    return folder


def copy_of(folder: Path, target: Path) -> Path:
    """Return a copy of a finished study; keys do not depend on where it is."""
    shutil.copytree(folder / "store", target / "store", dirs_exist_ok=True)
    return target


def products(folder: Path) -> list[Path]:
    return sorted(path.parent for path in (folder / "store").glob(f"*/*/{RECORD}"))


def largest_file(product: Path) -> Path:
    return max((path for path in product.iterdir() if path.name != RECORD), key=lambda path: path.stat().st_size)


def test_a_run_killed_inside_a_solve_and_after_it_ends_as_if_it_had_not_been(undisturbed, tmp_path):
    folder = copy_of(undisturbed, tmp_path)
    for stage in ("calibrate-chunk", "calibrate", "average", "power", "spectra", "figure"):
        shutil.rmtree(folder / "store" / stage)
    for place in ("inside", "after"):
        assert finish(start(folder, death=("calibrate-chunk", place))) == -signal.SIGKILL
    assert finish(start(folder)) == 0
    assert differences(results(undisturbed), results(folder)) == []
    assert not list(folder.glob("store/*/.building-*"))


@contextmanager
def disk_at(folder: Path) -> Iterator[Path]:
    """Mount a file system of its own at a folder that is not there yet."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=100m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("cannot mount a file system here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder: Path, options: str) -> None:
    """Change the options of a mounted file system."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def test_a_full_disk_is_told_in_a_sentence_and_the_run_resumed_elsewhere_is_right(undisturbed, tmp_path):
    with disk_at(tmp_path / "store") as store:
        copy_of(undisturbed, tmp_path)
        for stage in ("corrupt", "average", "power", "spectra", "figure"):
            shutil.rmtree(store / stage)
        used = shutil.disk_usage(store).used
        remount(store, f"size={used + 200_000}")
        assert finish(start(tmp_path)) == REFUSED
        message = (tmp_path / "message").read_text()
        assert "No space left on device" in message
        assert "make room or choose another folder" in message
        remount(store, "size=100m")
        assert finish(start(tmp_path)) == 0
        assert differences(results(undisturbed), results(tmp_path)) == []


def test_a_run_killed_in_every_stage_and_at_every_boundary_ends_as_if_it_had_not_been(undisturbed, tmp_path):
    tiny_study = ExperimentStudy(validate(study(tmp_path), tmp_path))
    store = Store(tmp_path / "store")
    deaths = 0

    def left() -> list[str]:
        return [task.stage.name for task in schedule(tiny_study.targets, store).todo]

    for stage in dict.fromkeys(left()):
        for place in ("inside", "after"):
            if stage not in left():
                continue  # Made by a run that died later; a temporary product may be gone again.
            assert finish(start(tmp_path, death=(stage, place))) == -signal.SIGKILL, (stage, place)
            deaths += 1
    assert deaths > 20
    assert finish(start(tmp_path)) == 0
    assert differences(results(undisturbed), results(tmp_path)) == []
    assert not list(tmp_path.glob("store/*/.building-*"))


@pytest.mark.parametrize("damage", ["bit flip", "truncated", "empty", "missing", "record"])
def test_no_figure_is_drawn_from_a_damaged_product(damage, undisturbed, tmp_path):
    folder = copy_of(undisturbed, tmp_path)
    for product in products(folder):
        path = largest_file(product)
        content = path.read_bytes()
        if damage == "bit flip":
            changed = bytearray(content)
            changed[len(content) // 2] ^= 4
            path.write_bytes(changed)
        elif damage == "truncated":
            path.write_bytes(content[: len(content) // 2])
        elif damage == "empty":
            path.write_bytes(b"")
        elif damage == "missing":
            path.unlink()
        else:
            (product / RECORD).write_text((product / RECORD).read_text()[:-20])
    assert finish(start(folder)) == 0
    assert differences(results(undisturbed), results(folder)) == []


def test_two_runs_at_once_on_one_store_are_both_right(undisturbed, tmp_path):
    both = [start(tmp_path), start(tmp_path)]
    assert [finish(process) for process in both] == [0, 0]
    assert differences(results(undisturbed), results(tmp_path)) == []


def test_workers_killed_in_mid_solve_are_replaced(undisturbed, tmp_path):
    process = start(tmp_path, workers=2)
    building = tmp_path / "store" / "calibrate-chunk"
    deadline = time.monotonic() + 600
    while not (building.exists() and list(building.glob(".building-*"))):
        assert time.monotonic() < deadline
        assert process.exitcode is None
        time.sleep(0.02)
    workers = [
        child
        for child in psutil.Process(process.pid).children(recursive=True)
        if "spawn_main" in " ".join(child.cmdline())
    ]
    assert workers
    for worker in workers:
        worker.kill()
    assert finish(process) == 0
    assert differences(results(undisturbed), results(tmp_path)) == []


def readable_by_all(folder: Path) -> None:
    """Let another user read the store and write the runs and the message, but not the store."""
    if os.geteuid() != 0:
        pytest.skip("needs another user, who may not write")
    for directory in (folder, *folder.parents[:2]):
        directory.chmod(0o755)
    (folder / "message").touch()
    (folder / "runs").mkdir(exist_ok=True)
    (folder / "message").chmod(0o666)
    (folder / "runs").chmod(0o777)


def test_a_read_only_store_is_told_in_a_sentence(undisturbed, tmp_path):
    copy_of(undisturbed, tmp_path)
    shutil.rmtree(tmp_path / "store" / "spectra")
    readable_by_all(tmp_path)
    assert finish(start(tmp_path, user=NOBODY)) == REFUSED
    message = (tmp_path / "message").read_text()
    assert "outputs.store" in message
    assert "cannot be written (Permission denied)" in message


def test_a_read_only_disk_that_holds_everything_is_enough_and_one_that_does_not_is_told(undisturbed, tmp_path):
    with disk_at(tmp_path / "store") as store:
        copy_of(undisturbed, tmp_path)
        remount(store, "ro")
        assert finish(start(tmp_path)) == 0
        assert differences(results(undisturbed), results(tmp_path)) == []
        remount(store, "rw")
        shutil.rmtree(store / "spectra")
        remount(store, "ro")
        assert finish(start(tmp_path)) == REFUSED
        assert "cannot be written (Read-only file system)" in (tmp_path / "message").read_text()


def test_a_folder_of_runs_that_cannot_be_written_is_told_in_a_sentence(undisturbed, tmp_path):
    copy_of(undisturbed, tmp_path)
    readable_by_all(tmp_path)
    (tmp_path / "runs").chmod(0o755)
    assert finish(start(tmp_path, user=NOBODY)) == REFUSED
    assert "outputs.runs" in (tmp_path / "message").read_text()
