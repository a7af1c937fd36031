"""The figures of an experiment as tasks: which products each reads, and what it needs to know besides."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from calstudy.graph.tasks import Graph, Task

WITHOUT_SKY = ("layout", "reflections")
"""Figures of nothing that a stand-in for sky, beam or scale enters."""


def figure_task(graph: Graph, name: str) -> Task:
    """Return the task that draws one figure of an experiment.

    Parameters
    ----------
    graph
        Of the experiment.
    name
        One of `calstudy.experiment.model.FigureName`.
    """
    notes = [] if name in WITHOUT_SKY else list(graph.footnotes)
    settings = {"figure": name, "notes": notes, **FIGURE_SETTINGS[name](graph)}
    return Task("figure", name, settings, FIGURE_INPUTS[name](graph))


def _nothing(graph: Graph) -> dict[str, Any]:
    del graph
    return {}


def _layout(graph: Graph) -> dict[str, Any]:
    return {"layout": graph.sections["instrument"]["layout"]}


def _wedge_buffer(graph: Graph) -> dict[str, Any]:
    return {"wedge_buffer": graph.experiment.power.wedge_buffer}


def _inspected(graph: Graph) -> dict[str, Any]:
    inspect = graph.experiment.outputs.inspect
    return {**_layout(graph), "antennas": list(inspect.antennas), "integration": inspect.integration}


def _inspected_baselines(graph: Graph) -> dict[str, Any]:
    pairs = graph.experiment.outputs.inspect.baselines
    return {**_layout(graph), "baselines": None if pairs is None else [list(pair) for pair in pairs]}


FIGURE_SETTINGS: Mapping[str, Callable[[Graph], dict[str, Any]]] = {
    "layout": _layout,
    "gains": _inspected,
    "model": _inspected,
    "data": _inspected,
    "baselines": _inspected_baselines,
    "wedge": _wedge_buffer,
    "spherical": _wedge_buffer,
    "spherical-excised": _wedge_buffer,
    "reflections": _nothing,
}


def _true_gains(graph: Graph) -> dict[str, Task]:
    return {"gains": graph.gains}


def _spectra(graph: Graph) -> dict[str, Task]:
    return {"spectra": graph.spectra}


def _calibration(graph: Graph) -> Task:
    return graph.calibration(graph.experiment.variants["residual"], graph.experiment.outputs.inspect.realization)


def _data(graph: Graph, name: str) -> Task:
    return graph.data(graph.experiment.variants[name], graph.experiment.outputs.inspect.realization)


def _gains(graph: Graph) -> dict[str, Task]:
    return {**_true_gains(graph), "calibration": _calibration(graph)}


def _model(graph: Graph) -> dict[str, Task]:
    return {**_gains(graph), "foregrounds": graph.foregrounds, "noise": _data(graph, "noise")}


def _fitted_data(graph: Graph) -> dict[str, Task]:
    return {**_gains(graph), "data": _data(graph, "residual"), "noise": _data(graph, "noise")}


def _baselines(graph: Graph) -> dict[str, Task]:
    inputs = {"calibration": _calibration(graph), "data": _data(graph, "residual"), "noise": _data(graph, "noise")}
    if "uncorrupted" in graph.experiment.variants:
        inputs["uncorrupted"] = _data(graph, "uncorrupted")
    return inputs


FIGURE_INPUTS: Mapping[str, Callable[[Graph], dict[str, Task]]] = {
    "layout": _nothing,
    "gains": _gains,
    "model": _model,
    "data": _fitted_data,
    "baselines": _baselines,
    "wedge": _spectra,
    "spherical": _spectra,
    "spherical-excised": _spectra,
    "reflections": _true_gains,
}
