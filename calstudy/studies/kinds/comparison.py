"""Comparisons: several calibrators in several worlds, with the same scores."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, field_validator

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.plugins import guarded
from calstudy.base.schema import Section, fault
from calstudy.calibrate.calibrators.given_gains import salted
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.claims.paper import stand_ins
from calstudy.experiment.files import (
    StudyFile,
    apply_scale,
    checked,
    dump,
    dump_yaml,
    overridden,
    override,
    parse_override,
    read_mapping,
    require_scales,
    validate,
    with_absolute_paths,
)
from calstudy.experiment.model import FIGURES, SIGNAL_LOSS_VARIANTS, Experiment, Figures, StudyName
from calstudy.figures import StudyFigure, figures_for
from calstudy.products import corruption, sky_model, tolerances
from calstudy.products.comparison import case_name, comparison
from calstudy.products.corruption import PARITIES
from calstudy.products.graph import Graph, required
from calstudy.products.score import MeasureScore, score
from calstudy.run.execution import Budget
from calstudy.run.task import Task
from calstudy.studies.folder import EXPERIMENT
from calstudy.studies.kinds.experiment import ExperimentStudy, Family, fields_of, study_of, what_is_made
from calstudy.studies.preflight import refusal_of_calibrator
from calstudy.studies.study import KINDS, kind_of

LONGEST_LABEL = 40
NOT_SHARED = ("calibration", "sweep", "realizations", "scales")
"""Keys of the experiment that the cases do not take from it, but for `calibration.assumed`."""
OF_CALIBRATORS = ("assumed", CALIBRATORS.tag, "solver", "chunks")
"""Fields of the calibration of that experiment which belong to worlds, to a calibrator, or change no result."""
CALIBRATOR = f"calibration.{CALIBRATORS.tag}"
OWN = ("name", "description", "calibrators", "worlds", "figures", "salt")
"""Keys of a comparison that --set changes in the file itself; all others are fields of the experiment."""
WITHOUT_EFFECT = ("name", "description", "papers", "outputs.figures", "outputs.tables", *NOT_SHARED[1:])
"""Fields of an experiment that make nothing in a comparison, whose cases have scores alone."""
VARIANTS_NEEDED = (
    "variants: must have residual and residual_without_eor, calibrated and different in the EoR alone, and eor"
)


def _block(block: Any) -> Any:
    return {CALIBRATORS.tag: block} if isinstance(block, str) else block


Block = Annotated[dict[str, Any], BeforeValidator(_block, json_schema_input_type=str | dict[str, Any])]


def _refusal(path: str, new: Any) -> str | None:
    """Return why a change of the experiment of all cases, or of those of a world, is refused; None if it is not."""
    if path in ("calibration", CALIBRATOR):
        return "changes the calibrator, which each entry of calibrators names"
    changed = {path: new, **({f"{path}.{name}": item for name, item in new.items()} if isinstance(new, dict) else {})}
    for field in WITHOUT_EFFECT:
        if any(value and f"{name}.".startswith(f"{field}.") for name, value in changed.items()):
            return f"changes {field}, which has no effect: a comparison has scores, and figures of its own"
    return None


class ComparisonFile(Section):
    """Calibrators times worlds, made from one experiment."""

    name: StudyName
    description: str = ""
    experiment: Path | dict[str, Any] = Field(
        description="The experiment that all cases start from: a file, whose relative path starts at this one, or the "
        "experiment itself."
    )
    overrides: dict[str, Any] = Field(
        default_factory=dict, description="Fields of the experiment to change in all cases (dotted path: value)."
    )
    calibrators: dict[str, Block] = Field(
        min_length=1,
        description="A block `calibration` for each calibrator by a label, or the calibrator's name alone. It takes "
        "the place of the experiment's own, but for what that assumes (`calibration.assumed`).",
    )
    worlds: dict[str, dict[str, Any]] = Field(
        {"ideal": {}},
        min_length=1,
        description="Changes of the experiment by a label (dotted path: value): of what is true, or of what is assumed "
        "(`calibration.assumed`). Neither the calibrator nor `power` may differ between worlds.",
    )
    figures: Figures = Field(
        default_factory=lambda: tuple(FIGURES.make(name) for name in ("comparison-matrix", "comparison-spectra")),
        description="Figures of all cases: comparison-matrix, comparison-spectra, comparison-curves.",
    )
    salt: str = Field(
        "", description="Of a blind challenge (`calstudy export --blind`): digests of its data are made with it."
    )
    scales: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Named sets of changes to this file; the experiment's own come first."
    )

    @field_validator("calibrators", "worlds")
    @classmethod
    def _has_plain_labels(cls, value: dict[str, Any]) -> dict[str, Any]:
        for label in value:
            if not 0 < len(label.strip()) <= LONGEST_LABEL or not re.search(r"\w", label):
                raise fault("", f"the label {label!r} must have 1 to {LONGEST_LABEL} characters, one a letter or digit")
        return value

    @field_validator("overrides")
    @classmethod
    def _have_an_effect(cls, value: dict[str, Any]) -> dict[str, Any]:
        for path, new in value.items():
            # Fields of the block `calibration` are those of all calibrators.
            own = path == "calibration" and isinstance(new, dict) and CALIBRATORS.tag not in new
            if not own and (refusal := _refusal(path, new)) is not None:
                raise fault("", f"{path!r} {refusal}")
        return value

    @field_validator("worlds")
    @classmethod
    def _change_no_measurement(cls, value: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for label, changes in value.items():
            for path, new in changes.items():
                block, _, rest = path.partition(".")
                if (refusal := _refusal(path, new)) is not None:
                    raise fault("", f"{label!r} {refusal}")
                if block == "power":
                    raise fault("", f"{label!r} changes {path}; all cases are measured alike, use overrides")
                if not rest and isinstance(new, dict):
                    fields = ", ".join(f"{path}.{name}" for name in new)
                    raise fault("", f"{label!r} replaces all of {path}; give the fields that change ({fields})")
        try:
            tolerances.faults(list(value))
        except InputError as error:
            raise fault("", str(error)) from None
        return value


@dataclass(frozen=True)
class Case:
    """One calibrator in one world, with the reason, which may be empty, why it cannot work there."""

    calibrator: str
    world: str
    experiment: Experiment
    refusal: str = ""

    @property
    def title(self) -> str:
        """Calibrator and world."""
        return f"{self.calibrator} in {self.world}"


class _CaseStudy(ExperimentStudy):
    """A case: its scores alone, without calibrated visibilities in the store because there are many cases."""

    @cached_property
    def graph(self) -> Graph:
        """The products of the case."""
        return Graph(self.experiment, keep_visibilities=False)

    @property
    def targets(self) -> list[Task]:
        """The scores."""
        return [required(score(self.graph))]


@dataclass(frozen=True, eq=False)
class Comparison(Family):
    """Calibrators in worlds, without those that cannot work in a world, for which the table has the reason.

    Members are the experiments of all cases by `case_name`, ordered by world and then by calibrator. `refusals` has the
    reason of those that cannot work. `resolved` is the file with its experiment in it, and with all changes applied.
    """

    key = "calibrators"
    model = ComparisonFile
    heading = "Comparison files"
    guide = (
        "A file with the key `calibrators` is a comparison. `python -m calstudy run` calibrates the data of each world "
        "with each calibrator, and compares the results in tables and figures; `--set` changes the experiment of every "
        "case."
    )
    subfolders = ("cases",)

    refusals: Mapping[str, str]
    resolved: Mapping[str, Any]

    @classmethod
    def load(cls, file: StudyFile, calibrators: Mapping[str, Any] | None = None) -> Comparison:
        """Return the comparison of a file, perhaps with other calibrators.

        Its scale is in the `scales` of the file, of the experiment, or of both. Overrides that begin with a key of
        `OWN` change the file, such as ``worlds={ideal: {}}`` or ``calibrators.redcal.max_steps=50``; all others are
        applied to the experiment of every case. Errors are as for `calstudy.studies.load.load_study`.
        """
        content, base, overrides, worlds = _read(file, calibrators)
        members = _experiments(content, worlds, base, lambda data: validate(data, file.folder))
        refusals = {label: refusal for label in members if (refusal := refusal_of_calibrator(members[label]))}
        cases, count = list(members.values()), len(content.calibrators)
        _require_different("worlds", {world: cases[row * count :][:count] for row, world in enumerate(worlds)})
        _require_different("calibrators", {label: cases[at::count] for at, label in enumerate(content.calibrators)})

        def check(scale: str | None) -> None:
            content, base, _, worlds = _read(replace(file, scale=scale, overrides=()), calibrators)
            _experiments(content, worlds, base, lambda data: checked(Experiment, data, file.folder, files=False))

        require_scales(file.content, check, () if file.overrides else (file.scale,))
        figures = figures_for("comparison", content.figures, "figures")
        # All others are in the experiment.
        of_calibrators = {path: new for path, new in overrides.items() if path.partition(".")[0] == "calibration"}
        written = {"overrides": of_calibrators, "worlds": worlds, "calibrators": dict(content.calibrators)}
        # Defaults and absolute paths, so that it does not depend on its folder.
        resolved = {
            "name": content.name,
            "description": content.description,
            "experiment": _shared(validate(_shared(base), file.folder).model_dump(mode="json")),
            **with_absolute_paths(written, members.values(), file.folder),
            "figures": [figure.model_dump(mode="json") for figure in figures],
            **({"salt": content.salt} if content.salt else {}),
        }
        return cls(content, members, refusals, resolved)

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        """All cases, in the order of the members."""
        labels = itertools.product(self.file.worlds, self.file.calibrators)
        return tuple(
            Case(calibrator, world, experiment, self.refusals.get(label, ""))
            for (world, calibrator), (label, experiment) in zip(labels, self.members.items(), strict=True)
        )

    @cached_property
    def studies(self) -> Mapping[str, ExperimentStudy]:
        """The cases that are not refused."""
        return {label: _CaseStudy(self.members[label]) for label in self.members if label not in self.refusals}

    def title(self, label: str) -> str:
        """Return the calibrator and the world of a case."""
        return self.cases[list(self.members).index(label)].title

    @property
    def content(self) -> Any:
        """The experiments of the cases, as far as they decide what is made, and the figures."""
        cases = [(case.world, case.calibrator, identity(what_is_made(case.experiment))) for case in self.cases]
        return {"cases": cases, "figures": identity(self.file.figures)}

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the comparison cut to the memory; raises InputError if no calibrator can work in any world."""
        if not self.studies:
            raise InputError(f"calibrators: all refuse; {self.cases[0].calibrator}: {self.cases[0].refusal}")
        return super().sized_to(budget)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of all cases for the papers' own ingredients; their worlds give those of single cases."""
        first, *others = [stand_ins(case.experiment) for case in self.cases]
        return tuple(note for note in first if all(note in found for found in others))

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of the cases, and which calibrators cannot work where."""
        worlds: dict[tuple[str, str], list[str]] = {}
        for world, calibrator, reason in self.refused:
            worlds.setdefault((calibrator, reason), []).append(world)
        count = len(self.file.worlds)
        refused = (
            f"{calibrator} cannot work in {'any world' if len(found) == count else ', '.join(found)}: {reason}"
            for (calibrator, reason), found in worlds.items()
        )
        return (*super().notes, *self._left_out, *refused)

    @cached_property
    def _left_out(self) -> list[str]:
        """A note for settings of the calibration in the file of the experiment that no case has."""
        source = self.file.experiment
        given = read_mapping(source).get("calibration") if isinstance(source, Path) else None
        known = (*OF_CALIBRATORS, *(path.removeprefix("calibration.") for path in self.resolved["overrides"]))
        lost = [field for field in given if field not in known] if isinstance(given, Mapping) else []
        named = f"calibration.{', '.join(lost)} of {Path(source).name}" if lost else ""
        return [f"{named} is not that of the calibrators; for all of them, set it in overrides"] if lost else []

    @property
    def refused(self) -> list[tuple[str, str, str]]:
        """World, calibrator and reason of the cases that are refused."""
        return [(case.world, case.calibrator, case.refusal) for case in self.cases if case.refusal]

    @property
    def _labels(self) -> dict[str, Any]:
        """Labels of calibrators and worlds, and refusals."""
        file = self.file
        return {"calibrators": list(file.calibrators), "worlds": list(file.worlds), "refusals": self.refused}

    @cached_property
    def scores(self) -> dict[str, MeasureScore]:
        """The scores of every case that is not refused."""
        return {label: required(score(study.graph)) for label, study in self.studies.items()}

    @cached_property
    def tables(self) -> list[Task]:
        """The table of all cases."""
        firsts = [case_name(row, 0) for row in range(len(self.file.worlds))]
        changed = zip(self.resolved["worlds"].items(), firsts, strict=True)
        fields = {world: fields_of(self.members[first], [changes]) for (world, changes), first in changed}
        return [comparison(self.name, {**self._labels, "fields": fields}, self.scores, self.stand_ins)]

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        return [self._figure(figure) for figure in figures_for("comparison", self.file.figures, "figures")]

    def _figure(self, figure: StudyFigure) -> Task:
        with guarded(figure):
            first, *others = [figure.settings(study.graph) for study in self.studies.values()] or [{}]
        common = {key: value for key, value in first.items() if all(other.get(key) == value for other in others)}
        return self.draw(figure, {**self._labels, **common})

    @property
    def _files(self) -> dict[str, Case]:
        return {f"cases/{number:03d}.yaml": case for number, case in enumerate(self.cases)}

    @property
    def texts(self) -> Mapping[str, str]:
        """The file with its experiment, and the experiment of every case."""
        return {
            EXPERIMENT: dump_yaml(self.resolved),
            **{name: dump(case.experiment) for name, case in self._files.items()},
        }

    @property
    def entries(self) -> Mapping[str, Any]:
        """The files of the experiments of the cases, and the refusals."""
        files = {case.title: name for name, case in self._files.items()}
        return {"cases": files, "refusals": self.refused}


@dataclass(frozen=True)
class WorldData:
    """The tasks of the exported products of one experiment; the salt of a blind challenge may be empty.

    Data sets are in the order of their digests, which does not reveal their content.
    """

    experiment: Experiment
    data: tuple[Task, ...]
    sky_model: Task | None
    noise_level: Task | None
    salt: str = ""

    @classmethod
    def of(cls, experiment: Experiment, salt: str = "") -> WorldData:
        """Return the exported products of an experiment."""
        graph = Graph(experiment)
        variants = [experiment.variants[name] for name in SIGNAL_LOSS_VARIANTS[:2]]
        found = [corruption.data(graph, variant, parity) for variant in variants for parity in PARITIES]
        data = sorted({task.key: task for task in found}.values(), key=lambda task: salted(task.key, salt))
        noisy = any("noise" in variant.components for variant in variants)
        noise_level = corruption.noise_level(graph, variants[0]) if noisy else None
        return cls(experiment, tuple(data), sky_model.sky_model(graph), noise_level, salt)

    @property
    def digest(self) -> str:
        """Digest of all data sets and the sky model."""
        whole = digest_json([*sorted(task.key for task in self.data), self.sky_model and self.sky_model.key])
        return salted(whole, self.salt)

    @property
    def tasks(self) -> list[Task]:
        """All tasks."""
        return [*self.data, *(task for task in (self.sky_model, self.noise_level) if task is not None)]


def load_worlds(
    path: Path, scale: str | None, overrides: Sequence[str], calibrators: Mapping[str, Any] | None
) -> Comparison:
    """Return calibrators in the worlds of a comparison, or in the one of an experiment.

    `calibrators` are blocks `calibration` by label, in place of those of the file, with the assumptions of the
    experiment. Raises InputError if the file is neither, or cannot be used.
    """
    file = StudyFile.open(path, scale, overrides)
    kind = kind_of(file.content, file.folder)
    if kind is Comparison:
        return Comparison.load(file, calibrators)
    if kind.model is Experiment:
        experiment = file.experiment()
        kind = type(study_of(experiment, file.folder))
    if kind is not ExperimentStudy:
        raise InputError(
            f"{file.path}: has the key {kind.key or KINDS.tag!r}; a single experiment or a comparison is needed"
        )
    plain = experiment.model_dump(mode="json")
    blocks = calibrators or {experiment.calibration.label[:LONGEST_LABEL]: plain["calibration"]}
    content = {
        "name": experiment.name,
        "description": experiment.description,
        "experiment": _shared(plain),
        "calibrators": dict(blocks),
        "worlds": {experiment.name[:LONGEST_LABEL]: {}},
    }
    return Comparison.load(StudyFile(file.path, content))


def _changed(data: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a comparison's content with one of its own keys, an entry by its label, or a field of it changed."""
    key, _, rest = path.partition(".")
    if not rest:
        return {**data, key: value}
    entries = data.get(key)
    if key not in ("calibrators", "worlds") or not isinstance(entries, Mapping):
        raise InputError(f"--set {path}: set {key} as a whole")
    label = max((known for known in entries if f"{rest}.".startswith(f"{known}.")), key=len, default=rest)
    if field := rest[len(label) + 1 :]:
        entry = _block(entries.get(label)) or {}
        value = {**entry, field: value} if key == "worlds" else override(entry, field, value)
    return {**data, key: {**entries, label: value}}


