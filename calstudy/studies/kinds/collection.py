"""Collections: several experiments that are run together, share products, and are compared."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, Field, model_validator
from rich.console import Console

from calstudy.base.errors import ExperimentError, InputError, errors_of_files
from calstudy.base.files import sha256
from calstudy.base.identity import identity
from calstudy.base.schema import Section, fault
from calstudy.claims.evaluation import claims, members_by_role, refusal_of_role
from calstudy.claims.paper import distinct_papers, unique_notes
from calstudy.experiment.files import StudyFile, apply_scale, checked, overridden, read_mapping, validate
from calstudy.experiment.model import Experiment, Figures, StudyName
from calstudy.figures import StudyFigure, figure_task, figures_for
from calstudy.results.reader import MANIFEST, RunFolder
from calstudy.run.store import Product, Store
from calstudy.run.task import Task
from calstudy.studies.kinds.experiment import ExperimentStudy, Family, study_of
from calstudy.studies.study import KINDS, kind_of


class Member(Section):
    """One experiment of the collection; a file name alone is allowed in place of the block."""

    # The file is read as that of a study, and named in messages as it is written.
    holds_input_files: ClassVar[bool] = False

    file: Path = Field(description="The experiment file; a relative path starts at the collection file.")
    name: StudyName | None = Field(None, description="Replaces the experiment's own name.")
    overrides: dict[str, Any] = Field(
        default_factory=dict,
        description="Fields to change (dotted path: value); relative paths start at the folder of `file`.",
    )


def _block(member: Any) -> Any:
    return {"file": member} if isinstance(member, str) else member


MemberOrFile = Annotated[Member, BeforeValidator(_block, json_schema_input_type=str | Member)]


class CollectionFile(Section):
    """Several experiments that are run together, share products, and are compared."""

    name: StudyName = Field(description="Names the folder of the combined figures and claims.")
    description: str = ""
    experiments: Annotated[tuple[MemberOrFile, ...], Field(min_length=1)] = Field(
        description="Experiment files, each with its own run folder."
    )
    figures: Figures = Field((), description="Figures that compare members, such as layouts and spherical-comparison.")
    roles: dict[str, str] = Field(
        default_factory=dict,
        description="Which member plays which role in the members' papers and in figures, where its name does not say.",
    )

    @model_validator(mode="after")
    def _names_no_one_twice(self) -> CollectionFile:
        names = [member.name for member in self.experiments if member.name]
        if twice := [name for name in names if names.count(name) > 1]:
            raise fault("experiments", f"gives the name {twice[0]!r} twice")
        return self


@dataclass(frozen=True, eq=False)
class Collection(Family):
    """Several experiments, and the figures and claims that compare them.

    `members` are in the order of the file, all with the same store and folder of runs; `roles` has the member by the
    role that it plays in its papers. `finished` has the run folders of members that were run before and whose tables
    are in the store: the collection does not run them, and needs nothing else of them.
    """

    key = "experiments"
    model = CollectionFile
    heading = "Collection files"
    guide = (
        "A file with the key `experiments` is a collection. `python -m calstudy run` makes every member in its own run "
        "folder, and figures and claims of all of them in the folder of the collection; `--scale` and `--set` go to "
        "every member."
    )

    roles: Mapping[str, str]
    finished: Mapping[str, Path] = field(default_factory=dict)

    @classmethod
    def load(cls, file: StudyFile) -> Collection:
        """Return the collection of a file, whose scale and overrides go to every member."""
        content = checked(CollectionFile, file.content, file.folder)
        members = _load_members(content, file)
        roles = _roles(content, members)
        for figure in figures_for("collection", content.figures, "figures"):
            missing = [role for role in figure.roles(roles) if role not in roles]
            if missing:
                raise ExperimentError(
                    [f"figures: asks for {figure.label!r}, which needs a member in the role(s) {', '.join(missing)}"]
                )
        return cls(content, members, roles)

    def with_finished(self, folders: Sequence[Path], console: Console, *, planned: bool = False) -> Self:
        """Return the collection with members taken from finished runs of the same studies.

        The tables of such a member are put into the store, unless this is only `planned`, and it is not run again.
        Raises InputError if no member is found, the store has other results of a member, or it cannot be written.
        """
        runs, store = find_finished(folders), Store(self.outputs.store)
        taken: dict[str, FinishedRun] = {}
        for name, study in self.studies.items():
            if (reason := _needs_more(self, name, study)) is not None:
                console.print(f"{name}: will be run ({reason})", markup=False)
                continue
            if (run := _choose(name, study, runs, console)) is not None:
                taken[name] = run
        if not taken:
            given = ", ".join(str(folder) for folder in folders)
            members = ", ".join(self.members)
            raise InputError(f"--finished {given}: no finished run of a member is there (members: {members})")
        for name, run in taken.items():
            for task in self.studies[name].tables:
                there = store.verify(task.stage.name, task.key)
                if there is not None:
                    _require_same(there, run.entries[task.key]["files"], run, store)
                elif not planned:
                    _put(task, run, store)
        return replace(self, finished={**self.finished, **{name: run.path for name, run in taken.items()}})

    def member(self, label: str) -> ExperimentStudy:
        """Return the study of a member, which may have realizations."""
        return _member(self.members[label])

    @property
    def to_run(self) -> Mapping[str, ExperimentStudy]:
        """The members that were not run before."""
        return {name: study for name, study in self.studies.items() if name not in self.finished}

    @property
    def parts(self) -> Mapping[str, ExperimentStudy]:
        """The members that are run."""
        return self.to_run

    @property
    def external_keys(self) -> frozenset[str]:
        """Keys of the tables of members that were run before."""
        return frozenset(task.key for name in self.finished for task in self.studies[name].tables)

    @property
    def content(self) -> Any:
        """The run folders of the members, their roles, and the figures."""
        members = {name: study.folder.name for name, study in self.studies.items()}
        return {"members": members, "roles": self.roles, "figures": identity(self.file.figures)}

    @property
    def texts(self) -> Mapping[str, str]:
        """Nothing: the members have their own files, and the manifest says which."""
        return {}

    @cached_property
    def figures(self) -> list[Task]:
        """The figures that compare members."""
        return [self._figure(figure) for figure in figures_for("collection", self.file.figures, "figures")]

    def _figure(self, figure: StudyFigure) -> Task:
        compared = {role: self.studies[self.roles[role]] for role in figure.roles(self.roles)} or dict(self.studies)
        notes = unique_notes(note for study in compared.values() for note in study.stand_ins)
        return figure_task(figure, {label: study.graph for label, study in compared.items()}, notes)

    @cached_property
    def claims(self) -> Task | None:
        """The statements of the members' papers, each evaluated on the members that play its roles, or None."""
        runs = {name: study.evaluated for name, study in self.studies.items()}
        papers = distinct_papers(paper for experiment in self.members.values() for paper in experiment.papers)
        return claims(self.name, papers, runs, self.stand_ins, self.roles)

    def _place(self, name: str) -> str:
        """Return the path of a member's folder, relative to the folder of runs."""
        if name in self.finished:
            return os.path.relpath(self.finished[name].resolve(), self.folder.parent)
        return self.studies[name].folder.name

    @property
    def recorded(self) -> list[Task]:
        """The products of the collection itself, and the tables of members that were run before."""
        return [*(task for name in self.finished for task in self.studies[name].tables), *self.own]

    @property
    def entries(self) -> Mapping[str, Any]:
        """The folders of the members, relative to the folder of runs, their roles, and the figures."""
        return {
            "members": {name: self._place(name) for name in self.members},
            "roles": self.roles,
            "figures": [figure.model_dump(mode="json") for figure in self.file.figures],
        }


