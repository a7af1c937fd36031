"""The interface of studies, and the one way in which all are run: make the products, then fill the folders."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol, Self, TypeVar

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.report.page import write_report
from calstudy.run.execution import Lifetimes, Schedule, Workers, drop, execute, found_of, schedule
from calstudy.run.progress import report
from calstudy.run.provenance import of_other_code, other_code
from calstudy.run.store import Product, Store
from calstudy.run.task import Task, unique
from calstudy.studies.folder import LOG, log_to, open_folder

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Budget:
    """Resources of a run.

    Attributes
    ----------
    workers
        Number of worker processes, or None for one per core within the memory.
    max_memory
        Memory of all workers together, such as "6 GB", or None for all free memory.
    scheduler
        Address of a running dask scheduler, whose memory is not checked, or None.
    """

    workers: int | None = None
    max_memory: str | None = None
    scheduler: str | None = None


@dataclass(frozen=True)
class Made:
    """Products of a study.

    `products`, by key, are those that were made or looked up, and all others behind them that are still in the
    store. `tasks` are those whose products were made; the others were in the store.
    """

    products: Mapping[str, Product]
    tasks: tuple[Task, ...]

    def of(self, tasks: Sequence[Task]) -> Made:
        """Return the products of some tasks."""
        keys = {task.key for task in tasks}
        products = {key: product for key, product in self.products.items() if key in keys}
        return Made(products, tuple(task for task in self.tasks if task.key in keys))


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes
    ----------
    folder
        Contains the resolved file, the manifest, the log, figures and tables.
    made
        Its products.
    tasks
        All tasks whose products the run made or looked up.
    parts
        Runs of its parts, with their own folders, by name.
    """

    folder: Path
    made: Made
    tasks: tuple[Task, ...]
    parts: Mapping[str, Run]

    @property
    def warnings(self) -> list[str]:
        """Warnings of the stages, with the product concerned."""
        records = [product.record for product in self.made.products.values()]
        return [
            f"{record['stage']} ({record['label']}): {text}"
            for record in records
            for text in record["notes"].get("warnings", [])
        ]


class Folders(Protocol):
    """Folders of the products and of the runs of a study."""

    @property
    def store(self) -> Path:
        """Folder of products."""

    @property
    def runs(self) -> Path:
        """Folder in which each run gets its own folder."""


class Study(ABC):
    """The content of a file: an experiment, a sweep, realizations, a collection, a run-time study and others.

    A new kind is a subclass, with the key of its files in `calstudy.studies.load`.
    """

    name: str
    description: str

    @property
    @abstractmethod
    def outputs(self) -> Folders:
        """Store and folder of runs."""

    @abstractmethod
    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the study fitted to a budget, and the number of workers; raises InputError if it does not fit."""

    @property
    @abstractmethod
    def targets(self) -> Sequence[Task]:
        """Products that a run makes for its user; the others are made on the way."""

    @property
    @abstractmethod
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions for the papers' own ingredients, printed with the results."""

    @property
    @abstractmethod
    def folder(self) -> Path:
        """The run folder."""

    @property
    def parts(self) -> Mapping[str, Study]:
        """Studies of which this one consists, with their own run folders, by name."""
        return {}

    @abstractmethod
    def fill(self, made: Made) -> None:
        """Write figures, tables, claims, the manifest and the file itself to the run folder."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of a plan on settings that are probably a mistake, of the study and its parts, once each."""
        return tuple(dict.fromkeys(note for part in self.parts.values() for note in part.notes))

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, once each, every one after its inputs."""
        return unique(self.targets)

    @property
    def given(self) -> frozenset[str]:
        """Keys of products that a run of this study needs but does not make."""
        return frozenset()

    @property
    def folders(self) -> list[Path]:
        """The run folders of the study and of its parts."""
        return [self.folder, *(folder for part in self.parts.values() for folder in part.folders)]


S = TypeVar("S", bound=Study)


def fitted_parts(parts: Mapping[str, S], budget: Budget) -> dict[str, tuple[S, int]]:
    """Return every part of a study fitted to a budget, with its number of workers; an InputError names the part."""
    fits = {}
    for name, part in parts.items():
        try:
            fits[name] = part.fitted(budget)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    return fits


def make(targets: Sequence[Task], store: Store, workers: Workers, console: Console, strict: bool = False) -> Made:
    """Make the products that are missing in the store with all their inputs, and report the progress.

    A read-only store is sufficient if nothing is missing. With `strict`, products of other code or other package
    versions are made again.

    Raises
    ------
    InputError
        If the store must be written and cannot be, or a stage refuses its input.
    """
    plan = schedule(targets, store, strict=strict)
    if plan.todo:
        store.prepare()
    messages = [
        f"{task.stage.name} ({task.label}): the product in the store is damaged, and is made again"
        for task in plan.damaged
    ]
    for message in [*messages, *said_of_other_code(targets, plan, store)]:
        logger.warning(message)
        console.print(message, markup=False)
    lifetimes = Lifetimes(targets, plan.todo)
    drop(lifetimes.unused(), store)
    costs = {task.key: task.cost.seconds for task in plan.todo}
    with report(plan.todo, costs, workers.count, console) as show:

        def done(task: Task, product: Product) -> None:
            logger.info("%s (%s): %.1f s", task.stage.name, task.label, product.record["seconds"])
            show(task, product)
            drop(lifetimes.after(task), store)

        def told(text: str) -> None:
            logger.warning(text)
            console.print(text, markup=False)

        products = execute(plan.todo, store, workers, done, told, plan.again)
    return Made({**found_of(unique(targets), store), **products}, plan.todo)


def said_of_other_code(targets: Sequence[Task], plan: Schedule, store: Store) -> list[str]:
    """Return a sentence if products that are not made again are of other code or other versions of packages."""
    tasks, todo = unique(targets), {task.key for task in plan.todo}
    used = {key: product for key, product in found_of(tasks, store).items() if key not in todo}
    other = of_other_code(tasks, used)
    sentence = other_code([task.stage.name for task in tasks if task.key in other])
    return [] if sentence is None else [sentence]


def run_study(study: Study, budget: Budget | None = None, console: Console | None = None, strict: bool = False) -> Run:
    """Make all products of a study that are missing in the store, and fill its run folder.

    Parameters
    ----------
    study
        From `calstudy.studies.load.load_study`.
    budget
        Workers and memory.
    console
        Console for the progress; None for no output.
    strict
        If true, products of other code or other versions of packages are made again.

    Raises
    ------
    InputError
        If the study does not fit the machine, the store or a run folder cannot be written, or a stage refuses its
        input.
    """
    budget, console = budget or Budget(), console or Console(quiet=True)
    study, count = study.fitted(budget)
    store = Store(study.outputs.store)
    with ExitStack() as logs:
        for folder in study.folders:
            open_folder(folder)
            logs.enter_context(log_to(folder / LOG))
        made = make(study.targets, store, Workers(count, study.folder / LOG, budget.scheduler), console, strict)
        return _filled(study, made)


def _filled(study: Study, made: Made) -> Run:
    parts = {name: _filled(part, made) for name, part in study.parts.items()}
    own = made.of(study.tasks)
    study.fill(own)
    write_report(study.folder)
    return Run(study.folder, own, tuple(study.tasks), parts)
