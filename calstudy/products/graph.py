"""The graph of an experiment: its tasks, each made once and shared by all tasks that need it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from calstudy.experiment.model import Experiment
from calstudy.instrument.size import Size
from calstudy.run.task import Task

Made = TypeVar("Made")
Arguments = ParamSpec("Arguments")


class Memory:
    """Cache of the objects that are made from one file; see `once`."""

    def __init__(self) -> None:
        self.made: dict[Hashable, Any] = {}


Owner = TypeVar("Owner", bound=Memory)


class Graph(Memory):
    """The tasks of one experiment; each module of this package makes those of its own products.

    If `keep_visibilities` is false, measurements and calibrated visibilities are removed from the store as soon as all
    products made from them exist. Simulated components and averages over the run always stay.
    """

    def __init__(self, experiment: Experiment, keep_visibilities: bool = True) -> None:
        super().__init__()
        self.experiment = experiment
        self.keep_visibilities = keep_visibilities
        self.size = Size.of(experiment.instrument)


def once(make: Callable[Concatenate[Owner, Arguments], Made]) -> Callable[Concatenate[Owner, Arguments], Made]:
    """Make ``make(graph, ...)`` return the same object whenever it is called with the same graph and arguments."""

    @wraps(make)
    def task(graph: Owner, *arguments: Arguments.args, **named: Arguments.kwargs) -> Made:
        key = (make, arguments, tuple(named.items()))
        if key not in graph.made:
            graph.made[key] = make(graph, *arguments, **named)
        return graph.made[key]

    return task


def required(task: Task | None) -> Task:
    """Return a task that an experiment may lack; raises LookupError if it is None."""
    if task is None:
        raise LookupError("the experiment does not have a product that is needed of it")
    return task


def size_of(task: Task) -> Size:
    """Return the size of the simulated or measured data of a task, from its settings or those of its nearest input."""
    size = _size_in(task)
    if size is None:
        raise LookupError(f"{task.stage.name} ({task.label}): made from no instrument")
    return size


def _size_in(task: Task) -> Size | None:
    if "instrument" in task.settings:
        return Size.of(task.settings["instrument"])
    if "size" in task.settings:
        return Size(**task.settings["size"])
    return next((found for found in map(_size_in, task.needs.values()) if found is not None), None)