def _member(experiment: Experiment) -> ExperimentStudy:
    study = study_of(experiment)
    if not isinstance(study, ExperimentStudy):
        raise InputError(
            f"has a {study.key}; run it by itself, or leave the {study.key} out with overrides: {{{study.key}: []}}"
        )
    return study


def _load_members(content: CollectionFile, file: StudyFile) -> dict[str, Experiment]:
    members: dict[str, Experiment] = {}
    faults = []
    for index, member in enumerate(content.experiments):
        try:
            experiment = _load_member(member, file)
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
    faults = [
        f"experiments: {experiment.name} and {first.name} have different outputs.{name}; members share one "
        f"(--set outputs.{name}=DIR sets it for all)"
        for experiment, name in itertools.product(others, ("store", "runs"))
        if getattr(experiment.outputs, name) != getattr(first.outputs, name)
    ]
    if faults:
        raise ExperimentError(faults[:1])
    return members


def _load_member(member: Member, file: StudyFile) -> Experiment:
    path = file.folder / member.file.expanduser()
    data = read_mapping(path)
    if (kind := kind_of(data, path.parent)).model is not Experiment:
        raise InputError(f"has the key {kind.key or KINDS.tag!r}; members must be experiments")
    data = overridden(apply_scale(data, file.scale), member.overrides)
    if member.name:
        data["name"] = member.name
    changed = StudyFile(path, data, None, file.overrides)
    experiment = validate(changed.changed(), changed.folder)
    _member(experiment)
    return experiment


