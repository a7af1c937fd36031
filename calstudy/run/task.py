"""Tasks: the products of a study, their stages, settings, inputs and costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from calstudy.base.identity import digest_json, identity
from calstudy.base.resources import Cost


@dataclass(frozen=True, kw_only=True)
class Job:
    """The input of a stage for one product: settings as in `Task`, folders of the inputs, and an empty folder."""

    settings: Mapping[str, Any]
    inputs: Mapping[str, Path]
    output: Path


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A kind of product.

    Attributes
    ----------
    name
        Name of the folder of its products in the store.
    version
        Raised when its results change, so that products of older code are not used as new ones.
    make
        Writes the files of one product and returns JSON-able notes about it. A function of a module; it imports slow
        libraries inside, because plans are made without them.
    cost
        Estimates the cost of one task.
    """

    name: str
    version: int
    make: Callable[[Job], Mapping[str, Any]]
    cost: Callable[[Task], Cost] = lambda task: Cost(3, disk=1e6)


@dataclass(frozen=True, eq=False)
class Task:
    """One product to be made.

    Attributes
    ----------
    label
        Description of the product in a few words.
    settings
        All settings of the experiment that the stage reads: validated sections, and plain JSON-able values.
    inputs
        The tasks whose products it reads, by their names in the stage.
    pieces
        Tasks whose products it joins, likewise. Its settings and inputs, and the stages of the pieces, determine the
        result: the number of pieces changes it by rounding at most, and is not part of the key.
    temporary
        Whether the product may be removed once the products that need it are made.
    """

    stage: Stage
    label: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Task] = field(default_factory=dict)
    pieces: Mapping[str, Task] = field(default_factory=dict)
    temporary: bool = False

    @cached_property
    def key(self) -> str:
        """The content address: a digest of stage, version, settings, the inputs' keys, and the stages of the pieces."""
        inputs = {name: task.key for name, task in self.inputs.items()}
        stages = sorted({(task.stage.name, task.stage.version) for task in unique(self.pieces.values())})
        own = [self.stage.name, self.stage.version, identity(self.settings), inputs]
        return digest_json([*own, stages] if stages else own)

    @property
    def needs(self) -> dict[str, Task]:
        """Inputs and pieces."""
        return {**self.inputs, **self.pieces}

    @cached_property
    def cost(self) -> Cost:
        """Estimated cost of making the product."""
        return self.stage.cost(self)


def unique(tasks: Iterable[Task]) -> list[Task]:
    """Return tasks and all that they need, once each, every task after its inputs."""
    found: dict[str, Task] = {}

    def visit(task: Task) -> None:
        if task.key not in found:
            for needed in task.needs.values():
                visit(needed)
            found[task.key] = task

    for task in tasks:
        visit(task)
    return list(found.values())
