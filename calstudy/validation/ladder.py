"""The validation ladder as a study: its steps at one scale, their experiments, and the verdicts on their limits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError
from rich.console import Console

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.package_files import published
from calstudy.claims.paper import stand_ins, unique_notes
from calstudy.experiment.files import override, parse_override, validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment, Outputs
from calstudy.experiment.yaml_files import read_mapping
from calstudy.products.files import read_json
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import product_entries, publish, run_folder, write, write_manifest
from calstudy.studies.study import Budget, Made, Study, run_study
from calstudy.validation.step import FINDINGS, MINREDUNDANT, STEPS, Case, Step, inputs_of, step_task
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import CLAIMS_JSON, CLAIMS_MARKDOWN, to_json, to_markdown

SCALES = ("full", "small")
NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?")
Experiments = Mapping[str, Experiment]


class Ladder(Study):
    """Steps of the validation ladder, each with its experiments by name.

    `failures` are the steps that could not be measured, by number, with the reason.
    """

    def __init__(
        self,
        steps: Sequence[tuple[Step, Experiments]],
        outputs: Outputs,
        failures: Mapping[str, str] | None = None,
    ) -> None:
        self.steps, self._outputs, self.failures = tuple(steps), outputs, dict(failures or {})
        self.scale = self.steps[0][0].scale
        self.name, self.description = "validation", f"Validation ladder, {self.scale} scale."

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs, those of the experiments."""
        return self._outputs

    def with_steps(self, steps: Sequence[tuple[Step, Experiments]], failures: Mapping[str, str] | None = None) -> Self:
        """Return a ladder of other steps."""
        return type(self)(steps, self._outputs, self.failures if failures is None else failures)

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the ladder with all experiments cut to the memory, and the smallest number of workers of all."""
        steps, counts = [], []
        for step, experiments in self.steps:
            measured = {} if step.number in self.failures else experiments
            fits = {name: fit(item, budget, partial(_products, step)) for name, item in measured.items()}
            steps.append((step, {name: experiment for name, (experiment, _) in fits.items()}))
            counts += [count for _, count in fits.values()]
        return self.with_steps(steps), min(counts, default=budget.workers or 1)

    @cached_property
    def measurements(self) -> dict[str, Task]:
        """The measurement of each step that is measured, by its number."""
        measured = [item for item in self.steps if item[0].number not in self.failures]
        return {step.number: step_task(step, experiments) for step, experiments in measured}

    @property
    def targets(self) -> list[Task]:
        """The measurements."""
        return list(self.measurements.values())

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions of all experiments for the papers' ingredients."""
        experiments = [item for _, named in self.steps for item in named.values()]
        return unique_notes(note for experiment in experiments for note in stand_ins(experiment))

    @property
    def folder(self) -> Path:
        """The run folder; another set of steps, settings or versions has another folder."""
        keys = {number: task.key for number, task in self.measurements.items()}
        return run_folder(self.outputs.runs, self.name, keys)

    def judge(self, made: Made) -> list[tuple[Step, list[Verdict], list[str]]]:
        """Return each step with the verdicts on its limits, and the remarks of its measurement."""
        return [(step, *self._judged(step, made)) for step, _ in self.steps]

    def _judged(self, step: Step, made: Made) -> tuple[list[Verdict], list[str]]:
        if (reason := self.failures.get(step.number)) is not None:
            return [statement.unevaluated(reason) for statement in step.statements()], []
        measured = read_json(made.products[self.measurements[step.number].key].path / FINDINGS)
        return step.judge(measured["findings"]), measured["remarks"]

    def fill(self, made: Made) -> None:
        """Write the table of all limits, the files of each measurement, and the manifest."""
        folder, judged = self.folder, self.judge(made)
        verdicts = [verdict for _, found, _ in judged for verdict in found]
        write(folder / CLAIMS_JSON, to_json(verdicts) + "\n")
        text = to_markdown(verdicts, self.description.rstrip("."), ("step", "proves"), tally(verdicts), self.stand_ins)
        remarks = [f"- {step.number}: {remark}\n" for step, _, found in judged for remark in found]
        write(folder / CLAIMS_MARKDOWN, "".join([text, "\n", *remarks]))
        (folder / "tables").mkdir(exist_ok=True)
        for number, task in self.measurements.items():
            publish([made.products[task.key]], folder / "tables" / number)
        fields = {
            "kind": "validation",
            "description": self.description,
            "scale": self.scale,
            "passed": passed(verdicts),
            "stand_ins": list(self.stand_ins),
            "steps": {
                step.number: {name: item.model_dump(mode="json") for name, item in experiments.items()}
                for step, experiments in self.steps
            },
            "products": product_entries(self.tasks, made.products, made.tasks),
        }
        write_manifest(folder, self.name, fields)


