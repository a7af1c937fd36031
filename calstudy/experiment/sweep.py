"""Sweeps: the family of experiments that one file makes by varying some of its fields."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calstudy.errors import ExperimentError, InputError
from calstudy.experiment.files import override, validate
from calstudy.experiment.messages import nearest
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Experiment

SWEPT = ("instrument", "sky", "simulation", "corruption", "calibration", "power", "variants")
"""Sections whose fields can be varied."""
LONGEST_LABEL = 72


@dataclass(frozen=True)
class Point:
    """One experiment of a family.

    Attributes
    ----------
    label
        Names its folder: its number, and what was changed.
    changes
        The varied fields (dotted path) and their values as text, as written in the file.
    experiment
        Validated, without the sweep.
    """

    label: str
    changes: Mapping[str, str]
    experiment: Experiment


@dataclass(frozen=True)
class Sweep:
    """A family of experiments.

    Attributes
    ----------
    base
        The experiment whose fields are varied.
    blocks
        The points of each block of the file's `sweep`: all combinations of its values, the last field fastest.
    """

    base: Experiment
    blocks: tuple[tuple[Point, ...], ...]

    @property
    def points(self) -> tuple[Point, ...]:
        """The points of all blocks."""
        return tuple(point for block in self.blocks for point in block)


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
            faults += [fault for fault in found if fault not in faults] if isinstance(found, list) else []
            points.append(found)
        blocks.append(tuple(points))
    if faults:
        raise ExperimentError(faults)
    return Sweep(experiment, tuple(blocks))


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
    """Return one point, or what is wrong with it."""
    told = {path: text_of(value) for path, value in changes.items()}
    words = ", ".join(f"{path} = {text}" for path, text in told.items())
    try:
        data = dict(plain)
        for path, value in changes.items():
            data = override(data, path, value)
        data["description"] = f"{plain.get('description', '')} Point of a sweep: {words}.".strip()
        # The paths of input files were made absolute when the file was read.
        return Point(label, told, validate(data, Path("/")))
    except ExperimentError as error:
        return [f"sweep ({words}): {fault}" for fault in error.faults]
    except InputError as error:
        return [f"sweep ({words}): {error}"]


def text_of(value: Any) -> str:
    """Write a value of a sweep for a person: text as it is, blocks as ``key value``."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text_of(item)}" for key, item in value.items())
    return value if isinstance(value, str) else json.dumps(value)


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Return the last word of each dotted path, or the last two where that alone would be ambiguous."""
    last = [path.rpartition(".")[2] for path in paths]
    return {
        path: word if last.count(word) == 1 else ".".join(path.split(".")[-2:])
        for path, word in zip(paths, last, strict=True)
    }


def varied_fields(block: Mapping[str, Sequence[Any]]) -> list[str]:
    """Return the fields of a block that take several values; the first if none does."""
    return [path for path, values in block.items() if len(values) > 1] or list(block)[:1]


def _label(number: int, changes: Mapping[str, Any]) -> str:
    names = short_names(list(changes))
    words = "-".join(f"{names[path]}={text_of(value)}" for path, value in changes.items())
    return f"{number:02d}-{re.sub(r'[^A-Za-z0-9_.=+-]+', '', words)}"[:LONGEST_LABEL]
