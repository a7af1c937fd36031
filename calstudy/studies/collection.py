"""Collections: several experiments that are run together, share products, and are compared."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, SerializeAsAny, ValidationError, model_validator

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.identity import identity
from calstudy.base.plugins import Plugin
from calstudy.base.schema import Section, choice, fault
from calstudy.claims.evaluation import members_by_role, refusal_of_role
from calstudy.claims.paper import distinct_papers, unique_notes
from calstudy.claims.product import combined_claims
from calstudy.experiment.files import apply_scale, override, parse_override, validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import FIGURES, Experiment, Outputs, StudyName
from calstudy.experiment.realizations import expand_realizations
from calstudy.experiment.yaml_files import read_mapping
from calstudy.figures import ComparisonFigure, comparison_task
from calstudy.run.task import Task
from calstudy.studies.experiment import ExperimentStudy
from calstudy.studies.folder import publish, run_folder, write_manifest
from calstudy.studies.realizations import Realizations
from calstudy.studies.study import Budget, Made, Study, fitted_parts

KEY = "experiments"
"""Key that marks a file as a collection."""


class Member(Section):
    """One experiment of the collection; a file name alone is allowed in place of the block."""

    file: Path = Field(strict=False, description="The experiment file; a relative path starts at the collection file.")
    name: StudyName | None = Field(None, description="Replaces the experiment's own name.")
    overrides: dict[str, Any] = Field(default_factory=dict, description="Fields to change (dotted path: value).")


class CollectionFile(Section):
    """Several experiments that are run together, share products, and are compared."""

    name: StudyName = Field(description="Names the folder of the combined figures and claims.")
    description: str = ""
    experiments: Annotated[tuple[Annotated[Member, choice("file")], ...], Field(strict=False, min_length=1)] = Field(
        description="Experiment files, each with its own run folder."
    )
    figures: Annotated[tuple[Annotated[SerializeAsAny[Plugin], FIGURES.field()], ...], Field(strict=False)] = Field(
        (), description="Figures that compare members, such as layouts and spherical-comparison."
    )
    roles: dict[str, str] = Field(
        default_factory=dict,
        description="Which member plays which role in the members' papers and in figures, where its name does not say.",
    )

    @model_validator(mode="after")
    def _names_no_one_twice(self) -> CollectionFile:
        names = [member.name for member in self.experiments if member.name]
        for name in names:
            if names.count(name) > 1:
                raise fault("experiments", f"gives the name {name!r} twice")
        return self


class Collection(Study):
    """Several experiments, and the figures and claims that compare them.

    Products that several members need have one key, and are made once. `members` are in the order of the file, all
    with the same store and folder of runs; `roles` has the member by the role that it plays in its papers.
    `finished` has the run folders of members that were run before and whose tables are in the store: the collection
    does not run them, and needs nothing else of them.
    """

    def __init__(
        self,
        file: CollectionFile,
        members: Mapping[str, Experiment],
        roles: Mapping[str, str],
        finished: Mapping[str, Path] | None = None,
    ) -> None:
        self.file, self.members, self.roles, self.finished = file, dict(members), dict(roles), dict(finished or {})
        self.name, self.description = file.name, file.description

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs, the same for all members."""
        return next(iter(self.members.values())).outputs

    @cached_property
    def studies(self) -> Mapping[str, ExperimentStudy | Realizations]:
        """The members."""
        return {
            name: Realizations(experiment) if experiment.realizations else ExperimentStudy(experiment)
            for name, experiment in self.members.items()
        }

    @property
    def parts(self) -> Mapping[str, ExperimentStudy | Realizations]:
        """The members that are run."""
        return {name: study for name, study in self.studies.items() if name not in self.finished}

    @property
    def given(self) -> frozenset[str]:
        """Keys of the tables of members that were run before."""
        members = (self.studies[name] for name in self.finished)
        return frozenset(task.key for study in members if isinstance(study, ExperimentStudy) for task in study.tables)

    def without(self, finished: Mapping[str, Path]) -> Self:
        """Return the collection with members that need not be run; see `finished`."""
        return type(self)(self.file, self.members, self.roles, {**self.finished, **finished})

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the collection with every member fitted, and the smallest number of workers of all."""
        fits = fitted_parts(self.parts, budget)
        members = {**self.members, **{name: part.experiment for name, (part, _) in fits.items()}}
        count = min((count for _, count in fits.values()), default=1)
        return type(self)(self.file, members, self.roles, self.finished), count

    @property
    def folder(self) -> Path:
        """The run folder: the name, and a digest of the content of the collection and its members."""
        content = {
            "members": {name: study.folder.name for name, study in self.studies.items()},
            "roles": self.roles,
            "figures": identity(self.file.figures),
        }
        return run_folder(self.outputs.runs, self.name, content)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of any member for the papers' own ingredients."""
        return unique_notes(note for study in self.studies.values() for note in study.stand_ins)

    @cached_property
    def figures(self) -> list[Task]:
        """The figures that compare members."""
        return [self._figure(figure) for figure in _comparisons(self.file)]

    def _figure(self, figure: ComparisonFigure) -> Task:
        shown = figure.roles(self.roles)
        compared = {role: self.studies[self.roles[role]] for role in shown} or dict(self.studies)
        notes = unique_notes(note for part in compared.values() for note in part.stand_ins)
        return comparison_task({role: part.graph for role, part in compared.items()}, figure, notes)

    @cached_property
    def claims(self) -> Task | None:
        """The statements of the members' papers, each evaluated on the members that play its roles, or None."""
        graphs = {name: study.graph for name, study in self.studies.items()}
        papers = distinct_papers(paper for experiment in self.members.values() for paper in experiment.papers)
        return combined_claims(self.name, graphs, papers, self.roles, self.stand_ins)

    def _place(self, name: str) -> str:
        """Return the path of a member's folder, relative to the folder of runs."""
        if name in self.finished:
            return os.path.relpath(self.finished[name].resolve(), self.folder.parent)
        return self.studies[name].folder.name

    @property
    def own(self) -> list[Task]:
        """The figures and claims that compare members."""
        return [*self.figures, *([self.claims] if self.claims else [])]

    @property
    def targets(self) -> list[Task]:
        """The products of all members that are run, and the figures and claims that compare members."""
        return [task for part in self.parts.values() for task in part.targets] + self.own

    def fill(self, made: Made) -> None:
        """Write the figures and claims that compare members, and a manifest that names the members' folders."""
        folder = self.folder
        publish([made.products[task.key] for task in self.figures], folder / "figures")
        if self.claims is not None:
            publish([made.products[self.claims.key]], folder)
        taken = [task for name in self.finished for task in self.studies[name].targets if task.key in made.products]
        fields = {
            "description": self.description,
            "members": {name: self._place(name) for name in self.members},
            "roles": self.roles,
            "figures": [figure.model_dump(mode="json") for figure in self.file.figures],
            "stand_ins": list(self.stand_ins),
            "captions": {figure.label: figure.caption for figure in _comparisons(self.file)},
            "products": [
                {"stage": task.stage.name, "label": task.label, "key": task.key} for task in (*taken, *self.own)
            ],
        }
        write_manifest(folder, self.name, fields)