def _products(step: Step, experiment: Experiment) -> list[Task]:
    return list(inputs_of(step, experiment).values())


def passed(verdicts: Sequence[Verdict]) -> bool:
    """Return true if every limit holds; a number that was not measured does not."""
    return all(verdict.verdict == "PASS" for verdict in verdicts)


def tally(verdicts: Sequence[Verdict]) -> str:
    """Count steps and limits in one line."""
    steps: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        steps.setdefault(verdict.name.partition(" ")[0], []).append(verdict)
    held = sum(verdict.verdict == "PASS" for verdict in verdicts)
    return f"{sum(map(passed, steps.values()))} of {len(steps)} steps pass, {held} of {len(verdicts)} criteria"


def run_ladder(ladder: Ladder, budget: Budget, console: Console, strict: bool = False) -> tuple[Path, list[Verdict]]:
    """Run a ladder, and return its folder and verdicts.

    If a step cannot be measured, the steps are run one by one, so that it fails alone. Raises InputError as
    `calstudy.studies.study.run_study`, if the only step cannot be measured.
    """
    try:
        run = run_study(ladder, budget, console, strict)
    except InputError as error:
        if len(ladder.steps) == 1:
            raise
        console.print(f"{error}; the steps are run one by one", markup=False)
        ladder = ladder.with_steps(ladder.steps, _failures(ladder, budget, console, strict))
        run = run_study(ladder, budget, console, strict)
    return run.folder, [verdict for _, found, _ in ladder.judge(run.made) for verdict in found]


def _failures(ladder: Ladder, budget: Budget, console: Console, strict: bool) -> dict[str, str]:
    """Return the reasons of the steps that cannot be measured, after making the products of the others."""
    failures = {}
    for step, experiments in ladder.steps:
        try:
            run_study(ladder.with_steps([(step, experiments)]), budget, console, strict)
        except InputError as error:
            failures[step.number] = str(error)
    return failures


def load_ladder(names: Sequence[str] = (), scale: str = "full", overrides: Sequence[str] = ()) -> Ladder:
    """Return the steps with these numbers or in these Python files, or all built-in ones, in the order of the numbers.

    `overrides` are ``path=value`` texts, applied to every experiment after all other changes. Raises InputError if
    there is no such step, and ExperimentError if fields of a step or an experiment are not allowed.
    """
    if scale not in SCALES:
        raise InputError(f"--scale {scale}: not a scale of the ladder (allowed: {', '.join(SCALES)})")
    built_in = {STEPS.find(name).number: name for name in STEPS.names()}
    unknown = [name for name in names if name not in built_in and not name.endswith(".py")]
    if unknown:
        listed = ", ".join(sorted(built_in, key=float))
        raise InputError(f"{unknown[0]}: not a step of the ladder (there are: {listed}; or a file.py)")
    steps = [_make(built_in.get(name, name), scale) for name in names or built_in]
    loaded = [
        (step, {name: _load(step, name, case, overrides) for name, case in step.experiments.items()})
        for step in sorted(steps, key=lambda step: float(step.number))
    ]
    every = [item for _, experiments in loaded for item in experiments.values()]
    first = every[0] if every else _load(loaded[0][0], "minredundant", MINREDUNDANT, overrides)
    return Ladder(loaded, first.outputs)


def _make(reference: str, scale: str) -> Step:
    found = STEPS.class_of({STEPS.tag: reference}, None, None)[0]
    block: dict[str, Any] = {STEPS.tag: reference, "scale": scale, **found.parameters}
    block |= found.small_parameters if scale == "small" else {}
    if not NUMBER.fullmatch(found.number) or not found.limits:
        raise InputError(f"{reference}: a step must have a number, such as '2.1', and limits")
    try:
        return STEPS.make(block)
    except ValidationError as error:
        raise ExperimentError([f"{reference}: {sentence}" for sentence in sentences(error, found, block)]) from None


def _load(step: Step, name: str, case: Case, overrides: Sequence[str]) -> Experiment:
    """Validate an experiment of a step; relative paths start at the folder of the published experiments."""
    full = step.scale == "full"
    path = published("experiments") / (case.file if full else case.small_file)
    data = read_mapping(path)
    for dotted, value in (case.overrides if full else case.small).items():
        data = override(data, dotted, value)
    for text in overrides:
        data = override(data, *parse_override(text))
    try:
        return validate(data, path.parent)
    except ExperimentError as error:
        raise ExperimentError([f"step {step.number}: {name}: {sentence}" for sentence in error.faults]) from None
