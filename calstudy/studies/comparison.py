"""Comparisons: several calibrators in several worlds, with the same scores."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import Field, SerializeAsAny, ValidationError, field_validator

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.identity import identity
from calstudy.base.plugins import Plugin
from calstudy.base.schema import Section, choice, fault
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.claims.paper import stand_ins
from calstudy.experiment.files import apply_scale, dump, override, parse_override, validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import FIGURES, Experiment, Outputs, StudyName
from calstudy.experiment.yaml_files import read_mapping
from calstudy.figures import CasesFigure, cases_task
from calstudy.products import tolerances
from calstudy.products.comparison import case_name, comparison
from calstudy.products.graph import Graph, required
from calstudy.products.score import score
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import CASES, EXPERIMENT, product_entries, publish, run_folder, write, write_manifest
from calstudy.studies.preflight import refusal_of_calibrator, require_possible
from calstudy.studies.study import Budget, Made, Study

KEY = "calibrators"
"""Key that marks a file as a comparison."""
LONGEST_LABEL = 40
NOT_SHARED = ("calibration", "sweep", "realizations", "scales")
"""Keys of the experiment that the cases do not take from it."""
OWN = ("name", "description", KEY, "worlds", "figures", "salt")
"""Keys of a comparison that --set changes in the file itself; all others are fields of the experiment."""
VARIANTS_NEEDED = (
    "variants: must have residual and residual_without_eor, calibrated and different in the EoR alone, and eor"
)

Block = Annotated[dict[str, Any], choice("calibrator")]


class ComparisonFile(Section):
    """Calibrators times worlds, made from one experiment."""

    name: StudyName
    description: str = ""
    experiment: Annotated[Path, Field(strict=False)] | dict[str, Any] = Field(
        description="The experiment that all cases start from: a file, whose relative path starts at this one, or the "
        "experiment itself."
    )
    overrides: dict[str, Any] = Field(
        default_factory=dict, description="Fields of the experiment to change in all cases (dotted path: value)."
    )
    calibrators: dict[str, Block] = Field(
        min_length=1,
        description="A block `calibration` for each calibrator by a label, or the calibrator's name alone. It takes "
        "the place of the experiment's own.",
    )
    worlds: dict[str, dict[str, Any]] = Field(
        {"ideal": {}},
        min_length=1,
        description="Changes of the experiment by a label (dotted path: value): of what is true, or of what is assumed "
        "(`calibration.assumed`). Neither the calibrator nor `power` may differ between worlds.",
    )
    figures: Annotated[tuple[Annotated[SerializeAsAny[Plugin], FIGURES.field()], ...], Field(strict=False)] = Field(
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

    @field_validator("worlds")
    @classmethod
    def _change_no_measurement(cls, value: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for label, changes in value.items():
            for path, new in changes.items():
                block, _, rest = path.partition(".")
                if path in ("calibration", "calibration.calibrator"):
                    raise fault("", f"{label!r} changes the calibrator, which each entry of calibrators names")
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
    """One calibrator in one world.

    The refusal is the reason why the calibrator cannot work there; it is empty if it can.
    """

    calibrator: str
    world: str
    experiment: Experiment
    refusal: str = ""


class Comparison(Study):
    """Calibrators in worlds, without those that cannot work in a world, for which the table has the reason.

    Products that several cases need have one key, and are made once. Cases are ordered by world and then by
    calibrator, as in the file; `resolved` is the file with its experiment in it, and with all changes applied.
    """

    def __init__(self, file: ComparisonFile, cases: Sequence[Case], resolved: Mapping[str, Any]) -> None:
        self.file, self.cases, self.resolved = file, tuple(cases), resolved
        self.name, self.description = file.name, file.description

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs."""
        return self.cases[0].experiment.outputs

    @property
    def folder(self) -> Path:
        """The run folder: the name, and a digest of the content of the file and its cases."""
        content = {
            "cases": [(case.world, case.calibrator, identity(_what_is_made(case.experiment))) for case in self.cases],
            "figures": identity(self.file.figures),
        }
        return run_folder(self.outputs.runs, self.name, content)

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the comparison with every case fitted, and the smallest number of workers of all."""
        if all(case.refusal for case in self.cases):
            raise InputError(f"calibrators: all refuse; {self.cases[0].calibrator}: {self.cases[0].refusal}")
        fitted, counts = [], []
        for case in self.cases:
            if case.refusal:
                fitted.append(case)
                continue
            try:
                require_possible(case.experiment)
                experiment, count = fit(case.experiment, budget, _targets_of)
            except InputError as error:
                raise InputError(f"{case.calibrator} in {case.world}: {error}") from None
            fitted.append(replace(case, experiment=experiment))
            counts.append(count)
        return type(self)(self.file, fitted, self.resolved), min(counts)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of all cases for the papers' own ingredients; their worlds give those of single cases."""
        first, *others = [stand_ins(case.experiment) for case in self.cases]
        return tuple(note for note in first if all(note in found for found in others))

    @cached_property
    def graphs(self) -> Mapping[str, Graph]:
        """The graphs of all cases."""
        calibrators, worlds = list(self.file.calibrators), list(self.file.worlds)
        return {
            case_name(worlds.index(case.world), calibrators.index(case.calibrator)): _graph(case.experiment)
            for case in self.cases
            if not case.refusal
        }

    @property
    def _labels(self) -> dict[str, Any]:
        """Labels of calibrators and worlds, and refusals: world, calibrator and reason."""
        return {
            "calibrators": list(self.file.calibrators),
            "worlds": list(self.file.worlds),
            "refusals": [[case.world, case.calibrator, case.refusal] for case in self.cases if case.refusal],
        }

    @cached_property
    def table(self) -> Task:
        """The table of all cases."""
        scores = {name: required(score(graph)) for name, graph in self.graphs.items()}
        return comparison(self.name, self._labels, scores, self.stand_ins)

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        return [cases_task(figure, self.graphs, self._labels, self.stand_ins) for figure in _shown(self.file)]

    @property
    def targets(self) -> Sequence[Task]:
        """The table and the figures."""
        return [self.table, *self.figures]

    def fill(self, made: Made) -> None:
        """Write figures, table, the file with its experiment, the experiment of every case, and the manifest."""
        folder = self.folder
        publish([made.products[task.key] for task in self.figures], folder / "figures")
        publish([made.products[self.table.key]], folder / "tables")
        write(folder / EXPERIMENT, yaml.safe_dump(self.resolved, sort_keys=False, allow_unicode=True, width=100))
        (folder / CASES).mkdir(exist_ok=True)
        files = {}
        for number, case in enumerate(self.cases):
            files[f"{case.calibrator} in {case.world}"] = name = f"{CASES}/{number:03d}.yaml"
            write(folder / name, dump(case.experiment))
        fields = {
            "description": self.description,
            "stand_ins": list(self.stand_ins),
            "captions": {figure.label: figure.caption for figure in _shown(self.file)},
            "cases": files,
            "refusals": self._labels["refusals"],
            "products": product_entries(self.tasks, made.products, made.tasks),
        }
        write_manifest(folder, self.name, fields)