def _with_changes(
    content: ComparisonFile, changes: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the overrides and the worlds of a comparison with changes of --set, which come after both."""
    overrides = dict(content.overrides)
    worlds = {world: dict(fields) for world, fields in content.worlds.items()}
    for path, value in changes.items():
        if path.partition(".")[0] in ("experiment", "overrides"):
            raise InputError(f"--set {path}: set fields of the experiment by their own paths, or {', '.join(OWN)}")
        if (refusal := _refusal(path, value)) is not None:
            raise InputError(f"--set {path}: {refusal}")
        # Blocks of calibrators come after overrides, and before worlds.
        for_all = path.startswith("calibration.")
        if not for_all:
            overrides = {**_without(overrides, path), path: value}
        for world, fields in worlds.items():
            kept = _without(fields, path)
            again = for_all or any(path.startswith(f"{field}.") for field in kept)
            worlds[world] = {**kept, path: value} if again else kept
    return overrides, worlds


def _without(changes: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Return changes without those of a field and of fields in it."""
    return {field: own for field, own in changes.items() if not f"{field}.".startswith(f"{path}.")}


def _shared(experiment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that all cases have; what is assumed is part of the world, not of a calibrator."""
    shared = {key: value for key, value in experiment.items() if key not in NOT_SHARED}
    calibration = experiment.get("calibration")
    assumed = calibration.get("assumed") if isinstance(calibration, Mapping) else None
    return {**shared, "calibration": {"assumed": assumed}} if assumed else shared


def _require_effect(calibration: Any) -> None:
    """Raise ExperimentError if an experiment in the comparison's own file has settings that no case would have."""
    if isinstance(calibration, Mapping) and (lost := [field for field in calibration if field != "assumed"]):
        raise ExperimentError(
            [
                f"experiment.calibration.{field}: has no effect, as each calibrator has its own block; for all of "
                f"them, set calibration.{field} in overrides"
                for field in lost
            ]
        )


def _read(
    file: StudyFile, calibrators: Mapping[str, Any] | None
) -> tuple[ComparisonFile, dict[str, Any], dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the changed content, the experiment that all cases start from, its overrides, and the worlds."""
    scales = file.content.get("scales")
    own = file.scale if isinstance(scales, dict) and file.scale in scales else None
    data = apply_scale(file.content, own)
    changes = dict(parse_override(text) for text in file.overrides)
    for dotted in [dotted for dotted in changes if dotted.partition(".")[0] in OWN]:
        data = _changed(data, dotted, changes.pop(dotted))
    if calibrators is not None:
        data[Comparison.key] = dict(calibrators)
    content = checked(ComparisonFile, data, file.folder)
    overrides, worlds = _with_changes(content, changes)
    return content, overridden(_base(content, file, optional=own is not None), overrides), overrides, worlds


def _base(content: ComparisonFile, file: StudyFile, optional: bool) -> dict[str, Any]:
    """Return the experiment from which all cases are made; it may lack the scale if that is `optional`."""
    scale, folder = file.scale, file.folder
    if isinstance(content.experiment, dict):
        base: dict[str, Any] = content.experiment
        _require_effect(base.get("calibration"))
    else:
        base, folder = read_mapping(content.experiment), content.experiment.parent
    if (kind := kind_of(base, folder)).model is not Experiment:
        raise ExperimentError([f"experiment: has the key {kind.key or KINDS.tag!r}, and is no single experiment"])
    has_it = scale in (base.get("scales") or {})
    base = apply_scale(base, scale if has_it or not optional else None)
    if many := [key for key in ("sweep", "realizations") if base.get(key)]:
        raise ExperimentError(
            [f"experiment: has {many[0]}, which a comparison does not make: name a file without, or leave it out"]
        )
    base = _shared(base)
    if folder == file.folder:
        return base
    try:
        return _shared(validate(base, folder).model_dump(mode="json", exclude_unset=True))
    except ExperimentError as error:
        raise ExperimentError([f"experiment ({content.experiment}): {fault}" for fault in error.faults]) from None


def _experiments(
    content: ComparisonFile,
    worlds: Mapping[str, Mapping[str, Any]],
    base: Mapping[str, Any],
    read: Callable[[Mapping[str, Any]], Experiment],
) -> dict[str, Experiment]:
    """Return the experiments of all cases, as they are read; raises ExperimentError with every fault once."""
    members: dict[str, Experiment] = {}
    faults: dict[str, list[str]] = {}
    for (row, world), (column, calibrator) in itertools.product(enumerate(worlds), enumerate(content.calibrators)):
        block = content.calibrators[calibrator]
        salt = {"salt": content.salt} if content.salt and block.get(CALIBRATORS.tag) == "by-file" else {}
        data = {**base, "calibration": {**base.get("calibration", {}), **block, **salt}}
        try:
            experiment = read(overridden(data, worlds[world]))
            found = [] if experiment.measures_signal_loss else [VARIANTS_NEEDED]
            members[case_name(row, column)] = experiment
        except ExperimentError as error:
            found = error.faults
        for sentence in found:
            faults.setdefault(sentence, []).append(f"{calibrator} in {world}")
    if faults:
        raise ExperimentError([f"{sentence} (in {_listed(found)})" for sentence, found in faults.items()])
    return members


def _require_different(key: str, cases: Mapping[str, Sequence[Experiment]]) -> None:
    """Raise ExperimentError if two worlds, or two calibrators, have the same experiments, whose cases are the same."""
    seen: dict[str, str] = {}
    for label, members in cases.items():
        same = seen.setdefault(digest_json([identity(what_is_made(member)) for member in members]), label)
        if same != label:
            raise ExperimentError([f"{key}: {label!r} is the same as {same!r}; change a field in it, or remove it"])


def _listed(cases: Sequence[str]) -> str:
    """Name the first of some cases, and count the others."""
    others = len(cases) - 1
    return f"{cases[0]!r}" + (f" and {others} other case{'s' if others > 1 else ''}" if others else "")
