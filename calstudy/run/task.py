"""Tasks: the products of a study, each a declaration of its settings and inputs, its cost, and how it is made."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import cache, cached_property
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self, TypeAlias, dataclass_transform

from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.resources import Cost
from calstudy.base.table import Table
from calstudy.base.user_code import files_of_class, identity_of_file

Input: TypeAlias = Annotated[Any, "Input"]
"""A product that another needs: its task in a plan, its folder where the other one is made.

A field ``tuple[Input, ...]`` has several of them, ``Mapping[str, Input]`` has them by keys.
"""
Inputs: TypeAlias = Annotated[Mapping[str, Any], "Inputs"]
"""Products that another needs, by names that are not preceded by that of the field."""
Piece: TypeAlias = Annotated[Any, "Piece"]
"""A product that another joins; the number of pieces changes the result by rounding at most, and is not in its key."""
NEEDED = re.compile(r"\b(Inputs|Input|Piece)\b")
"""These names in an annotation, which may be its text."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a plug-in that draws or measures is given: settings, folders of products, and an empty folder."""

    settings: Mapping[str, Any]
    inputs: Mapping[str, Path]
    output: Path


class Stage(NamedTuple):
    """A kind of product: the name of its folder in the store, and a version that is raised when its results change."""

    name: str
    version: int


def called(name: str) -> Any:
    """Give a field another name in keys and records than its own."""
    return field(metadata={"name": name})


@dataclass_transform(kw_only_default=True, frozen_default=True, eq_default=False, field_specifiers=(field, called))
class Declared:
    """Base of classes whose annotations are the fields of an immutable record."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        dataclass(frozen=True, eq=False, kw_only=True)(cls)


class Task(Declared, ABC):
    """One product to be made. A kind of product is a subclass, with the name and the version of its stage.

    Its fields are the products that it needs (`Input`, `Inputs`, `Piece`) and all settings that it reads, sections and
    plain JSON-able values, which are in the key unless they have their default. The label describes the product in a
    few words; a temporary one may be removed once the products that need it are made.
    """

    stage: ClassVar[Stage]
    typical: ClassVar[Cost]

    label: str = field(kw_only=False)
    temporary: bool = False

    def __init_subclass__(cls, stage: str | None = None, version: int = 1, cost: Cost | None = None) -> None:
        super().__init_subclass__()
        cls.typical = cost or Cost(3, disk=1e6)
        if stage is not None:
            cls.stage = Stage(stage, version)

    @abstractmethod
    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the files of the product to an empty folder, and return JSON-able notes about it.

        Slow libraries are imported inside, because plans are made without them.
        """

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the tables by which a report shows the product that is in a folder."""
        del folder
        return ()

    def _cost(self) -> Cost:
        """Estimate the cost of making the product."""
        return self.typical

    @cached_property
    def cost(self) -> Cost:
        """Estimated cost of making the product."""
        return self._cost()

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """All settings, without those that have their default."""
        found = {item: getattr(self, item.name) for item, kind in _declared(type(self)) if not kind}
        kept = {item: value for item, value in found.items() if item.default is MISSING or value != item.default}
        return {item.metadata.get("name", item.name): value for item, value in kept.items()}

    @cached_property
    def inputs(self) -> Mapping[str, Any]:
        """The needed products that decide the result, by name."""
        return self._named("Input", "Inputs")

    @cached_property
    def pieces(self) -> Mapping[str, Any]:
        """The products that are joined, by name."""
        return self._named("Piece")

    def _named(self, *kinds: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for item, kind in _declared(type(self)):
            if kind in kinds:
                _each(item.name, kind, getattr(self, item.name), found.setdefault)
        return found

    @property
    def needs(self) -> dict[str, Any]:
        """Inputs and pieces."""
        return {**self.inputs, **self.pieces}

    @cached_property
    def content(self) -> Any:
        """The identity of the settings, with that of the content of files that they name."""
        return identity(self.settings)

    @cached_property
    def key(self) -> str:
        """The content address: a digest of stage, version, settings, the inputs' keys, and the stages of the pieces.

        That of a product that users' files define has the content of these files as well.
        """
        inputs = {name: task.key for name, task in self.inputs.items()}
        stages = sorted({task.stage for task in unique(self.pieces.values())})
        code = [identity_of_file(path) for path in files_of_class(type(self))]
        own = [*self.stage, self.content, inputs, *code]
        return digest_json([*own, stages] if stages else own)

    def given(self, needed: Mapping[str, Any]) -> Self:
        """Return the task with other things, such as folders, in place of the tasks that it needs, by their names."""
        changed = {
            item.name: _each(item.name, kind, getattr(self, item.name), lambda name, _: needed[name])
            for item, kind in _declared(type(self))
            if kind
        }
        return replace(self, **changed)


@cache
def _declared(cls: type[Task]) -> list[tuple[Field, str]]:
    """Return the fields of a kind of product, each with the kind of needed products, or empty for a setting."""
    own = [item for item in fields(cls) if item.name not in ("label", "temporary")]
    needed = [NEEDED.search(str(item.type)) for item in own]
    return [(item, found[0] if found else "") for item, found in zip(own, needed, strict=True)]


def _each(name: str, kind: str, value: Any, change: Callable[[str, Any], Any]) -> Any:
    """Return needed products changed one by one, given the name of each."""
    if value is None:
        return None
    if isinstance(value, tuple):
        return tuple(change(f"{name}{place:03d}", item) for place, item in enumerate(value))
    if isinstance(value, Mapping):
        prefix = "" if kind == "Inputs" else f"{name}:"
        return {key: change(f"{prefix}{key}", item) for key, item in value.items()}
    return change(name, value)


def unique(
    tasks: Iterable[Task], given: Container[str] = (), by: Callable[[Task], Any] = attrgetter("key")
) -> list[Task]:
    """Return tasks and all that they need, once each, every task after its inputs; those in `given` need nothing."""
    found: dict[Any, Task] = {}

    def visit(task: Task) -> None:
        if by(task) not in found:
            for needed in () if task.key in given else task.needs.values():
                visit(needed)
            found[by(task)] = task

    for task in tasks:
        visit(task)
    return list(found.values())
