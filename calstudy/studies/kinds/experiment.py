"""An experiment as a study, and families of experiments: figures, tables and claims."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel

from calstudy.base.errors import InputError
from calstudy.base.identity import identity
from calstudy.base.paths import leaves, value_at
from calstudy.base.table import Table
from calstudy.claims.evaluation import Evaluated, claims
from calstudy.claims.paper import stand_ins, unique_notes
from calstudy.corrupt.noise import NoiseRelativeToEor, NoiseRelativeToForegrounds, NoNoise, RadiometerNoise
from calstudy.experiment.assumed import assumed_world
from calstudy.experiment.files import StudyFile
from calstudy.experiment.model import Experiment, Folders
from calstudy.figures import StudyFigure, figure_task, figures_for
from calstudy.instrument.as_built import COLUMNS, as_built_rows
from calstudy.instrument.layouts import make_layout
from calstudy.products import agreement, score, signal_loss, sky_model, spectra
from calstudy.products.graph import Graph
from calstudy.products.table import tables_of
from calstudy.run.execution import Budget
from calstudy.run.provenance import seeds
from calstudy.run.task import Task
from calstudy.studies.capacity import fit, require_data_fit
from calstudy.studies.preflight import frame_of, notes_of, require_possible
from calstudy.studies.study import KINDS, Study


class ExperimentStudy(Study):
    """One validated experiment; `folder` is its run folder if another study decides it."""

    model = Experiment
    keeps_tables = True

    def __init__(self, experiment: Experiment, folder: Path | None = None) -> None:
        self.file = self.experiment = experiment
        if folder is not None:
            self.folder = folder

    @classmethod
    def load(cls, file: StudyFile) -> Study:
        """Return the study of an experiment, which is of another kind if it has a sweep or realizations."""
        return study_of(file.experiment(), file.folder)

    @classmethod
    def of(cls, experiment: Experiment, folder: Path = Path()) -> Study:
        """Return the study of an experiment; raises ExperimentError if there is none of this kind."""
        del folder
        return cls(experiment)

    @cached_property
    def graph(self) -> Graph:
        """The products of the experiment."""
        return Graph(self.experiment)

    @property
    def content(self) -> Any:
        """The experiment without scales and the folders of outputs."""
        return content_of(self.experiment)

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study with simulations and solves cut to the memory, and the number of workers."""
        require_data_fit(self.experiment, budget)
        require_possible(self.experiment)
        experiment, count = fit(self.experiment, budget, self._targets_of)
        return self if experiment is self.experiment else type(self)(experiment, self.folder), count

    def _targets_of(self, experiment: Experiment) -> list[Task]:
        """Return the products of an experiment, without computing those of the study's own again."""
        return self.targets if experiment is self.experiment else type(self)(experiment).targets

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Notes of a plan on settings that are allowed, but probably a mistake."""
        return notes_of(self.experiment)

    @property
    def setup(self) -> str:
        """The array, band, times, gains, noise and calibrator."""
        calibration = self.experiment.calibration.label if self.experiment.calibrates else "not calibrated"
        return f"{describe_data(self.experiment)}; {calibration}"

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions for the papers' own ingredients."""
        return stand_ins(self.experiment)

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        figures = figures_for("experiment", self.experiment.outputs.figures, "outputs.figures")
        return [figure_task(figure, {"": self.graph}, self.stand_ins) for figure in figures]

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return tables_of("experiment", self.graph, self.experiment.outputs.tables)

    @cached_property
    def claims(self) -> Task | None:
        """The statements of the papers that the experiment names, or None."""
        return claims(self.name, self.experiment.papers, {"": self.evaluated}, self.stand_ins)

    @property
    def evaluated(self) -> Evaluated:
        """The experiment with the products on which statements of papers are evaluated."""
        tables = {
            "spectra": spectra.spectra(self.graph),
            "agreement": agreement.agreement(self.graph),
            "transfer": signal_loss.transfer(self.graph),
            "score": score.score(self.graph),
            "sky_model": sky_model.error(self.graph),
        }
        return Evaluated(self.experiment, {name: task for name, task in tables.items() if task is not None})

    @property
    def texts(self) -> dict[str, str]:
        """The resolved experiment, the assumptions of the calibrator, and deviations of antennas."""
        found = dict(super().texts)
        if self.experiment.calibrates:
            table = Table(("field", "true", "assumed"), sky_model.differences(self.graph))
            found["tables/sky-model.csv"] = f"# sky model: {sky_model.described(self.graph)}\n{table.csv()}"
        instrument = self.experiment.instrument
        if instrument.as_built.note:
            numbers = make_layout(instrument.layout).numbers
            deviations = as_built_rows(instrument.as_built, len(numbers))
            rows = [(number, *row) for number, row in zip(numbers, deviations, strict=True)]
            found["tables/as-built.csv"] = Table(("number", *COLUMNS), rows).csv()
        return found

    @property
    def entries(self) -> dict[str, Any]:
        """The sky model of the calibrator, and all seeds."""
        described = {"sky_model": sky_model.described(self.graph)} if self.experiment.calibrates else {}
        return {**described, "seeds": seeds(self.experiment.model_dump(mode="json"))}


