"""The product of a step of the validation ladder: findings of its measurement on the products of its experiments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from calstudy.base.errors import InputError
from calstudy.base.plugins import guarded
from calstudy.base.resources import Cost
from calstudy.products.files import write_json
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Stage, Task
from calstudy.validation.measurement import Findings, Inputs
from calstudy.validation.steps import Step

FINDINGS = "measurement.json"


def measurement_task(step: Step) -> Task:
    """Return the task that measures a step; raises InputError if its experiments lack a product."""
    measurement = step.measurement
    graphs = {name: Graph(experiment) for name, experiment in step.experiments.items()}
    settings = {
        "measurement": measurement,
        "version": measurement.version,
        "experiments": {
            name: {section: getattr(experiment, section) for section in measurement.sections}
            for name, experiment in step.experiments.items()
        },
    }
    inputs = {
        f"{name}:{product}": task for name, graph in graphs.items() for product, task in _products(step, graph).items()
    }
    return Task(VALIDATE, f"step {step.name}", settings, inputs)


def _products(step: Step, graph: Graph) -> Mapping[str, Task]:
    try:
        with guarded(step.measurement):
            return step.measurement.products(graph)
    except InputError as error:
        raise InputError(f"step {step.name}: {graph.experiment.name}: {error}") from None


def measure(job: Job) -> Mapping[str, Any]:
    """Write the findings of a measurement to measurement.json, with its figures and tables.

    Raises InputError if a user's own measurement fails, or does not return Findings.
    """
    measurement = job.settings["measurement"]
    with guarded(measurement):
        found = measurement.measure(Inputs(job.settings["experiments"], job.inputs, job.output))
    if not isinstance(found, Findings):
        raise InputError(f"{measurement.label}: its measure returned a {type(found).__name__}, expected Findings")
    findings = {
        name: {"value": _json(finding.value), "uncertainty": _json(finding.uncertainty)}
        for name, finding in found.values.items()
    }
    write_json(job.output / FINDINGS, {"findings": findings, "remarks": list(found.remarks)})
    return {"findings": findings}


def _json(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


VALIDATE = Stage(name="validate", version=4, make=measure, cost=lambda task: Cost(60, 3e9, 1e6))
