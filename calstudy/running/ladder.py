"""Run the validation ladder: make what its steps need, measure, judge, and keep every result with its manifest."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from calstudy.errors import InputError
from calstudy.graph.tasks import Task, unique
from calstudy.graph.validation import measurement_task
from calstudy.running.execution import Crew
from calstudy.running.provenance import git_commit, machine, package_versions
from calstudy.running.runs import MANIFEST, log_to, make, publish, write
from calstudy.running.store import Product, Store
from calstudy.stages.files import read_json
from calstudy.stages.validation import MEASUREMENT
from calstudy.standins import footnotes
from calstudy.validation.results import Outcome, failed, judge, write_tables
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
    """Measure steps of the ladder and judge them, reusing every product that is in the store.

    Parameters
    ----------
    steps
        From `calstudy.validation.steps.load_ladder`, all of one scale.
    store
        Folder of products.
    folder
        For the tables, and a folder per step: its measurement, figures and manifest. Those of a failed step are kept
        under ``failed/`` as well, by step and key, and never overwritten by a later run.
    workers, console
        As for `calstudy.running.runs.run`.

    Raises
    ------
    InputError
        If the store or the folder cannot be written. A step whose products cannot be made fails, with the reason.
    """
    products = Store(store)
    products.prepare()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "run.log").touch()
    except OSError as error:
        raise InputError(f"--output {str(folder)!r}: cannot be written ({error.strerror})") from None
    with log_to(folder / "run.log"):
        tasks = {step.name: measurement_task(step) for step in steps}
        crew = Crew(workers, folder / "run.log")
        made, reasons = _make(tasks, products, crew, console)
        outcomes = []
        for step in steps:
            task = tasks[step.name]
            if task.key in made:
                outcome = judge(step, read_json(made[task.key].path / MEASUREMENT))
            else:
                outcome = failed(step, reasons[step.name])
            outcomes.append(outcome)
            _keep(outcome, task, made, folder)
        experiments = [experiment for step in steps for experiment in step.experiments.values()]
        notes = dict.fromkeys(note for experiment in experiments for note in footnotes(experiment))
        write_tables(outcomes, steps[0].scale, folder, tuple(notes))
    return LadderRun(folder, tuple(outcomes))


def _make(
    tasks: Mapping[str, Task], store: Store, crew: Crew, console: Console
) -> tuple[dict[str, Product], dict[str, str]]:
    """Make all measurements together; if one cannot be made, one by one, so that it alone is lost."""
    try:
        return make(list(tasks.values()), store, crew, console)[0], {}
    except InputError as error:
        logger.warning("%s", error)
        if len(tasks) == 1:
            return {}, dict.fromkeys(tasks, str(error))
    products: dict[str, Product] = {}
    reasons = {}
    for name, task in tasks.items():
        try:
            products |= make([task], store, crew, console)[0]
        except InputError as error:
            reasons[name] = str(error)
            console.print(f"step {name}: {error}", markup=False)
    return products, reasons


def _keep(outcome: Outcome, task: Task, products: Mapping[str, Product], folder: Path) -> None:
    """Write the folder of a step; a failed one twice, so that a later run does not replace it."""
    own = folder / outcome.step.name
    own.mkdir(exist_ok=True)
    for old in own.iterdir():
        old.unlink()
    if task.key in products:
        publish([products[task.key]], own)
    write(own / MANIFEST, json.dumps(_manifest(outcome, task, products), indent=1))
    if not outcome.passed:
        kept = folder / FAILED / f"{outcome.step.name}-{task.key[:8]}"
        shutil.copytree(own, kept, dirs_exist_ok=True)


def _manifest(outcome: Outcome, task: Task, products: Mapping[str, Product]) -> dict[str, Any]:
    experiments = outcome.step.experiments
    fields = ("quantity", "measured", "verdict", "reason")
    return {
        "step": outcome.step.name,
        "scale": outcome.step.scale,
        "passed": outcome.passed,
        "criteria": [{field: getattr(row, field) for field in fields} for row in outcome.rows],
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "experiments": {name: experiment.model_dump(mode="json") for name, experiment in experiments.items()},
        "git_commit": git_commit(),
        "versions": package_versions(),
        "machine": machine(),
        "products": list(_entries(unique([task]), products)),
    }


def _entries(tasks: Iterable[Task], products: Mapping[str, Product]) -> Iterable[dict[str, Any]]:
    for task in tasks:
        entry = {"stage": task.stage, "label": task.label, "key": task.key}
        record = products[task.key].record if task.key in products else {}
        fields = ("notes", "seconds", "cpu_seconds", "peak_memory_bytes", "started", "inputs")
        yield entry | {field: record[field] for field in fields if field in record}
