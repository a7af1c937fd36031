"""The task that measures one step of the validation ladder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calstudy.graph.tasks import Graph, Task
from calstudy.validation.rungs import RUNGS

if TYPE_CHECKING:
    from calstudy.validation.steps import Step


def measurement_task(step: Step) -> Task:
    """Return the task whose product holds what the rung of a step finds on the products of its experiments."""
    rung = RUNGS[step.rung]
    graphs = {name: Graph(experiment) for name, experiment in step.experiments.items()}
    settings = {
        "rung": step.rung,
        "version": rung.version,
        "parameters": dict(step.parameters),
        "experiments": {
            name: {section: graph.sections[section] for section in rung.sections} for name, graph in graphs.items()
        },
    }
    inputs = {
        f"{name}:{product}": task for name, graph in graphs.items() for product, task in rung.needs(graph).items()
    }
    return Task("validate", f"step {step.name}", settings, inputs)
