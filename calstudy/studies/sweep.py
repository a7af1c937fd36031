"""Sweeps: a family of experiments made from one file by varying some of its fields."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.claims.paper import stand_ins
from calstudy.experiment.files import dump, override, short_names, validate
from calstudy.experiment.model import FIGURES, SIGNAL_LOSS_VARIANTS, Experiment, Outputs
from calstudy.figures import DRAW
from calstudy.figures.sweep import SUMMARY
from calstudy.run.task import Task
from calstudy.studies.experiment import ExperimentStudy, experiment_folder
from calstudy.studies.folder import EXPERIMENT, POINTS, publish, write, write_manifest
from calstudy.studies.study import Budget, Made, Study, fitted_parts

SWEPT = ("instrument", "sky", "simulation", "corruption", "calibration", "power", "variants")
"""Sections whose fields can be varied."""
LONGEST_LABEL = 72
MOST_POINTS = 250


@dataclass(frozen=True)
class Point:
    """One experiment of a family, validated and without the sweep.

    The label, which names its folder, has its number and the changes: the varied fields (dotted path) and their
    values as text, as written in the file.
    """

    label: str
    changes: Mapping[str, str]
    experiment: Experiment


class Sweep(Study):
    """A family of experiments.

    Products that several points need have one key, and are made once. A block of the file's `sweep` has all
    combinations of its values as points, with the last field varying fastest.
    """

    def __init__(self, base: Experiment, blocks: Sequence[Sequence[Point]]) -> None:
        self.base, self.blocks = base, tuple(tuple(block) for block in blocks)
        self.name, self.description = base.name, base.description

    @property
    def points(self) -> tuple[Point, ...]:
        """The points of all blocks."""
        return tuple(point for block in self.blocks for point in block)

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs."""
        return self.base.outputs

    @property
    def folder(self) -> Path:
        """The run folder."""
        return experiment_folder(self.base)

    @cached_property
    def parts(self) -> Mapping[str, ExperimentStudy]:
        """The points, each with a folder under ``points``."""
        return {
            point.label: ExperimentStudy(point.experiment, self.folder / POINTS / point.label) for point in self.points
        }

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the sweep with every point fitted, and the smallest number of workers of all."""
        fits = fitted_parts(self.parts, budget)
        blocks = [
            [replace(point, experiment=fits[point.label][0].experiment) for point in block] for block in self.blocks
        ]
        return type(self)(self.base, blocks), min(count for _, count in fits.values())

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of the varied experiment for the papers' own ingredients."""
        return stand_ins(self.base)

    @cached_property
    def summary(self) -> Task:
        """The signal loss of all points: a table and a figure."""
        figure = FIGURES.make("sweep")
        blocks = [[{"label": point.label, "changes": dict(point.changes)} for point in block] for block in self.blocks]
        settings = {"figure": figure, "notes": list(self.stand_ins), "blocks": blocks}
        inputs = {label: figure.inputs(part.graph)["transfer"] for label, part in self.parts.items()}
        return Task(DRAW, figure.label, settings, inputs)

    @property
    def targets(self) -> list[Task]:
        """The products of all points, and their comparison."""
        return [*(task for part in self.parts.values() for task in part.targets), self.summary]

    def fill(self, made: Made) -> None:
        """Write the comparison, the experiment and the manifest."""
        folder, summary = self.folder, made.products[self.summary.key]
        publish([summary], folder / "figures")
        (folder / "tables").mkdir(exist_ok=True)
        (folder / "figures" / SUMMARY).replace(folder / "tables" / SUMMARY)
        write(folder / EXPERIMENT, dump(self.base))
        fields = {
            "description": self.description,
            "stand_ins": list(self.stand_ins),
            "captions": {self.summary.label: self.summary.settings["figure"].caption},
            "points": [{"folder": f"{POINTS}/{point.label}", "changes": dict(point.changes)} for point in self.points],
            "products": [{name: summary.record[name] for name in ("stage", "label", "key", "seconds", "inputs")}],
        }
        write_manifest(folder, self.name, fields)


