"""The simulated components of an experiment, F or S, without the rest of its run."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.experiment.model import Component, Experiment
from calstudy.products import simulation
from calstudy.products.graph import Graph
from calstudy.run.execution import Workers
from calstudy.run.store import Product, Store
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import log_to
from calstudy.studies.study import Budget, make


def component_task(experiment: Experiment, component: Component) -> Task:
    """Return the task of a simulated component; raises InputError if the experiment has no such component."""
    makers = {"foregrounds": simulation.foregrounds, "eor": simulation.eor}
    task = makers[component](Graph(experiment)) if component in makers else None
    if task is None:
        raise InputError(f"sky.{component}: this experiment simulates none")
    return task


def make_component(
    experiment: Experiment,
    component: Component,
    log: Path,
    console: Console,
    budget: Budget | None = None,
) -> Product:
    """Return a simulated component from the experiment's store, and make it if it is missing.

    It has the same key as in a run, so that both find finished chunks of each other. Workers and the simulation
    write to the `log` file.

    Raises
    ------
    InputError
        If the experiment has no such component, or it cannot be made within the memory.
    """
    store = Store(experiment.outputs.store)
    task = component_task(experiment, component)
    found = store.verify(task.stage.name, task.key)
    if found is not None:
        return found
    fitted, count = fit(experiment, budget or Budget(), lambda wanted: [component_task(wanted, component)])
    task = component_task(fitted, component)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log_to(log):
        return make([task], store, Workers(count, log), console).products[task.key]
