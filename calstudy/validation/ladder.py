"""The validation ladder as a study: its steps at one scale, their experiments, and the verdicts on their limits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from rich.console import Console

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.files import write_text
from calstudy.base.package_files import published
from calstudy.claims.paper import stand_ins, unique_notes
from calstudy.experiment.files import StudyFile, checked, overridden, validate
from calstudy.experiment.model import Experiment, Outputs
from calstudy.products.files import read_json
from calstudy.run.execution import Budget
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import publish
from calstudy.studies.study import RunProducts, Study, run_study
from calstudy.validation.step import CHAIN, FINDINGS, MINREDUNDANT, STEPS, Case, Step, inputs_of, step_task
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import CLAIMS_JSON, CLAIMS_MARKDOWN, to_json, to_markdown

SCALES = ("full", "small")
NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")
Steps = tuple[tuple[Step, Mapping[str, Experiment]], ...]


class LadderFile(NamedTuple):
    """Name and scale of a ladder, and the outputs that its experiments share."""

    description: str
    outputs: Outputs
    name: str = "validation"


@dataclass(frozen=True, eq=False)
class Ladder(Study):
    """Steps of the ladder, each with its experiments by name, and why some could not be measured, by number."""

    file: LadderFile
    steps: Steps
    failures: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, file: StudyFile) -> Self:
        """Return the steps with the numbers, or in the Python files, of the key `steps`, or all built-in ones.

        Scale and overrides are those of all experiments. Raises InputError if there is no such step, and
        ExperimentError if fields of a step or an experiment are not allowed.
        """
        names, scale = file.content.get("steps", ()), file.scale or "full"
        if scale not in SCALES:
            raise InputError(f"--scale {scale}: not a scale of the ladder (allowed: {', '.join(SCALES)})")
        built_in = {STEPS.find(name).number: name for name in STEPS.names()}
        unknown = [name for name in names if name not in built_in and not name.endswith(".py")]
        if unknown:
            listed = ", ".join(sorted(built_in, key=float))
            raise InputError(f"{unknown[0]}: not a step of the ladder (there are: {listed}; or a file.py)")
        made = (_make(built_in.get(name, name), scale) for name in names or built_in)
        found = sorted(made, key=lambda step: float(step.number))
        load = partial(_experiment, scale, file.overrides)
        steps = tuple((step, {name: load(name, case) for name, case in step.experiments.items()}) for step in found)
        every = [experiment for _, experiments in steps for experiment in experiments.values()]
        outputs = (every or [load("minredundant", MINREDUNDANT)])[0].outputs
        return cls(LadderFile(f"Validation ladder, {scale} scale", outputs), steps)

    @property
    def content(self) -> Any:
        """The keys of the measurements: other steps, settings or versions have another run folder."""
        return {number: task.key for number, task in self.measurements.items()}

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the ladder with all experiments cut to the memory, and the smallest number of workers of all."""
        steps, counts = [], []
        for step, experiments in self.steps:
            measured = {} if step.number in self.failures else experiments
            sized = {name: fit(item, budget, partial(_products, step)) for name, item in measured.items()}
            steps.append((step, {name: experiment for name, (experiment, _) in sized.items()}))
            counts += [count for _, count in sized.values()]
        return replace(self, steps=tuple(steps)), min(counts, default=budget.workers or 1)

    @cached_property
    def measurements(self) -> dict[str, Task]:
        """The measurement of each step that can be measured, by its number."""
        measured = [item for item in self.steps if item[0].number not in self.failures]
        return {step.number: step_task(step, experiments) for step, experiments in measured}

    @property
    def own(self) -> list[Task]:
        """The measurements."""
        return list(self.measurements.values())

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of all experiments for the papers' ingredients."""
        experiments = [item for _, named in self.steps for item in named.values()]
        return unique_notes(note for experiment in experiments for note in stand_ins(experiment))

    @property
    def texts(self) -> Mapping[str, str]:
        """Nothing: the steps are in the manifest."""
        return {}

    @property
    def entries(self) -> Mapping[str, Any]:
        """The resolved experiments of all steps."""
        return {
            "steps": {
                step.number: {name: item.model_dump(mode="json") for name, item in experiments.items()}
                for step, experiments in self.steps
            }
        }

    def judge(self, made: RunProducts) -> list[tuple[Step, list[Verdict], list[str]]]:
        """Return each step with the verdicts on its limits, and the remarks of its measurement."""
        return [(step, *self._judged(step, made)) for step, _ in self.steps]

    def _judged(self, step: Step, made: RunProducts) -> tuple[list[Verdict], list[str]]:
        if (reason := self.failures.get(step.number)) is not None:
            return [criterion.unevaluated(reason) for criterion in step.criteria.values()], []
        measured = read_json(made.products[self.measurements[step.number].key].path / FINDINGS)
        return step.judge(measured["findings"]), measured["remarks"]

    def write_results(self, made: RunProducts) -> None:
        """Write the table of all limits, the files of each measurement, and the manifest."""
        judged = self.judge(made)
        verdicts = [verdict for _, found, _ in judged for verdict in found]
        write_text(self.folder / CLAIMS_JSON, to_json(verdicts) + "\n")
        text = to_markdown(verdicts, self.description, ("step", "proves"), tally(verdicts), self.stand_ins)
        remarks = [f"- {step.number}: {remark}\n" for step, _, found in judged for remark in found]
        write_text(self.folder / CLAIMS_MARKDOWN, "".join([text, "\n", *remarks]))
        (self.folder / "tables").mkdir(exist_ok=True)
        for number, task in self.measurements.items():
            publish([made.products[task.key]], self.folder / "tables" / number)
        super().write_results(made)


