"""The sky model of the calibrator: the true foregrounds, or those that the experiment assumes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calstudy.base import paths
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.sky_model import read_sky_model
from calstudy.corrupt.levels import rms
from calstudy.experiment.assumed import SKY_MODEL, AssumedWorld, assumed_changes, assumed_world
from calstudy.experiment.model import Experiment
from calstudy.instrument.settings import InstrumentSettings
from calstudy.products import simulation
from calstudy.products.files import SKY_MODEL_ERROR, VISIBILITIES, read_visibilities, write_json, write_visibilities
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Task


@memoize
def sky_model(graph: Graph) -> Task | None:
    """Return the task of the calibrator's sky model, the true foregrounds if nothing else is assumed; None for none."""
    changes = assumed_changes(graph.experiment.calibration.assumed)
    if SKY_MODEL in changes:
        path = Path(changes[SKY_MODEL])
        return ReadSkyModel(path.name, path=path, instrument=graph.experiment.instrument.without_beams())
    world, true = assumed_world(graph.experiment), simulation.foregrounds(graph)
    assumed = simulation.foregrounds_of(graph, "assumed foregrounds", world.sky, world.instrument)
    return true if assumed is not None and true is not None and assumed.key == true.key else assumed


def is_perfect(graph: Graph) -> bool:
    """Return true if the sky model of the calibrator is the true foregrounds."""
    model = sky_model(graph)
    return model is not None and model is simulation.foregrounds(graph)


@memoize
def error(graph: Graph) -> Task | None:
    """Return the task that measures the error of the sky model, or None if it is perfect or there is no sky model."""
    model, true = sky_model(graph), simulation.foregrounds(graph)
    if model is None or true is None or is_perfect(graph):
        return None
    return SkyModelError("sky model against truth", foregrounds=true, sky_model=model)


def differences(graph: Graph) -> list[tuple[str, str, str]]:
    """Return the field, true value and assumed value, as texts, of every assumption that is not true."""
    experiment = graph.experiment
    changes = assumed_changes(experiment.calibration.assumed)
    if SKY_MODEL in changes:
        return [(SKY_MODEL, "the true foregrounds", str(changes[SKY_MODEL]))]
    world = assumed_world(experiment)
    true = AssumedWorld(sky=experiment.sky, instrument=experiment.instrument)
    # Deviations of antennas from the nominal ones have a row of their own.
    before, after = (found.model_dump(mode="json", exclude={"instrument": {"as_built"}}) for found in (true, world))
    rows = [(path, _text(value), _text(other)) for path, value, other in paths.differences(before, after)]
    return [*rows, *_differences_as_built(experiment)]


def _differences_as_built(experiment: Experiment) -> list[tuple[str, str, str]]:
    """Return the row of `differences` for the deviations of the antennas, which the calibrator ignores by default."""
    built = [found.as_built for found in (experiment.instrument, assumed_world(experiment).instrument)]
    true, assumed = ((found.note or "nominal").removeprefix("as built: ") for found in built)
    return [("instrument.as_built", true, assumed)] if built[0] != built[1] else []


def described(graph: Graph) -> str:
    """Describe the sky model of the calibrator in a sentence."""
    if sky_model(graph) is None:
        return "none: the calibrator is given no sky model"
    if is_perfect(graph):
        return "perfect: the calibrator is given the true foregrounds"
    rows = differences(graph)
    if rows[0][0] == SKY_MODEL:
        return f"visibilities of {Path(rows[0][2]).name} in place of the true foregrounds"
    return f"assumed: {'; '.join(f'{path} = {assumed}, where {true} is true' for path, true, assumed in rows)}"


def _text(value: Any) -> str:
    if isinstance(value, Mapping) and "kind" in value:
        fields = ", ".join(f"{name} {_text(field)}" for name, field in value.items() if name != "kind")
        return f"{value['kind']} ({fields})" if fields else str(value["kind"])
    return value if isinstance(value, str) else json.dumps(value)


class SkyModelTable(StudyTable):
    """The error of the sky model, if anything is calibrated."""

    of = "experiment"
    place = 5

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [error(graph)] if graph.experiment.calibrates else []


class ReadSkyModel(Task, stage="sky-model", version=2):
    """The visibilities of a file, at the samples of the data, of feeds by their directions."""

    path: Path
    instrument: InstrumentSettings

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the visibilities to visibilities.uvh5."""
        from calstudy.instrument.telescope import make_template

        write_visibilities(read_sky_model(self.path, make_template(self.instrument)), output / VISIBILITIES)
        return {"file": str(self.path)}

    def _cost(self) -> Cost:
        disk = size_of(self).samples * COMPLEX128
        return Cost(3 + disk * 4e-9, LIBRARIES_MEMORY + 5 * disk, disk)


class SkyModelError(Task, stage="sky-model-error", version=1):
    """The error of the sky model."""

    foregrounds: Input
    sky_model: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the rms of the true foregrounds, of the sky model, and of their difference to sky-model.json, Jy."""
        folders = (self.foregrounds, self.sky_model)
        true, model = (to_cube(read_visibilities(folder / VISIBILITIES)) for folder in folders)
        true_rms, difference = rms(true), rms(model - true)
        found = {
            "true_rms_jy": true_rms,
            "sky_model_rms_jy": rms(model),
            "difference_rms_jy": difference,
            "relative_error": difference / true_rms if true_rms else None,
        }
        write_json(output / SKY_MODEL_ERROR, found)
        if difference == 0:
            # This product exists only if the experiment asks for an error of the sky model.
            return {**found, "warnings": ["the sky model that the calibrator assumes is equal to the true foregrounds"]}
        return found

    def _cost(self) -> Cost:
        samples = size_of(self).samples
        return Cost(0.1 + samples * 1e-7, LIBRARIES_MEMORY + 4 * samples * COMPLEX128, 1e3)