def _roles(file: CollectionFile, members: Mapping[str, Experiment]) -> dict[str, str]:
    """Return the member for each role; raises ExperimentError if one is missing or cannot play its role."""
    papers = distinct_papers(paper for experiment in members.values() for paper in experiment.papers)
    shown = [role for figure in figures_for("collection", file.figures, "figures") for role in figure.titles]
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


TABLES = "tables"


class FinishedRun(RunFolder):
    """A finished run, or a reference with its tables."""

    @cached_property
    def entries(self) -> dict[str, Mapping[str, Any]]:
        """The manifest's entries, by key, of the products whose files are the tables."""
        return {entry["key"]: entry for entry in self.products if isinstance(entry.get("files"), dict)}

    def is_readable(self) -> bool:
        """Return whether the manifest is that of a run."""
        try:
            return self.entries is not None
        except (InputError, KeyError, TypeError, AttributeError):
            return False

    def refusal(self, study: ExperimentStudy) -> str | None:
        """Return why a study cannot be taken from this run, or None if its tables are present and unchanged."""
        if not self.entries:
            return (
                "its manifest does not list the files of its tables: it is of an older version, or not of an experiment"
            )
        if not all(task.key in self.entries for task in study.tables):
            return "its tables are of other settings, or another version of a stage"
        for task in study.tables:
            for name, digest in self.entries[task.key]["files"].items():
                path = self.path / TABLES / name
                if Path(name).name != name or not path.is_file() or sha256(path) != digest:
                    return f"{TABLES}/{name} is not what the run wrote: it was changed or lost"
        return None


def find_finished(folders: Sequence[Path]) -> list[FinishedRun]:
    """Return the readable runs among folders and directly below; raises InputError if one is none and has none."""
    found = []
    for folder in folders:
        inside = [folder / MANIFEST] if (folder / MANIFEST).is_file() else sorted(folder.glob(f"*/{MANIFEST}"))
        runs = [run for run in (FinishedRun(path.parent) for path in inside) if run.is_readable()]
        if not runs:
            raise InputError(f"--finished {folder}: is not the folder of a finished run, and holds none")
        found += runs
    return found


def _choose(name: str, study: ExperimentStudy, runs: Sequence[FinishedRun], console: Console) -> FinishedRun | None:
    """Return the run that a member is taken from, or None; print the choice, or the reasons against it."""
    refusals = [run.refusal(study) for run in runs]
    if None in refusals:
        chosen = runs[refusals.index(None)]
        finished = chosen.manifest.get("finished", "at an unknown time")
        console.print(f"{name}: taken from {chosen.path} (finished {finished})", markup=False)
        return chosen
    for other, refusal in zip(runs, refusals, strict=True):
        if other.name == name:
            console.print(f"{name}: {other.path} is left out; {refusal}", markup=False)
    console.print(f"{name}: will be run", markup=False)
    return None


def _needs_more(collection: Collection, name: str, study: ExperimentStudy) -> str | None:
    """Return the reason why a collection needs more of a member than its tables, or None."""
    if not study.keeps_tables:
        return "it has realizations; such members are always run"
    tables = {task.key for task in study.tables}
    others = {task.key for task in study.tasks} - tables
    for task in collection.own:
        for needed in task.needs.values():
            if needed.key in others:
                return f"{task.label} needs of {name} what is no table: {needed.stage.name} ({needed.label})"
    return None


def _put(task: Task, run: FinishedRun, store: Store) -> None:
    """Put a table of a run into a store, under the key of its product."""
    entry, stage = run.entries[task.key], task.stage.name
    store.prepare()
    unwritten = errors_of_files(f"outputs.store = {str(store.root)!r}: cannot be written")
    with store.lock(stage, task.key), store.building(stage, task.key) as folder, unwritten:
        for name in entry["files"]:
            shutil.copyfile(run.path / TABLES / name, folder / name)
        kept = {key: value for key, value in entry.items() if key not in ("files", "made_by_this_run")}
        origin = {key: run.manifest.get(key) for key in ("name", "finished", "git_commit")}
        store.seal(folder, {"lineage": "", **kept, "stage": stage, "temporary": False, "from_run": origin})


def _require_same(there: Product, files: Mapping[str, str], run: FinishedRun, store: Store) -> None:
    """Raise InputError if a table of the store differs from that of a run: two runs of a study differ by rounding."""
    found = {name: file["sha256"] for name, file in there.record["files"].items()}
    other = next((name for name in {**files, **found} if files.get(name) != found.get(name)), None)
    if other is not None:
        raise InputError(
            f"--finished {run.path}: {TABLES}/{other} differs from that of the same study in the store {store.root}; "
            "leave this folder out to use the store, or use another store with --set outputs.store=DIR"
        )