@dataclass(frozen=True, eq=False)
class Family(Study):
    """Several experiments by label, all with the same store and folder of runs, and the results of all of them.

    Products that several members need have one key, and are made once. Members with their own run folders are `parts`.
    """

    file: Any
    members: Mapping[str, Experiment]

    def member(self, label: str) -> ExperimentStudy:
        """Return the study of a member."""
        return ExperimentStudy(self.members[label])

    def title(self, label: str) -> str:
        """Return the name of a member in messages."""
        return label

    @cached_property
    def studies(self) -> Mapping[str, ExperimentStudy]:
        """The studies of the members; a subclass may leave members out."""
        return {label: self.member(label) for label in self.members}

    @property
    def to_run(self) -> Mapping[str, ExperimentStudy]:
        """The members of which a run makes something."""
        return self.studies

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the members, once each."""
        return tuple(dict.fromkeys(note for study in self.studies.values() for note in study.notes))

    @property
    def outputs(self) -> Folders:
        """Store and folder of runs."""
        return next(iter(self.members.values())).outputs

    @property
    def content(self) -> Any:
        """The file without scales and outputs, and the names of the run folders of the members."""
        names = [name for name in type(self.file).model_fields if name not in ("scales", "outputs")]
        own = {} if self.is_built_in() else {KINDS.tag: KINDS.identity(KINDS.reference_of(type(self)))}
        return {
            **own,
            "file": {name: identity(getattr(self.file, name)) for name in names},
            "members": {name: study.folder.name for name, study in self.studies.items()},
        }

    @property
    def setup(self) -> str:
        """The data of all members, if they are the same."""
        found = {describe_data(experiment) for experiment in self.members.values()}
        return found.pop() if len(found) == 1 else ""

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of any member for the papers' own ingredients."""
        return unique_notes(note for study in self.studies.values() for note in study.stand_ins)

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the family with every member cut to the memory, and the smallest number of workers of all."""
        members, counts = dict(self.members), []
        for label, study in self.to_run.items():
            try:
                sized, count = study.sized_to(budget)
            except InputError as error:
                raise InputError(f"{self.title(label)}: {error}") from None
            members[label] = sized.experiment
            counts.append(count)
        return replace(self, members=members), min(counts, default=1)

    def draw(self, figure: StudyFigure, settings: Mapping[str, Any] | None = None) -> Task:
        """Return the task of a figure of all members; parameters as for `calstudy.figures.figure_task`."""
        graphs = {label: study.graph for label, study in self.studies.items()}
        return figure_task(figure, graphs, self.stand_ins, settings)


def content_of(file: Any) -> Any:
    """Return the content that decides the run folder of an experiment, or of a file about measured data."""
    outputs = file.outputs.with_defaults("store", "runs")
    return identity(file.model_copy(update={"outputs": outputs}).with_defaults("scales"))


def what_is_made(experiment: Experiment) -> Experiment:
    """Return an experiment without the settings of products that only its own run makes."""
    outputs = experiment.outputs.with_defaults("store", "runs", "figures", "tables")
    return experiment.model_copy(update={"outputs": outputs}).with_defaults("scales", "name", "description", "papers")


def study_of(experiment: Experiment, folder: Path = Path()) -> Study:
    """Return the study of an experiment, of the kind whose key it has; paths in a sweep start at the folder."""
    special = KINDS.marked("key", [name for name, value in experiment if value])
    return (special[0] if special else ExperimentStudy).of(experiment, folder)


def text_of(value: Any) -> str:
    """Write a value of a field for people: text unchanged, the names of files, blocks as ``key value``."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text_of(item)}" for key, item in value.items())
    if isinstance(value, str | Path):
        return Path(value).name if str(value).startswith("/") else str(value)
    return json.dumps(value, default=text_of)


def fields_of(experiment: Experiment, changes: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return an experiment's own values of all fields that are changed: SI numbers, or text; None if it has none."""
    paths = [path for change in changes for path, _ in leaves(change, whole=lambda block: "kind" in block)]
    assumed = {**experiment.calibration.assumed, **dict(assumed_world(experiment))}
    content = {**dict(experiment), "calibration": {**dict(experiment.calibration), "assumed": assumed}}
    found = {}
    for path in paths:
        value: Any = content
        for step in path.split("."):
            value = value_at(dict(value) if isinstance(value, BaseModel) else value, step)
        found[path] = value if value is None or type(value) in (int, float) else text_of(value)
    return found


def describe_data(experiment: Experiment) -> str:
    """Return the array, the band, the times, the gains and the noise of an experiment."""
    instrument = experiment.instrument
    frame, times = frame_of(instrument), instrument.times
    effects = ", ".join(effect.label for effect in experiment.corruption.effects)
    return "; ".join(
        (
            f"{frame.n_antennas} antennas ({instrument.layout.label}), baselines to {frame.lengths.max():.3g} m, "
            f"beam {instrument.beam.label}",
            instrument.channels.label,
            f"{times.count} integration{'s' if times.count > 1 else ''} of {times.integration:g} s",
            effects or "no gains",
            _noise(experiment),
        )
    )


def _noise(experiment: Experiment) -> str:
    noise = experiment.corruption.noise
    match noise:
        case NoiseRelativeToEor():
            return f"noise {noise.factor:g} times the EoR"
        case NoiseRelativeToForegrounds():
            return f"noise {noise.factor:g} times the foregrounds"
        case RadiometerNoise():
            return f"thermal noise of {noise.nights} night{'s' if noise.nights > 1 else ''}"
        case NoNoise():
            return "no noise"
