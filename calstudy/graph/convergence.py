"""The study of convergence as tasks: some integrations, solved by several solvers that are looked at on the way."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.graph.tasks import PARITIES, Graph, Task


def convergence_figure(graph: Graph) -> Task:
    """Return the task that draws the bias of P^R against steps, of an experiment that `measures_signal_loss`."""
    study = graph.sections["outputs"]["convergence"]
    names = dict(zip(("with", "without"), SIGNAL_LOSS_VARIANTS, strict=False))
    last = graph.experiment.instrument.times.count - 1
    count = min(study["integrations"], last + 1)
    integrations = np.unique(np.linspace(0, last, count).round().astype(int)).tolist()
    inputs = {
        f"{label} {kind} {integration}": _followed(graph, names[kind], solver, integration)
        for (label, solver), kind, integration in itertools.product(study["solvers"].items(), names, integrations)
    }
    settings = {"notes": list(graph.footnotes), "solvers": list(study["solvers"]), "integrations": integrations}
    return Task("convergence-figure", "convergence", settings, inputs)


def _followed(graph: Graph, name: str, solver: dict[str, Any], integration: int) -> Task:
    """Return the task that follows one solver on one integration of both realizations of a variant."""
    variant, study = graph.experiment.variants[name], graph.sections["outputs"]["convergence"]
    noise = Variant(components=("noise",))
    inputs = {f"data {parity}": graph.data(variant, parity) for parity in PARITIES}
    if "noise" in variant.components:
        inputs |= {f"noise {parity}": graph.data(noise, parity) for parity in PARITIES}
    inputs["eor"] = graph.data(Variant(components=("eor",)), "even")
    if variant.gains:
        inputs["gains"] = graph.gains
    if graph.foregrounds is not None:
        inputs["sky_model"] = graph.foregrounds
    settings = {
        "calibration": {**graph.sections["calibration"], "solver": solver},
        "integration": integration,
        "steps": study["steps"],
        "buffer": graph.experiment.power.wedge_buffer,
    }
    return Task("convergence", f"{solver['name']} on {name}, integration {integration}", settings, inputs)
