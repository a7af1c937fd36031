"""Runs of the tiny study in processes of their own, that die or fail where they are told to."""

from __future__ import annotations

import multiprocessing
import os
import signal
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
from tiny import tiny

HEAVY = ["calstudy.products.simulation", "calstudy.products.calibration", "calstudy.figures", "hera_pspec"]
REFUSED = 2


def study(folder: Path) -> dict:
    """Return the tiny study with its store and runs in a folder."""
    return tiny(folder)


def die_at(stage: str, place: str) -> None:
    """Make this process kill itself inside the first product of a stage that it makes, or right after it is sealed."""
    from calstudy.run.store import Store

    seal = Store.seal

    def deadly(self, folder, record):
        here = record["stage"] == stage
        if here and place == "inside":
            # The stage's files are written; the record is not.
            os.kill(os.getpid(), signal.SIGKILL)
        product = seal(self, folder, record)
        if here:
            os.kill(os.getpid(), signal.SIGKILL)
        return product

    Store.seal = deadly


def run_in(
    folder: Path,
    workers: int = 1,
    death: tuple[str, str] | None = None,
    user: int | None = None,
) -> None:
    """Run the study; exit with the status of the command line, the sentence in `folder`/message."""
    from calstudy.base.errors import InputError
    from calstudy.experiment.files import validate
    from calstudy.studies.kinds.experiment import ExperimentStudy
    from calstudy.studies.study import Budget, run_study

    if user is not None:
        os.setgid(user)
        os.setuid(user)
    if death is not None:
        die_at(*death)
    try:
        run_study(ExperimentStudy(validate(study(folder), folder)), Budget(workers))
    except InputError as error:
        (folder / "message").write_text(str(error))
        os._exit(REFUSED)


def start(folder: Path, **options) -> BaseProcess:
    """Start `run_in` in a process that has the libraries already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(HEAVY)
    process = context.Process(target=run_in, args=(folder,), kwargs=options)
    process.start()
    return process


def finish(process: BaseProcess, timeout: float = 600) -> int:
    """Wait for a run; return its exit code."""
    process.join(timeout)
    assert process.exitcode is not None, "the run hangs"
    return process.exitcode


def results(folder: Path) -> dict[str, np.ndarray]:
    """Return all arrays of all figures of the one run in a folder."""
    (run,) = (folder / "runs").iterdir()
    found = {}
    for path in sorted((run / "figures").glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            found |= {f"{path.stem}.{name}": file[name] for name in file.files}
    return found


def differences(mine: dict[str, np.ndarray], its: dict[str, np.ndarray], relative: float = 1e-10) -> list[str]:
    """Return the names of arrays that differ by more than this times their largest value."""
    if mine.keys() != its.keys():
        return sorted(mine.keys() ^ its.keys())
    return [name for name, array in mine.items() if not _equal(array, its[name], relative)]


def _equal(mine: np.ndarray, its: np.ndarray, relative: float) -> bool:
    if mine.dtype.kind not in "fc":
        return np.array_equal(mine, its)
    if mine.shape != its.shape or not np.array_equal(np.isfinite(mine), np.isfinite(its)):
        return False
    finite = np.isfinite(mine)
    scale = np.abs(mine[finite]).max(initial=0)
    return bool(np.abs(mine[finite] - its[finite]).max(initial=0) <= relative * scale)