def _what_is_made(experiment: Experiment) -> Experiment:
    """Return an experiment without the settings of products that only its own run makes."""
    outputs = experiment.outputs.with_defaults("store", "runs", "figures")
    return experiment.model_copy(update={"outputs": outputs}).with_defaults("scales", "name", "description", "papers")


def _graph(experiment: Experiment) -> Graph:
    """Return the graph of a case, which does not keep calibrated visibilities because there are many cases."""
    return Graph(experiment, keep_visibilities=False)


def _targets_of(experiment: Experiment) -> list[Task]:
    return [required(score(_graph(experiment)))]


def _shown(file: ComparisonFile) -> list[CasesFigure]:
    return [figure for figure in file.figures if isinstance(figure, CasesFigure)]


def load_comparison(
    path: Path,
    data: Mapping[str, Any],
    scale: str | None = None,
    overrides: Sequence[str] = (),
    calibrators: Mapping[str, Any] | None = None,
) -> Comparison:
    """Validate the content of a comparison file.

    Parameters
    ----------
    scale
        Name of a set of changes in the `scales` of the file, of the experiment, or of both.
    overrides
        ``path=value`` texts. Those that begin with a key of `OWN` change the file, such as ``worlds={ideal: {}}`` or
        ``calibrators.redcal.max_steps=50``; all others are applied to the experiment of every case.
    calibrators
        In place of those of the file.

    Raises
    ------
    InputError
        If a file cannot be read, or a scale or override cannot be applied.
    ExperimentError
        If fields are unknown, missing, or have values that are not allowed.
    """
    own = scale if scale in (data.get("scales") or {}) else None
    data = apply_scale(data, own)
    changes = dict(parse_override(text) for text in overrides)
    for dotted in [dotted for dotted in changes if dotted.partition(".")[0] in OWN]:
        data = _changed(data, dotted, changes.pop(dotted))
    if calibrators is not None:
        data[KEY] = dict(calibrators)
    folder = path.resolve().parent
    try:
        file = ComparisonFile.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise ExperimentError(sentences(error, ComparisonFile, data)) from None
    for place, figure in enumerate(file.figures):
        if not isinstance(figure, CasesFigure):
            built_in = [name for name in FIGURES.built_in() if issubclass(FIGURES.find(name), CasesFigure)]
            hint = f"does not compare calibrators{nearest(figure.label, built_in)} (built in: {', '.join(built_in)})"
            raise ExperimentError([f"figures.{place}: {figure.label!r} {hint}; ask for it in an experiment"])
    base, origin = _base(file, folder, scale, optional=own is not None)
    worlds = {world: {**fields, **changes} for world, fields in file.worlds.items()}
    salted = {"salt": file.salt} if file.salt else {}
    blocks = {
        label: {**block, **(salted if block.get(CALIBRATORS.tag) == "by-file" else {})}
        for label, block in file.calibrators.items()
    }
    cases = _make_cases(blocks, worlds, base, origin)
    figures = [figure.model_dump(mode="json") for figure in _shown(file)]
    said = {"name": file.name, "description": file.description, "experiment": _complete(base, origin), "worlds": worlds}
    return Comparison(file, cases, {**said, "calibrators": dict(file.calibrators), "figures": figures})


