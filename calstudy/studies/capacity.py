"""Fit a run to the machine: the number of workers and of chunks of the simulations for the available memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Self, TypeVar

from calstudy.base.errors import InputError
from calstudy.base.plugins import guarded
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, cores, total_memory
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import size_of_instrument
from calstudy.products.calibration import CalibrateChunk
from calstudy.products.simulation import SimulateChunk
from calstudy.run.execution import Budget, schedule
from calstudy.run.store import Store
from calstudy.run.task import Task

WORKERS_PER_CORE, LEAST_LIMIT = 4, 16
"""Limits of the number of workers, of which more than cores wait for each other."""
ABSURD = 10
"""Data larger than this many times the memory are refused; a finished run of smaller ones may still be drawn."""


File = TypeVar("File", bound=Any)
"""The content of a file: an `Experiment`, or measured data, which have no section `simulation`."""


def fit(file: File, budget: Budget, targets: Callable[[File], Sequence[Task]]) -> tuple[File, int]:
    """Choose the number of workers, and cut simulations into enough chunks for them, within the memory.

    The number of chunks of a simulation changes its visibilities by less than the tolerance of their interpolation, and
    does not change their key in the store. The result is the file, perhaps with more `simulation.chunks` and a
    calibrator that needs less memory, and the number of workers, which is the requested one if no memory was given.
    Raises InputError if a single task is estimated to need more memory than there is.
    """
    if budget.scheduler is not None:
        return file, budget.workers or 1
    _require_sane(budget)
    # The parent process has the libraries in memory, too.
    memory = budget.memory - LIBRARIES_MEMORY
    hoped = budget.workers or cores()
    lean = _stream(_cut(_Work(file, targets, budget.strict), memory / hoped), memory / hoped)
    return lean.file, _workers(lean.missing, memory, hoped, budget)


def require_data_fit(experiment: Experiment, budget: Budget) -> None:
    """Raise InputError if the data alone exceed the memory by far, before `fit`, which takes long for absurd sizes."""
    samples = size_of_instrument(experiment.instrument).samples
    need = samples * COMPLEX128
    if budget.scheduler is None and need > ABSURD * budget.memory:
        raise InputError(
            f"the data have {samples:.3g} samples, which take {need / 1e9:,.1f} GB, and there are "
            f"{budget.memory / 1e9:.1f} GB of memory; use fewer antennas, channels or integrations"
        )


def _workers(missing: Sequence[Task], memory: float, hoped: int, budget: Budget) -> int:
    """Return how many workers fit into the memory, of those hoped for; raises InputError if not even one does."""
    if not missing:
        return budget.workers or hoped
    largest = max(missing, key=lambda task: task.cost.memory)
    need, source = largest.cost.memory, "--max-memory leaves" if budget.max_memory else "this machine has"
    if need > memory:
        more = "give it more with --max-memory, or " if need < total_memory() else ""
        raise InputError(
            f"{source} {max(memory, 0) / 1e9:.1f} GB of memory for work, but {largest.stage.name} ({largest.label}) "
            f"needs about {need / 1e9:.1f} GB; {more}use fewer antennas, channels, integrations or sources"
        )
    if budget.workers is not None and budget.max_memory is None:
        return budget.workers
    return min(hoped, max(1, int(memory // need)))


def _require_sane(budget: Budget) -> None:
    """Raise InputError if the number of workers exceeds the limit for this machine."""
    most = max(LEAST_LIMIT, WORKERS_PER_CORE * cores())
    if budget.workers is not None and budget.workers > most:
        raise InputError(
            f"--workers {budget.workers}: at most {most} are allowed on this machine, which has {cores()} processor "
            "core(s); leave it out for one per core"
        )


@dataclass(frozen=True)
class _Work(Generic[File]):
    """A file, and the tasks that a run would have to make for it; a `strict` one makes those of other code again."""

    file: File
    targets: Callable[[File], Sequence[Task]]
    strict: bool

    @cached_property
    def missing(self) -> Sequence[Task]:
        """The tasks, from a quick look at the store."""
        store = Store(self.file.outputs.store)
        return schedule(self.targets(self.file), store, strict=self.strict, quick=True).todo

    def largest(self, kind: type[Task]) -> float:
        """Return the memory of the largest missing product of a kind; zero if none is missing."""
        return max((task.cost.memory for task in self.missing if isinstance(task, kind)), default=0.0)

    def changed(self, **sections: Any) -> Self:
        return replace(self, file=self.file.model_copy(update=sections))


def _cut(work: _Work[File], share: float) -> _Work[File]:
    """Double the number of simulation chunks until each needs no more than its share, or they are single channels."""
    while isinstance(work.file, Experiment) and (largest := work.largest(SimulateChunk)) > share:
        simulation, channels = work.file.simulation, work.file.instrument.channels.count
        if simulation.chunks >= channels:
            break
        chunks = min(2 * simulation.chunks, channels)
        finer = work.changed(simulation=simulation.model_copy(update={"chunks": chunks}))
        if finer.largest(SimulateChunk) > 0.95 * largest:
            break  # The sky itself takes the rest.
        work = finer
    return work


def _stream(work: _Work[File], share: float) -> _Work[File]:
    """Let the calibrator use less memory until a solve needs no more than its share."""
    while work.largest(CalibrateChunk) > share:
        calibration = work.file.calibration
        with guarded(calibration):
            leaner = calibration.with_less_memory()
        if leaner is None:
            break
        work = work.changed(calibration=leaner)
    return work
