"""The tasks behind the claims: the calibration measured against the truth, and the claims themselves."""

from __future__ import annotations

from typing import Any

from calstudy.claims.facts import FACTS
from calstudy.graph.tasks import Graph, Task


def agreement_task(graph: Graph) -> Task | None:
    """Return the task that measures how far the calibration of variant `residual` agrees with the truth.

    None if there is nothing to measure: no such calibrated variant of foregrounds and noise, or no variant of noise
    alone to compare with.
    """
    variants = graph.experiment.variants
    residual, noise = variants.get("residual"), variants.get("noise")
    if graph.foregrounds is None or residual is None or noise is None or noise.components != ("noise",):
        return None
    if not (residual.gains and residual.calibrate and {"foregrounds", "noise"} <= set(residual.components)):
        return None
    power = graph.experiment.power
    settings = {"buffer": power.wedge_buffer, "redundancy_tolerance": power.redundancy_tolerance}
    inputs = {
        "data": graph.data(residual, "even"),
        "noise": graph.data(noise, "even"),
        "foregrounds": graph.foregrounds,
        "gains": graph.gains,
        "calibration": graph.calibration(residual, "even"),
    }
    return Task("agreement", "calibration against truth", settings, inputs)


def claim_facts(graph: Graph) -> dict[str, Any]:
    """Return what claims must know of an experiment."""
    return {"name": graph.experiment.name, **{name: graph.sections[name] for name in FACTS}}


def claim_inputs(graph: Graph) -> dict[str, Task]:
    """Return the products that claims are evaluated on."""
    inputs = {"spectra": graph.spectra, "agreement": graph.agreement}
    return {name: task for name, task in inputs.items() if task is not None}


def claims_task(graph: Graph) -> Task:
    """Return the task that evaluates the paper's claims on one experiment alone."""
    settings = {"title": graph.experiment.name, "notes": list(graph.footnotes), "experiment": claim_facts(graph)}
    return Task("claims", "claims", settings, claim_inputs(graph))
