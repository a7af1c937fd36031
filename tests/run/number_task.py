"""The smallest product: a number that is added to those of other products."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path

from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.store import Store
from calstudy.run.task import Inputs, Piece, Task


class Number(Task, stage="number"):
    """A number added to those of other products."""

    number: int
    needed: Inputs = field(default_factory=dict)
    piece: Piece = None

    def make(self, output: Path) -> dict:
        number = self.number + sum(int((folder / "number").read_text()) for folder in self.needs.values())
        (output / "number").write_text(str(number))
        return {"number": number}


def run(task: Task, store: Store) -> None:
    """Make a task and what it needs with one worker, as a run does."""
    execute(schedule([task], store).todo, store, Workers(1, store.root / "run.log"))
