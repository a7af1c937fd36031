"""Fit a run to the machine: how many workers, and how finely the simulations are cut, for the memory there is."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from calstudy.calibrate.memory import LEAST_MODELS
from calstudy.errors import InputError
from calstudy.experiment.model import Experiment
from calstudy.graph.estimates import LIBRARIES_MEMORY, estimate
from calstudy.graph.tasks import Graph, Task
from calstudy.resources import cores, free_memory
from calstudy.running import ranks
from calstudy.running.store import Store

Targets = Callable[[Graph], Sequence[Task]]
"""Which products of an experiment are wanted."""

BYTES = {"MB": 1e6, "GB": 1e9, "TB": 1e12}
SHARED_STAGE = "simulate-chunk"
"""The stage whose pieces may be made smaller without changing its results."""
STREAMED_STAGE = "calibrate-chunk"
"""The stage that may work on fewer baselines at a time without changing its results."""


def _whole_run(graph: Graph) -> Sequence[Task]:
    return graph.targets


def parse_memory(text: str) -> float:
    """Return the bytes that a text such as ``6 GB`` or ``500MB`` stands for.

    Raises
    ------
    InputError
        If it is not a positive number with one of the units MB, GB, TB.
    """
    found = re.fullmatch(r"\s*([0-9.]+)\s*([MGT]B)\s*", text)
    try:
        number = float(found[1]) * BYTES[found[2]] if found else 0.0
    except ValueError:
        number = 0.0
    if number <= 0:
        raise InputError(f"--max-memory {text!r}: write a positive number and a unit (MB, GB or TB), such as '6 GB'")
    return number


def fit(
    experiment: Experiment,
    workers: int | None,
    max_memory: str | None,
    scheduler: str | None = None,
    targets: Targets = _whole_run,
) -> tuple[Experiment, int]:
    """Choose the number of workers, and cut simulations finely enough for them, within the memory.

    How many chunks a simulation is cut into changes its visibilities by rounding only, and not the key under which
    they are stored.

    Parameters
    ----------
    experiment
        Validated.
    workers
        Wanted number of worker processes, or None for one per core as far as the memory goes.
    max_memory
        What all workers together may take, such as "6 GB", or None for what is free now.
    scheduler
        Address of a cluster, whose memory is not looked at, or None.
    targets
        Which products are to be made, by default all that a run is for.

    Returns
    -------
    experiment
        The same, perhaps with more `simulation.chunks` and fewer `calibration.models_at_once`.
    workers
        Not more than the memory holds; those that were asked for, if no memory was given.

    Raises
    ------
    InputError
        If a single task is estimated to need more than there is, `max_memory` is not an amount of memory, or MPI ranks
        cannot help; before anything has started.
    """
    if ranks.count() > 1:
        _require_sharing(experiment, workers, scheduler)
    if scheduler is not None:
        return experiment, workers or 1
    memory = free_memory() if max_memory is None else parse_memory(max_memory)
    # The parent process holds the libraries, too.
    budget = memory - LIBRARIES_MEMORY
    hoped = (workers or cores()) if ranks.count() == 1 else ranks.count()
    cut = _stream(_cut(experiment, budget / hoped, targets), budget / hoped, targets)
    needs = {task: estimate(task).memory for task in _missing(cut, targets)}
    if not needs:
        return cut, workers or hoped
    largest = max(needs, key=needs.__getitem__)
    _require_room(largest, needs[largest], budget, "--max-memory leaves" if max_memory else "this machine has")
    if ranks.count() > 1:
        return cut, 1
    fitting = max(1, int(budget // needs[largest]))
    if workers is not None and max_memory is None:
        return cut, workers
    return cut, min(hoped, fitting)


def _require_room(largest: Task, need: float, budget: float, source: str) -> None:
    if need > budget:
        raise InputError(
            f"{source} {max(budget, 0) / 1e9:.1f} GB of memory for work, but {largest.stage} ({largest.label}) needs "
            f"about {need / 1e9:.1f} GB; give it more with --max-memory, or use fewer antennas, channels, "
            "integrations or sources"
        )


def _require_sharing(experiment: Experiment, workers: int | None, scheduler: str | None) -> None:
    engine = experiment.simulation.engine
    if engine != "pyuvsim":
        raise InputError(
            f"simulation.engine = {engine!r} does not share its work between MPI ranks, only 'pyuvsim' does; leave out "
            "mpiexec and use --workers, or add --set simulation.engine=pyuvsim"
        )
    if scheduler is not None or workers not in (None, 1):
        raise InputError(
            "--workers and --scheduler: under mpiexec the ranks are the workers; leave both out and choose the number "
            "of ranks with -n"
        )


def _cut(experiment: Experiment, share: float, targets: Targets) -> Experiment:
    """Double the number of simulation chunks until each takes no more than its share, or they are single channels."""
    cut = experiment
    while cut.simulation.chunks < cut.instrument.channels.count and _largest(cut, targets, SHARED_STAGE) > share:
        chunks = min(2 * cut.simulation.chunks, cut.instrument.channels.count)
        finer = cut.model_copy(update={"simulation": cut.simulation.model_copy(update={"chunks": chunks})})
        if _largest(finer, targets, SHARED_STAGE) > 0.95 * _largest(cut, targets, SHARED_STAGE):
            break  # What is left is the sky itself.
        cut = finer
    return cut


def _stream(experiment: Experiment, share: float, targets: Targets) -> Experiment:
    """Halve the number of foreground models that are worked on at a time until a solve takes no more than its share."""
    fitted = experiment
    while fitted.calibration.models_at_once > LEAST_MODELS and _largest(fitted, targets, STREAMED_STAGE) > share:
        fewer = max(fitted.calibration.models_at_once // 2, LEAST_MODELS)
        calibration = fitted.calibration.model_copy(update={"models_at_once": fewer})
        fitted = fitted.model_copy(update={"calibration": calibration})
    return fitted


def _largest(experiment: Experiment, targets: Targets, stage: str) -> float:
    missing = _missing(experiment, targets)
    return max((estimate(task).memory for task in missing if task.stage == stage), default=0.0)


def _missing(experiment: Experiment, targets: Targets) -> Sequence[Task]:
    """Return the tasks whose products a run would have to make, by a quick look into the store."""
    store, found = Store(experiment.outputs.store), {}

    def visit(task: Task) -> None:
        if task.key not in found and store.find(task.stage, task.key) is None:
            found[task.key] = task
            for needed in task.inputs.values():
                visit(needed)

    for task in targets(Graph(experiment)):
        visit(task)
    return tuple(found.values())