def expand(experiment: Experiment) -> Sweep:
    """Return the family of an experiment with a `sweep`.

    Raises
    ------
    ExperimentError
        With one sentence per fault: a field that cannot be varied, is unknown, or does not take a value, or a point
        whose fields do not go together.
    """
    if not experiment.sweep:
        raise InputError(f"{experiment.name}: has no sweep, and so is no family of experiments")
    faults = _faults_of_fields(experiment.sweep)
    count = sum(math.prod(len(values) for values in block.values()) for block in experiment.sweep)
    if count > MOST_POINTS:
        faults.append(
            f"sweep: has {count} points, all combinations of the values, and at most {MOST_POINTS} are allowed; give "
            "fewer values, or a list of blocks that vary one field each"
        )
    if not experiment.measures_signal_loss:
        faults.append(
            f"sweep: compares the signal loss of its points, which needs the variants {', '.join(SIGNAL_LOSS_VARIANTS)}"
        )
    if faults:
        raise ExperimentError(faults)
    plain = experiment.model_dump(mode="json", exclude_unset=True, exclude={"sweep", "scales"})
    numbers = itertools.count(1)
    blocks = []
    for block in experiment.sweep:
        points = []
        for values in itertools.product(*block.values()):
            changes = dict(zip(block, values, strict=True))
            named = {path: changes[path] for path in varied_fields(block)}
            found = _point(plain, changes, _label(next(numbers), named))
            if isinstance(found, Point):
                points.append(found)
            else:
                faults += [fault for fault in found if fault not in faults]
        blocks.append(tuple(points))
    if faults:
        raise ExperimentError(faults)
    return Sweep(experiment, blocks)


def _faults_of_fields(blocks: Sequence[Mapping[str, Sequence[Any]]]) -> list[str]:
    faults = []
    for path, values in ((path, values) for block in blocks for path, values in block.items()):
        section = path.partition(".")[0]
        if section not in SWEPT or section == path:
            faults.append(
                f"sweep.{path}: cannot be varied{nearest(section, list(SWEPT))} (a dotted path to a field of: "
                f"{', '.join(SWEPT)})"
            )
        texts = [text_of(value) for value in values]
        faults += [
            f"sweep.{path}: names the value {text} twice" for text in dict.fromkeys(texts) if texts.count(text) > 1
        ]
    return faults


def _point(plain: Mapping[str, Any], changes: Mapping[str, Any], label: str) -> Point | list[str]:
    """Return one point, or its faults."""
    texts = {path: text_of(value) for path, value in changes.items()}
    words = ", ".join(f"{path} = {text}" for path, text in texts.items())
    try:
        data = dict(plain)
        for path, value in changes.items():
            data = override(data, path, value)
        data["description"] = f"{plain.get('description', '')} Point of a sweep: {words}.".strip()
        # The paths of input files were made absolute when the file was read.
        return Point(label, texts, validate(data, Path("/")))
    except ExperimentError as error:
        return [f"sweep ({words}): {fault}" for fault in error.faults]
    except InputError as error:
        return [f"sweep ({words}): {error}"]


def text_of(value: Any) -> str:
    """Write a value of a sweep for people: text unchanged, blocks as ``key value``."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text_of(item)}" for key, item in value.items())
    return value if isinstance(value, str) else json.dumps(value)


def varied_fields(block: Mapping[str, Sequence[Any]]) -> list[str]:
    """Return the fields of a block that have several values; the first if none has."""
    return [path for path, values in block.items() if len(values) > 1] or list(block)[:1]


def _label(number: int, changes: Mapping[str, Any]) -> str:
    names = short_names(list(changes))
    words = "-".join(f"{names[path]}={text_of(value)}" for path, value in changes.items())
    return f"{number:02d}-{re.sub(r'[^A-Za-z0-9_.=+-]+', '', words)}"[:LONGEST_LABEL]
