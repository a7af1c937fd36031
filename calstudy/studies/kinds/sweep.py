"""Sweeps: a family of experiments made from one file by varying some of its fields."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.claims.paper import stand_ins
from calstudy.experiment.files import StudyFile, overridden, short_names, validate, with_absolute_paths
from calstudy.experiment.model import FIGURES, SIGNAL_LOSS_VARIANTS, Experiment
from calstudy.power.score import SPECTRA
from calstudy.products.graph import required
from calstudy.products.score import score
from calstudy.products.signal_loss import SweepSummary, transfer
from calstudy.run.task import Task
from calstudy.studies.kinds.experiment import ExperimentStudy, Family, content_of, fields_of, text_of, what_is_made

SWEPT = ("instrument", "sky", "simulation", "corruption", "calibration", "power", "variants")
"""Sections whose fields can be varied."""
LONGEST_LABEL = 72
MOST_POINTS = 250
POINTS = "points"
"""Folder of the points in the run folder."""


@dataclass(frozen=True, eq=False)
class Sweep(Family):
    """A family of experiments that differ in a few fields of `file`; members have the labels of the points.

    A block of the file's `sweep` has all combinations of its values as points, with the last field varying fastest:
    the changed fields (dotted path) with their values as text, by labels that name the folders.
    """

    key = "sweep"
    model = Experiment
    subfolders = (POINTS,)
    has_reference = False

    blocks: Sequence[Mapping[str, Mapping[str, str]]]

    @classmethod
    def load(cls, file: StudyFile) -> Sweep:
        """Return the sweep of a file."""
        return cls.of(file.experiment(), file.folder)

    @classmethod
    def of(cls, experiment: Experiment, folder: Path = Path()) -> Sweep:
        """Return the family of an experiment with a `sweep`; raises ExperimentError with one sentence per fault."""
        if not experiment.sweep:
            raise InputError(f"{experiment.name}: has no sweep, and so is no family of experiments")
        faults = _faults(experiment)
        if faults:
            raise ExperimentError(faults)
        plain = experiment.model_dump(mode="json", exclude_unset=True, exclude={"sweep", "scales"})
        experiments = []
        for block in experiment.sweep:
            found, faults_of_block = _experiments(block, plain, folder)
            experiments += found
            faults += [fault for fault in faults_of_block if fault not in faults]
        if faults:
            raise ExperimentError(faults)
        swept = with_absolute_paths(experiment.sweep, experiments, folder)
        numbers = itertools.count(1)
        blocks = [dict(_point(next(numbers), changes, block) for changes in _combinations(block)) for block in swept]
        labels = (label for block in blocks for label in block)
        members = dict(zip(labels, experiments, strict=True))
        return cls(experiment.model_copy(update={"sweep": swept}), members, blocks)

    @property
    def points(self) -> dict[str, Mapping[str, str]]:
        """The changes of the points of all blocks, by label."""
        return {label: changes for block in self.blocks for label, changes in block.items()}

    def member(self, label: str) -> ExperimentStudy:
        """Return the study of a point, with a folder under ``points``."""
        return ExperimentStudy(self.members[label], self.folder / POINTS / label)

    @property
    def parts(self) -> Mapping[str, ExperimentStudy]:
        """The points."""
        return self.studies

    @property
    def content(self) -> Any:
        """The varied experiment."""
        return content_of(self.file)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of the varied experiment for the papers' own ingredients."""
        return stand_ins(self.file)

    @cached_property
    def figures(self) -> list[Task]:
        """The signal loss of all points."""
        blocks = [[{"label": label, "changes": changes} for label, changes in block.items()] for block in self.blocks]
        return [self.draw(FIGURES.make("sweep"), {"blocks": blocks})]

    @cached_property
    def tables(self) -> list[Task]:
        """The signal loss and the bias of all points."""
        changes = [{path: item} for block in self.file.sweep for path, values in block.items() for item in values]
        points: dict[str, Any] = {}
        inputs: dict[str, Task] = {}
        for label, study in self.studies.items():
            experiment, measured = study.experiment, required(score(study.graph))
            points[label] = {"fields": fields_of(experiment, changes), "wedge_buffer": experiment.power.wedge_buffer}
            inputs |= {label: required(transfer(study.graph)), f"{label}:score": measured}
            inputs |= {f"{label}:{name}": measured.inputs[name] for name in SPECTRA}
        return [SweepSummary("signal loss of all points", points=points, measured=inputs)]

    @property
    def entries(self) -> Mapping[str, Any]:
        """The folder and the changes of every point."""
        return {POINTS: [{"folder": f"{POINTS}/{label}", "changes": point} for label, point in self.points.items()]}


def _experiments(
    block: Mapping[str, Sequence[Any]], plain: Mapping[str, Any], folder: Path
) -> tuple[list[Experiment], list[str]]:
    """Return the experiments of the points of a block, and a sentence for every fault."""
    experiments: list[Experiment] = []
    faults: list[str] = []
    seen: dict[str, str] = {}
    for changes in _combinations(block):
        words = ", ".join(f"{path} = {text_of(value)}" for path, value in changes.items())
        try:
            data = overridden(plain, changes)
            data["description"] = f"{plain.get('description', '')} Point of a sweep: {words}.".strip()
            experiment = validate(data, folder)
        except InputError as error:
            sentences = error.faults if isinstance(error, ExperimentError) else [str(error)]
            faults += [f"sweep ({words}): {fault}" for fault in sentences]
            continue
        experiments.append(experiment)
        same = seen.setdefault(digest_json(identity(what_is_made(experiment))), words)
        if same != words:
            faults.append(f"sweep ({words}): is the same experiment as ({same}); leave out one of them")
    return experiments, faults


def _combinations(block: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return the changes of every point of a block."""
    return [dict(zip(block, values, strict=True)) for values in itertools.product(*block.values())]


def _point(number: int, changes: Mapping[str, Any], block: Mapping[str, Sequence[Any]]) -> tuple[str, dict[str, str]]:
    """Return a label of the fields that have several values, or of the first one, and the changes as text."""
    varied = [path for path, values in block.items() if len(values) > 1] or list(block)[:1]
    texts, names = {path: text_of(value) for path, value in changes.items()}, short_names(varied)
    words = "-".join(f"{names[path]}={texts[path]}" for path in varied)
    return f"{number:02d}-{re.sub(r'[^A-Za-z0-9_.=+-]+', '', words)}"[:LONGEST_LABEL], texts


def _faults(experiment: Experiment) -> list[str]:
    """Return a sentence for every fault of a sweep that is known without its points."""
    faults = []
    for path, values in ((path, values) for block in experiment.sweep for path, values in block.items()):
        section = path.partition(".")[0]
        if section not in SWEPT or section == path:
            faults.append(
                f"sweep.{path}: cannot be varied{nearest(section, list(SWEPT))} (a dotted path to a field of: "
                f"{', '.join(SWEPT)})"
            )
        texts = [json.dumps(value, sort_keys=True) for value in values]
        again = (text_of(value) for place, value in enumerate(values) if texts[place] in texts[:place])
        faults += [f"sweep.{path}: names the value {text} twice" for text in dict.fromkeys(again)]
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
    return faults
