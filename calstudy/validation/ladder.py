"""Run the validation ladder: make the products of its steps, measure, judge, and save all results with manifests."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.claims.paper import stand_ins, unique_notes
from calstudy.products.files import read_json
from calstudy.run.execution import Workers
from calstudy.run.store import Store
from calstudy.run.task import Task, unique
from calstudy.studies.folder import LOG, log_to, product_entries, publish, write_manifest
from calstudy.studies.study import RunProducts, make
from calstudy.validation.outcomes import Outcome, failed, judge, write_tables
from calstudy.validation.product import FINDINGS, measurement_task
from calstudy.validation.steps import Step

logger = logging.getLogger(__name__)
FAILED = "failed"


@dataclass(frozen=True)
class LadderRun:
    """A finished run of the ladder: its outcomes, and the folder that holds them."""

    folder: Path
    outcomes: tuple[Outcome, ...]

    @property
    def passed(self) -> bool:
        """Whether every step passed."""
        return all(outcome.passed for outcome in self.outcomes)


def run_ladder(steps: Sequence[Step], store: Path, folder: Path, workers: int, console: Console) -> LadderRun:
    """Measure steps of the ladder, all of one scale, and judge them, reusing every product in the store.

    `folder` receives the tables, and a folder per step with its measurement, figures and manifest. Those of a failed
    step are also kept under ``failed/``, by step and key, and never overwritten by a later run. Raises InputError if
    the store or the folder cannot be written. A step whose products cannot be made fails, with the reason.
    """
    products = Store(store)
    products.prepare()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LOG).touch()
    except OSError as error:
        raise InputError(f"--output {str(folder)!r}: cannot be written ({error.strerror})") from None
    with log_to(folder / LOG):
        tasks = {step.name: measurement_task(step) for step in steps}
        made, reasons = _make(tasks, products, Workers(workers, folder / LOG), console)
        outcomes = []
        for step in steps:
            task = tasks[step.name]
            if task.key in made.products:
                outcome = judge(step, read_json(made.products[task.key].path / FINDINGS))
            else:
                outcome = failed(step, reasons[step.name])
            outcomes.append(outcome)
            _keep(outcome, task, made, folder)
        experiments = [experiment for step in steps for experiment in step.experiments.values()]
        notes = unique_notes(note for experiment in experiments for note in stand_ins(experiment))
        write_tables(outcomes, steps[0].scale, folder, notes)
    return LadderRun(folder, tuple(outcomes))


def _make(
    tasks: Mapping[str, Task], store: Store, workers: Workers, console: Console
) -> tuple[RunProducts, dict[str, str]]:
    """Make all measurements together; if one fails, make them one by one, so that only that one is lost."""
    try:
        return make(list(tasks.values()), store, workers, console), {}
    except InputError as error:
        logger.warning("%s", error)
        if len(tasks) == 1:
            return RunProducts({}, ()), dict.fromkeys(tasks, str(error))
    all_made, reasons = RunProducts({}, ()), {}
    for name, task in tasks.items():
        try:
            made = make([task], store, workers, console)
        except InputError as error:
            reasons[name] = str(error)
            console.print(f"step {name}: {error}", markup=False)
        else:
            all_made = RunProducts({**all_made.products, **made.products}, (*all_made.tasks, *made.tasks))
    return all_made, reasons


def _keep(outcome: Outcome, task: Task, made: RunProducts, folder: Path) -> None:
    """Write the folder of a step; a failed one twice, so that a later run does not replace it."""
    step = outcome.step
    own = folder / step.name
    own.mkdir(exist_ok=True)
    for old in own.iterdir():
        old.unlink()
    if task.key in made.products:
        publish([made.products[task.key]], own)
    fields = ("quantity", "measured", "verdict", "reason")
    manifest = {
        "step": step.name,
        "scale": step.scale,
        "passed": outcome.passed,
        "criteria": [{field: getattr(verdict, field) for field in fields} for verdict in outcome.verdicts],
        "experiments": {name: experiment.model_dump(mode="json") for name, experiment in step.experiments.items()},
        "products": product_entries(unique([task]), made.products, made.tasks),
    }
    write_manifest(own, f"step {step.name}", manifest)
    if not outcome.passed:
        shutil.copytree(own, folder / FAILED / f"{step.name}-{task.key[:8]}", dirs_exist_ok=True)