def _products(step: Step, experiment: Experiment) -> list[Task]:
    return list(inputs_of(step, experiment).values())


def passed(verdicts: Sequence[Verdict]) -> bool:
    """Return true if there are limits and every one holds; a number that was not measured does not."""
    return bool(verdicts) and all(verdict.verdict == "PASS" for verdict in verdicts)


def tally(verdicts: Sequence[Verdict]) -> str:
    """Count steps and limits in one line."""
    steps: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        steps.setdefault(verdict.name.partition(" ")[0], []).append(verdict)
    held = sum(verdict.verdict == "PASS" for verdict in verdicts)
    return f"{sum(map(passed, steps.values()))} of {len(steps)} steps pass, {held} of {len(verdicts)} criteria"


def run_ladder(ladder: Ladder, budget: Budget, console: Console) -> tuple[Path, list[Verdict]]:
    """Run a ladder, and return its folder and verdicts.

    If a step cannot be measured, the steps are run one by one, so that it fails alone. Raises InputError as
    `calstudy.studies.study.run_study`, if the only step cannot be measured.
    """
    try:
        run = run_study(ladder, budget, console)
    except InputError as error:
        if len(ladder.steps) == 1:
            raise
        console.print(f"{error}; the steps are run one by one", markup=False)
        failures = {}
        for step in ladder.steps:
            try:
                run_study(replace(ladder, steps=(step,)), budget, console)
            except InputError as reason:
                failures[step[0].number] = str(reason)
        ladder = replace(ladder, failures=failures)
        run = run_study(ladder, budget, console)
    return run.folder, [verdict for _, found, _ in ladder.judge(run.made) for verdict in found]


def _make(reference: str, scale: str) -> Step:
    found, reference = STEPS.class_of({STEPS.tag: reference}, None, None)
    if not NUMBER.fullmatch(found.number) or not found.limits:
        raise InputError(f"{reference}: a step must have a number, such as '2.1', and limits")
    small = found.small_parameters if scale == "small" else {}
    return checked(found, {STEPS.tag: reference, "scale": scale, **found.parameters, **small}, Path())


def _experiment(scale: str, overrides: Sequence[str], name: str, case: Case) -> Experiment:
    """Validate an experiment of a step; relative paths start at the folder of the published experiments."""
    path, changes = (case.file, case.overrides) if scale == "full" else (CHAIN, case.small)
    file = StudyFile.open(published("experiments") / path, None, overrides)
    try:
        return validate(replace(file, content=overridden(file.content, changes)).changed(), file.folder)
    except ExperimentError as error:
        raise ExperimentError([f"{name}: {sentence}" for sentence in error.faults]) from None
