"""The graph of a study: the tasks of one experiment or of measured data, each made once and shared by all."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import size_of_instrument
from calstudy.instrument.settings import Beam, Channels, Size
from calstudy.run.task import Task

if TYPE_CHECKING:
    from calstudy.realdata.halves import Parts

Found = TypeVar("Found")
Arguments = ParamSpec("Arguments")


class Graph:
    """The tasks of one experiment; each module of this package makes those of its own products.

    If `keep_visibilities` is false, measurements and calibrated visibilities are removed from the store as soon as all
    products made from them exist. Simulated components and averages over the run always stay.
    """

    def __init__(self, experiment: Experiment, keep_visibilities: bool = True) -> None:
        self.found: dict[Hashable, Any] = {}
        self.experiment = experiment
        self.keep_visibilities = keep_visibilities

    @property
    def beam(self) -> Beam:
        """The beam of power spectra."""
        return self.experiment.instrument.beam

    @property
    def channels(self) -> Channels:
        """The channels of power spectra."""
        return self.experiment.instrument.channels


class MeasuredGraph(Graph):
    """The tasks of measured data.

    The experiment is their file: `calibration` and `power` are those of any experiment, `observed` and `injection` its
    own. `parts` are the parts of the data that are calibrated by themselves.
    """

    experiment: Any

    def __init__(self, file: Any, parts: Parts) -> None:
        super().__init__(file)
        self.parts = parts

    @property
    def beam(self) -> Beam:
        """The beam of power spectra."""
        return self.experiment.observed.beam

    @property
    def channels(self) -> Channels:
        """The channels of power spectra."""
        return self.parts.facts["even"].channels


Owner = TypeVar("Owner", bound=Graph)


def memoize(make: Callable[Concatenate[Owner, Arguments], Found]) -> Callable[Concatenate[Owner, Arguments], Found]:
    """Make ``make(graph, ...)`` return the same object whenever it is called with the same graph and arguments."""

    @wraps(make)
    def task(graph: Owner, *arguments: Arguments.args, **named: Arguments.kwargs) -> Found:
        key = (make, arguments, tuple(named.items()))
        if key not in graph.found:
            graph.found[key] = make(graph, *arguments, **named)
        return graph.found[key]

    return task


def required(task: Found | None) -> Found:
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
    if (instrument := getattr(task, "instrument", None)) is not None:
        return size_of_instrument(instrument)
    if (size := getattr(task, "size", None)) is not None:
        return Size(**size)
    return next((found for found in map(_size_in, task.needs.values()) if found is not None), None)
