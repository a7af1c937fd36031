"""Tables of a study: how it finds the products whose files are its tables, and tables of a user's own."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, cast

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, guarded
from calstudy.base.table import Table, number
from calstudy.experiment.model import TABLES
from calstudy.run.task import Inputs, Job, Task


class StudyTable(Plugin):
    """The base of all tables. A built-in one has `products`; one's own has `inputs` and `rows`.

    Attributes
    ----------
    of
        The kind of study that has the table, a module of `calstudy.studies.kinds`. A module of this package in which it
        is written down has a table of every such study; others are asked for in ``outputs.tables``.
    place
        Among the tables of a study; those of a user's own come last.
    title, note
        Of the table in the report; the title is its name if empty.
    """

    registry: ClassVar = TABLES
    of: ClassVar[str] = "experiment"
    place: ClassVar[int] = 9
    title: ClassVar[str] = ""
    note: ClassVar[str] = ""

    kind: str = ""

    def refusal(self, experiment: Any) -> str | None:
        """Return why an experiment cannot have the table, to follow its name, or None."""
        del experiment
        return None if self.of == "experiment" else f"is of files of the kind {self.of!r}"

    def products(self, graph: Any) -> Sequence[Task | None]:
        """Return the products whose files are the table; None for one that the study does not have."""
        with guarded(self):
            inputs, own = self.inputs(graph), self.settings(graph)
        return [MakeTable(self.label, table=self, own=own, products=inputs)]

    def inputs(self, graph: Any) -> Mapping[str, Task]:
        """Return the products that the table is made from, by names of its own."""
        del graph
        return {}

    def settings(self, graph: Any) -> Mapping[str, Any]:
        """Collect further inputs of the table from the study."""
        del graph
        return {}

    def rows(self, job: Job) -> Iterable[Mapping[str, Any]]:
        """Return the rows, each by the names of columns.

        Parameters
        ----------
        job
            Its `inputs` are the folders of the method `inputs`, its `settings` those of the method `settings`.
        """
        raise NotImplementedError


class MakeTable(Task, stage="table", version=1):
    """A table of a user's own."""

    table: StudyTable
    own: Mapping[str, Any]
    products: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the table as CSV; raises InputError if there are no rows, or what is returned are none."""
        with guarded(self.table):
            rows = list(self.table.rows(Job(settings=self.own, inputs=self.products, output=output)))
        if not rows or not all(isinstance(row, Mapping) for row in rows):
            raise InputError(f"table {self.label!r}: rows must return one or more mappings of columns to values")
        Table.of_records(rows).write_csv(output / f"{self.label}.csv")
        return {}

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the table, with three digits of each number."""
        with (folder / f"{self.label}.csv").open(newline="", encoding="utf-8") as file:
            columns, *rows = csv.reader(file)
        cells = [tuple(_cell(text) for text in row) for row in rows]
        return [Table(columns, cells, self.table.title or self.label, self.table.note)]


def _cell(text: str) -> str:
    with suppress(ValueError):
        return text if text.isdigit() else number(float(text))
    return text


def tables_of(kind: str, graph: Any, own: Sequence[Plugin] = ()) -> list[Task]:
    """Return the products whose files are the tables of a study: those of its kind, and those that it asks for.

    Raises InputError if it asks for one that it does not have.
    """
    built_in = sorted(TABLES.marked("of", (kind,)), key=lambda table: table.place)
    found = [task for table in built_in for task in table().products(graph) if task is not None]
    for table in own:
        asked = [task for task in cast(StudyTable, table).products(graph) if task is not None]
        if not asked:
            raise InputError(f"outputs.tables: asks for {table.label!r}, and there is no such product of this study")
        found += asked
    return list({task.key: task for task in found}.values())