def _changed(data: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a comparison's content with one of its own keys, an entry by its label, or a field of it changed.

    Labels may contain dots. Fields of a world are dotted paths themselves.
    """
    key, _, rest = path.partition(".")
    if not rest:
        return {**data, key: value}
    entries = data.get(key)
    if key not in (KEY, "worlds") or not isinstance(entries, Mapping):
        raise InputError(f"--set {path}: set {key} as a whole")
    label = max((known for known in entries if f"{rest}.".startswith(f"{known}.")), key=len, default=rest)
    field, entry = rest[len(label) + 1 :], entries.get(label)
    if field and isinstance(entry, str):
        entry = {CALIBRATORS.tag: entry}
    if field:
        value = {**(entry or {}), field: value} if key == "worlds" else override(entry or {}, field, value)
    return {**data, key: {**entries, label: value}}


def _complete(base: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return an experiment with its defaults and absolute paths, so that it does not depend on its folder."""
    content = validate(base, folder).model_dump(mode="json")
    return {key: value for key, value in content.items() if key not in NOT_SHARED}


def _base(file: ComparisonFile, folder: Path, scale: str | None, optional: bool) -> tuple[dict[str, Any], Path]:
    """Return the experiment from which all cases are made, and the folder of its relative paths.

    If `optional`, the experiment may lack the scale, because the comparison has it.
    """
    if isinstance(file.experiment, dict):
        base: dict[str, Any] = file.experiment
    else:
        source = file.experiment.expanduser()
        source = source if source.is_absolute() else folder / source
        base, folder = read_mapping(source), source.resolve().parent
    for key in (KEY, "experiments", "runtime", "observed"):
        if key in base:
            raise ExperimentError([f"experiment: has the key {key!r}, and is no single experiment"])
    has_it = scale in (base.get("scales") or {})
    base = apply_scale(base, scale if has_it or not optional else None)
    base = {key: value for key, value in base.items() if key not in NOT_SHARED}
    for dotted, value in file.overrides.items():
        base = override(base, dotted, value)
    return base, folder


def _make_cases(
    calibrators: Mapping[str, Block], worlds: Mapping[str, Mapping[str, Any]], base: Mapping[str, Any], folder: Path
) -> list[Case]:
    """Return all cases; raises ExperimentError with every fault once."""
    cases: list[Case] = []
    faults: dict[str, list[str]] = {}
    for world, changes in worlds.items():
        for calibrator, block in calibrators.items():
            data = {**base, "calibration": {**base.get("calibration", {}), **block}}
            for dotted, value in changes.items():
                data = override(data, dotted, value)
            try:
                experiment = validate(data, folder)
            except ExperimentError as error:
                for sentence in error.faults:
                    faults.setdefault(sentence, []).append(f"{calibrator} in {world}")
                continue
            if not experiment.measures_signal_loss:
                faults.setdefault(VARIANTS_NEEDED, []).append(f"{calibrator} in {world}")
            cases.append(Case(calibrator, world, experiment, refusal_of_calibrator(experiment)))
    if faults:
        raise ExperimentError([f"{sentence} (in {_listed(found)})" for sentence, found in faults.items()])
    return cases


def _listed(cases: Sequence[str]) -> str:
    """Name the first of some cases, and count the others."""
    others = len(cases) - 1
    return f"{cases[0]!r}" + (f" and {others} other case{'s' if others > 1 else ''}" if others else "")
