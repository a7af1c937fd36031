"""The interface of studies, and the one way in which all are run: make the products, then fill the folders."""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

from rich.console import Console

from calstudy.base.errors import InputError, refusal_of_disk
from calstudy.base.files import digest_json, write_text
from calstudy.base.identity import identity
from calstudy.base.paths import texts
from calstudy.base.plugins import Registry
from calstudy.base.schema import Section
from calstudy.base.table import to_json
from calstudy.experiment.files import StudyFile, dump
from calstudy.experiment.model import Experiment, Folders
from calstudy.report.page import recorded_warnings, write_report
from calstudy.results.reader import SHOWN
from calstudy.run.execution import Budget, Lifetimes, Schedule, Workers, execute, found_of, schedule, without_record
from calstudy.run.progress import report
from calstudy.run.provenance import of_other_code, other_code
from calstudy.run.store import Lease, Product, Store
from calstudy.run.task import Task, unique
from calstudy.studies.folder import (
    EXPERIMENT,
    LOG,
    log_to,
    open_folder,
    product_entries,
    publish,
    write_manifest,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunProducts:
    """Products of a study.

    `products`, by key, are those that were made or looked up, and all others behind them that are still in the
    store. `tasks` are those whose products were made; the others were in the store.
    """

    products: Mapping[str, Product]
    tasks: tuple[Task, ...]

    def subset(self, tasks: Sequence[Task]) -> RunProducts:
        """Return the products of some tasks."""
        keys = {task.key for task in tasks}
        products = {key: product for key, product in self.products.items() if key in keys}
        return RunProducts(products, tuple(task for task in self.tasks if task.key in keys))


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, its products, all tasks whose products it made or looked up, and runs of its parts.

    The folder contains the resolved file, the manifest, the log, figures and tables; parts have their own, by name.
    """

    folder: Path
    made: RunProducts
    tasks: tuple[Task, ...]
    parts: Mapping[str, Run]

    @property
    def warnings(self) -> list[str]:
        """Warnings of the stages, with the product concerned."""
        records = (product.record for product in self.made.products.values())
        return removed(self.tasks, self.made.products) + recorded_warnings(records)


def removed(tasks: Iterable[Task], products: Container[str]) -> list[str]:
    """Return a sentence if products that are kept, and whose warnings a run would show, are not in the store."""
    counts = Counter(task.stage.name for task in tasks if not task.temporary and task.key not in products)
    if not counts:
        return []
    named = ", ".join(f"{stage} {count}" for stage, count in counts.items())
    return [
        f"{counts.total()} products behind the results are no longer in the store ({named}), nor are their warnings"
    ]


class Study(ABC):
    """The content of a file: an experiment, a family of experiments, measured data, run times.

    A kind of study is a subclass in a file of its own: a module of `calstudy.studies.kinds`, or a file or an
    installed package that the key `study` of a file names.

    Attributes
    ----------
    key : the key that marks a file of a built-in kind
    model : the content of a file
    heading, guide : of the kind in the reference of all fields, and what is written there about its files
    subfolders : folders in the run folder besides figures and tables
    keeps_tables
        True if the manifest has digests of the tables, so that a collection can take them from there.
    has_reference : true if figures and claims of a run may be a reference for `calstudy regress`
    """

    key: ClassVar[str] = ""
    model: ClassVar[type[Section]]
    heading: ClassVar[str] = ""
    guide: ClassVar[str] = ""
    subfolders: ClassVar[tuple[str, ...]] = ()
    keeps_tables: ClassVar[bool] = False
    has_reference: ClassVar[bool] = True

    file: Any
    """Content of the file: its model, with name, description and, if `outputs` is not replaced, outputs."""

    @classmethod
    @abstractmethod
    def load(cls, file: StudyFile) -> Study:
        """Return the study of a file; raises InputError or ExperimentError if it cannot be used."""

    @property
    def name(self) -> str:
        """The name of the study and its run folder."""
        return self.file.name

    @property
    def description(self) -> str:
        """The description in the file."""
        return self.file.description

    @property
    def outputs(self) -> Folders:
        """Store and folder of runs."""
        return self.file.outputs

    @property
    @abstractmethod
    def content(self) -> Any:
        """JSON-able content that decides what a run makes; its digest is part of the name of the run folder."""

    @cached_property
    def folder(self) -> Path:
        """The run folder: the same study has the same one, and a changed study never overwrites it."""
        runs, content = self.outputs.runs.expanduser().resolve(), self.content
        # Assumed values and those of a sweep are texts, of which some name files. For a text that is too long to be a
        # path, methods of Path raise OSError.
        found = (text for text in texts(content, below=("assumed", "sweep")) if text.startswith("/"))
        paths = [text for text in found if os.path.isfile(text) or os.path.isdir(text)]  # noqa: PTH112, PTH113
        named = {path: identity(Path(path)) for path in paths}
        return runs / f"{self.name}-{digest_json([content, named] if named else content)[:8]}"

    @abstractmethod
    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study cut to a budget, and the number of workers; raises InputError if it does not fit."""

    def with_finished(self, folders: Sequence[Path], console: Console, *, planned: bool = False) -> Self:
        """Return the study with parts taken from finished runs, which a kind without them refuses."""
        del folders, console, planned
        raise InputError("--finished: only a collection (a file with the key 'experiments') takes members from runs")

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions for the papers' own ingredients, printed with the results."""
        return ()

    @property
    def parts(self) -> Mapping[str, Study]:
        """Studies of which this one consists, with their own run folders, by name."""
        return {}

    @property
    def figures(self) -> Sequence[Task]:
        """The figures."""
        return ()

    @property
    def tables(self) -> Sequence[Task]:
        """The products whose files are the tables."""
        return ()

    @property
    def claims(self) -> Task | None:
        """The evaluated statements of papers, or None."""
        return None

    @property
    def texts(self) -> Mapping[str, str]:
        """Further files of the run folder, such as the resolved file: their content by relative path."""
        named = "" if self.is_built_in() else f"{KINDS.tag}: {KINDS.reference_of(type(self))}\n"
        return {EXPERIMENT: named + dump(self.file)}

    @property
    def entries(self) -> Mapping[str, Any]:
        """Entries of the manifest besides those that all kinds have."""
        return {}

    @property
    def setup(self) -> str:
        """What is calibrated, and how, in one line; empty if it is not the same for all parts."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of a plan on settings that are probably a mistake, of the study and its parts, once each."""
        return tuple(dict.fromkeys(note for part in self.parts.values() for note in part.notes))

    @property
    def own(self) -> list[Task]:
        """The products that a run makes for its user, without those of the parts."""
        return [*self.figures, *self.tables, *([self.claims] if self.claims else [])]

    @property
    def targets(self) -> list[Task]:
        """The products that a run makes for its user; others are made on the way."""
        return [*(task for part in self.parts.values() for task in part.targets), *self.own]

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, once each, every one after its inputs, but none that only `external_keys` need."""
        return unique(self.targets, self.external_keys)

    @property
    def recorded(self) -> Sequence[Task]:
        """The tasks that the manifest lists: all, or, of a study with parts, those that are not in theirs."""
        return self.own if self.parts else self.tasks

    @property
    def external_keys(self) -> frozenset[str]:
        """Keys of products that a run of this study needs but does not make."""
        return frozenset()

    @classmethod
    def is_built_in(cls) -> bool:
        """Return whether the kind is one of calstudy's own, whose files have its key."""
        return cls.__module__.startswith(f"{KINDS.package}.")

    def with_parts(self) -> Iterator[Study]:
        """Yield the study and all of its parts."""
        yield self
        for part in self.parts.values():
            yield from part.with_parts()

    def write_results(self, made: RunProducts) -> None:
        """Write figures, tables, claims, texts and the manifest to the run folder."""
        publish([made.products[task.key] for task in self.figures], self.folder / "figures")
        if self.tables:
            publish([made.products[task.key] for task in self.tables], self.folder / "tables")
            shown = [table for task in self.tables for table in task.shown(made.products[task.key].path)]
            write_text(self.folder / "tables" / SHOWN, to_json(shown))
        if self.claims is not None:
            publish([made.products[self.claims.key]], self.folder)
        for name, text in self.texts.items():
            (self.folder / name).parent.mkdir(exist_ok=True)
            write_text(self.folder / name, text)
        places = {name: os.path.relpath(part.folder, self.folder) for name, part in self.parts.items()}
        entries = {
            "description": self.description,
            **({"setup": self.setup} if self.setup else {}),
            "stand_ins": list(self.stand_ins),
            "captions": {task.label: task.settings["figure"].captioned() for task in self.figures},
            **({"parts": places} if places else {}),
            **self.entries,
            "warnings": removed((task for task in self.recorded if task.key not in self.external_keys), made.products),
            "tables": [name for task in self.tables for name in made.products[task.key].record["files"]],
            "products": product_entries(
                self.recorded, made.products, made.tasks, self.tables if self.keeps_tables else ()
            ),
        }
        write_manifest(self.folder, self.name, entries)


KINDS: Registry[Any] = Registry("kind", "calstudy.studies.kinds", "calstudy.studies.study:Study", tag="study")


def built_in_kinds() -> list[type[Study]]:
    """Return the built-in kinds of study."""
    return [KINDS.find(name) for name in KINDS.built_in()]


def kind_of(content: Mapping[str, Any], folder: Path | None = None) -> type[Study]:
    """Return the kind of study of a file; a path of the key `study` starts at `folder`. InputError if there is none."""
    if KINDS.tag in content:
        return KINDS.class_of(content, None, folder)[0]
    marked = [kind for kind in KINDS.marked("key", content) if kind.model is not Experiment]
    return marked[0] if marked else KINDS.find("experiment")


def make(
    targets: Sequence[Task], store: Store, workers: Workers, console: Console, strict: bool = False
) -> RunProducts:
    """Make the products that are missing in the store with all their inputs, and report the progress.

    A read-only store is sufficient if nothing is missing. With `strict`, products of other code or other package
    versions are made again. Raises InputError if the store must be written and cannot be, or a stage refuses its input.
    """
    lease, keys = Lease(store), {task.key for task in targets}
    is_complete = len(found_of(targets, store)) == len(keys) and not without_record(targets, store)
    if not is_complete:
        store.prepare()
    # A complete store is only read, unless a file turns out to be damaged; no other run removes its product.
    with nullcontext() if is_complete and not strict else lease.holding(task.key for task in unique(targets)):
        return _make_missing(schedule(targets, store, strict=strict), targets, lease, store, workers, console)


def _make_missing(
    plan: Schedule, targets: Sequence[Task], lease: Lease, store: Store, workers: Workers, console: Console
) -> RunProducts:
    if plan.todo:
        store.prepare()

    def warn(text: str) -> None:
        logger.warning(text)
        console.print(text, markup=False)

    for task in plan.damaged:
        warn(f"{task.stage.name} ({task.label}): the product in the store is damaged, and is made again")
    for sentence in said_of_other_code(targets, plan, store):
        warn(sentence)
    lifetimes = Lifetimes(targets, plan.todo)
    lifetimes.keep_found(store)
    lease.drop(lifetimes.unused())
    costs = {task.key: task.cost.seconds for task in plan.todo}
    with report(plan.todo, costs, workers.count, console) as show:

        def done(task: Task, product: Product) -> None:
            logger.info("%s (%s): %.1f s", task.stage.name, task.label, product.record["seconds"])
            show(task, product)
            lease.drop(lifetimes.after(task))

        products = execute(plan.todo, store, workers, done, warn, plan.again)
    # Of two runs at once, one finds what the other has made.
    made = tuple(task for task in plan.todo if products[task.key].made)
    return RunProducts({**found_of(unique(targets), store), **products}, made)


def said_of_other_code(targets: Sequence[Task], plan: Schedule, store: Store) -> list[str]:
    """Return a sentence if products that are not made again are of other code or other versions of packages."""
    tasks, todo = unique(targets), {task.key for task in plan.todo}
    used = {key: product for key, product in found_of(tasks, store).items() if key not in todo}
    other = of_other_code(tasks, used)
    sentence = other_code([task.stage.name for task in tasks if task.key in other])
    return [] if sentence is None else [sentence]


def run_study(study: Study, budget: Budget | None = None, console: Console | None = None) -> Run:
    """Make all products of a study that are missing in the store, and fill its run folder; without console, silently.

    Raises InputError if the study does not fit the machine, the store or a run folder cannot be written, or a stage
    refuses its input.
    """
    budget, console = budget or Budget(), console or Console(quiet=True)
    study, count = study.sized_to(budget)
    store = Store(study.outputs.store)
    with ExitStack() as logs:
        for part in study.with_parts():
            open_folder(part.folder, part.subfolders)
            logs.enter_context(log_to(part.folder / LOG))
        workers = Workers(count, study.folder / LOG, budget.scheduler)
        made = make(study.targets, store, workers, console, budget.strict)
        return _filled(study, made)


def _explain(error: OSError, study: Study) -> None:
    """Raise InputError if a product was removed, or the folder of runs cannot be written; other errors are not ours."""
    named = Path(error.filename).resolve() if isinstance(error.filename, str) else None
    if named is not None and named.is_relative_to(study.outputs.store.expanduser().resolve()):
        if isinstance(error, FileNotFoundError):
            missing = f"{error.filename}: was removed while the results were written"
            raise InputError(f"{missing}; run again, which makes what is missing") from None
    elif (reason := refusal_of_disk(error)) and (named is None or named.is_relative_to(study.folder)):
        raise InputError(f"outputs.runs: {study.folder} cannot be written ({reason})") from None


def _filled(study: Study, made: RunProducts) -> Run:
    parts = {name: _filled(part, made) for name, part in study.parts.items()}
    own = made.subset(study.tasks)
    try:
        study.write_results(own)
        write_report(study.folder)
    except OSError as error:
        _explain(error, study)
        raise
    return Run(study.folder, own, tuple(study.tasks), parts)
