"""The simulated components of an experiment, F or S, without the rest of its run."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from calstudy.errors import InputError
from calstudy.experiment.model import Component, Experiment
from calstudy.graph.tasks import Graph, Task
from calstudy.running.capacity import fit
from calstudy.running.execution import Crew
from calstudy.running.runs import log_to, make
from calstudy.running.store import Product, Store

FILE = "visibilities.uvh5"
"""What the product of a component holds its visibilities in."""


def component_task(graph: Graph, component: Component) -> Task:
    """Return the task of a simulated component; raises InputError if the experiment has no such component."""
    task = {"foregrounds": graph.foregrounds, "eor": graph.eor}.get(component)
    if task is None:
        raise InputError(f"sky.{component}: this experiment simulates none")
    return task


def make_component(
    experiment: Experiment,
    component: Component,
    log: Path,
    console: Console,
    workers: int | None = None,
    max_memory: str | None = None,
) -> Product:
    """Return a simulated component from the experiment's store, making it if it is not there yet.

    It has the key that a run gives it, so that either finds what the other made, whole or in part.

    Parameters
    ----------
    experiment
        Validated; its `outputs.store` is used.
    component
        `foregrounds` or `eor`.
    log
        File that workers and the simulation log to.
    console
        Where progress is told.
    workers, max_memory
        As for `calstudy.running.capacity.fit`.

    Raises
    ------
    InputError
        If the experiment has no such component, or it cannot be made within the memory.
    """
    store = Store(experiment.outputs.store)
    store.prepare()
    task = component_task(Graph(experiment), component)
    found = store.verify(task.stage, task.key)
    if found is not None:
        return found
    fitted, count = fit(experiment, workers, max_memory, targets=lambda graph: [component_task(graph, component)])
    task = component_task(Graph(fitted), component)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log_to(log):
        products, _ = make([task], store, Crew(count, log), console)
    return products[task.key]