def load_collection(
    path: Path, data: Mapping[str, Any], scale: str | None = None, overrides: Sequence[str] = ()
) -> Collection:
    """Validate the content of a collection file; parameters and errors as for `calstudy.studies.load.load_study`."""
    folder = path.resolve().parent
    try:
        file = CollectionFile.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise ExperimentError(sentences(error, CollectionFile, data)) from None
    members = _load_members(file, folder, scale, overrides)
    roles = _roles(file, members)
    for place, figure in enumerate(file.figures):
        if not isinstance(figure, ComparisonFigure):
            built_in = [name for name in FIGURES.built_in() if issubclass(FIGURES.find(name), ComparisonFigure)]
            hint = f"does not compare members{nearest(figure.label, built_in)} (built in: {', '.join(built_in)})"
            raise ExperimentError([f"figures.{place}: {figure.label!r} {hint}; ask for it in an experiment"])
        missing = [role for role in figure.roles(roles) if role not in roles]
        if missing:
            raise ExperimentError(
                [f"figures: asks for {figure.label!r}, which needs a member in the role(s) {', '.join(missing)}"]
            )
    return Collection(file, members, roles)


def _comparisons(file: CollectionFile) -> list[ComparisonFigure]:
    return [figure for figure in file.figures if isinstance(figure, ComparisonFigure)]


def _load_members(
    file: CollectionFile, base: Path, scale: str | None, overrides: Sequence[str]
) -> dict[str, Experiment]:
    members: dict[str, Experiment] = {}
    faults = []
    for index, member in enumerate(file.experiments):
        path = member.file.expanduser() if member.file.expanduser().is_absolute() else base / member.file
        try:
            experiment = _load_member(member, path, scale, overrides)
        except ExperimentError as error:
            faults += [f"experiments.{index} ({member.file}): {sentence}" for sentence in error.faults]
            continue
        except InputError as error:
            raise InputError(f"experiments.{index} ({member.file}): {error}") from None
        if experiment.name in members:
            faults.append(f"experiments.{index}: a second {experiment.name!r}; give it a `name` of its own")
        members[experiment.name] = experiment
    if faults:
        raise ExperimentError(faults)
    first, *others = members.values()
    for experiment in others:
        for field in ("store", "runs"):
            if getattr(experiment.outputs, field) != getattr(first.outputs, field):
                raise ExperimentError(
                    [
                        f"experiments: {experiment.name} and {first.name} have different outputs.{field}; members "
                        f"share one (--set outputs.{field}=DIR sets it for all)"
                    ]
                )
    return members


def _load_member(member: Member, path: Path, scale: str | None, overrides: Sequence[str]) -> Experiment:
    data = read_mapping(path)
    if "experiments" in data:
        raise InputError("is a collection itself; members must be experiments")
    data = apply_scale(data, scale)
    for dotted, value in member.overrides.items():
        data = override(data, dotted, value)
    if member.name:
        data["name"] = member.name
    for text in overrides:
        data = override(data, *parse_override(text))
    experiment = validate(data, path.resolve().parent)
    if experiment.sweep:
        raise InputError("has a sweep; run it by itself, or leave the sweep out with overrides: {sweep: []}")
    if experiment.realizations:
        expand_realizations(experiment)
    return experiment


def _roles(file: CollectionFile, members: Mapping[str, Experiment]) -> dict[str, str]:
    """Return the member for each role; raises ExperimentError if one is missing or cannot play its role."""
    papers = distinct_papers(paper for experiment in members.values() for paper in experiment.papers)
    shown = [role for figure in _comparisons(file) for role in figure.titles]
    known = list(dict.fromkeys([*(role for paper in papers for role in paper.roles), *shown]))
    for role, name in file.roles.items():
        if name not in members:
            raise ExperimentError([f"roles.{role} = {name!r}: not a member (there are: {', '.join(members)})"])
        if role not in known:
            listed = ", ".join(known) or "none, for no member names a paper"
            raise ExperimentError([f"roles.{role}: not a role of the members' papers or of a figure ({listed})"])
        if (refusal := refusal_of_role(papers, role, members[name])) is not None:
            raise ExperimentError([f"roles.{role} = {name!r}: {refusal}"])
    return file.roles | members_by_role(papers, members, file.roles)
