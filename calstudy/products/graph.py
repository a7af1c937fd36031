"""The graph of an experiment: its tasks, each made once however many others need it."""

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
    """What is made of one file, each thing once; see `once`."""

    def __init__(self) -> None:
        self.made: dict[Hashable, Any] = {}


Owner = TypeVar("Owner", bound=Memory)


class Graph(Memory):
    """The tasks of one experiment; the modules of this package make them, each those of its own products.

    Parameters
    ----------
    experiment
        Validated.
    keep_visibilities
        Whether measurements and calibrated visibilities stay in the store; if not, they are removed once all that needs
        them is made. Simulated components and averages over the run always stay.
    """

    def __init__(self, experiment: Experiment, keep_visibilities: bool = True) -> None:
        super().__init__()
        self.experiment = experiment
        self.keep_visibilities = keep_visibilities
        self.size = Size.of(experiment.instrument)


def once(make: Callable[Concatenate[Owner, Arguments], Made]) -> Callable[Concatenate[Owner, Arguments], Made]:
    """Make ``make(graph, ...)`` return the same task whenever it is called with the same graph and arguments."""

    @wraps(make)
    def task(graph: Owner, *arguments: Arguments.args, **named: Arguments.kwargs) -> Made:
        key = (make, arguments, tuple(named.items()))
        if key not in graph.made:
            graph.made[key] = make(graph, *arguments, **named)
        return graph.made[key]

    return task


def required(task: Task | None) -> Task:
    """Return the task of a product that an experiment may lack, where it must have it; raises LookupError if not."""
    if task is None:
        raise LookupError("the experiment does not have a product that is needed of it")
    return task


def size_of(task: Task) -> Size:
    """Return the size of the data that a task works on: as its settings say, or those of the nearest it is made from.

    That is the size of an instrument's data, or of measured ones.
    """
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
