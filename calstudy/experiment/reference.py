"""The reference of all fields of an experiment file, written from the schema itself."""

from __future__ import annotations

import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from calstudy.experiment.collection import CollectionFile, Member
from calstudy.experiment.model import Experiment
from calstudy.experiment.runtime import RuntimeStudy
from calstudy.instrument.settings import AntennaBeam


def _alternatives(annotation: Any) -> list[Any]:
    if get_origin(annotation) is Annotated:
        return _alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return [found for member in get_args(annotation) for found in _alternatives(member)]
    return [annotation]


def _blocks(annotation: Any) -> list[type[BaseModel]]:
    return [item for item in _alternatives(annotation) if isinstance(item, type) and issubclass(item, BaseModel)]


def _kind(info: FieldInfo) -> str:
    """Write what a field takes: its choices, its unit, or its type."""
    extra = info.json_schema_extra
    if isinstance(extra, dict) and "unit" in extra:
        return f"quantity in {extra['unit']}"
    words = []
    for item in _alternatives(info.annotation):
        if get_origin(item) is Literal:
            words.append(" \\| ".join(f"`{value}`" for value in get_args(item)))
        elif get_origin(item) is tuple:
            choices = " \\| ".join(f"`{value}`" for value in get_args(get_args(item)[0]) if isinstance(value, str))
            words.append(f"list of {choices}" if choices else "list")
        elif get_origin(item) is dict:
            words.append("block")
        else:
            words.append(
                {int: "whole number", float: "number", bool: "true or false", str: "text", Path: "path"}.get(item, "")
            )
    return ", or ".join(word for word in words if word)


def _default(info: FieldInfo) -> str:
    if info.default is PydanticUndefined:
        return "built in" if info.default_factory is not None else "required"
    if info.default is None:
        return "null"
    if isinstance(info.default, BaseModel):
        return "see below"
    extra = info.json_schema_extra
    unit = f" {extra['unit']}" if isinstance(extra, dict) and "unit" in extra else ""
    value = list(info.default) if isinstance(info.default, tuple) else info.default
    return f"`{value:g}{unit}`" if isinstance(value, float) else f"`{value}{unit}`"


def _rows(model: type[BaseModel]) -> Iterator[str]:
    for name, info in model.model_fields.items():
        if not _blocks(info.annotation):
            yield f"| `{name}` | {_kind(info)} | {_default(info)} | {info.description or ''} |"


def _plain_section(model: type[BaseModel]) -> Iterator[str]:
    yield (model.__doc__ or "").strip().replace("\n    ", "\n")
    yield ""
    rows = list(_rows(model))
    if rows:
        yield from ("| field | takes | default | |", "|---|---|---|---|", *rows, "")


def _section(model: type[BaseModel], path: str) -> Iterator[str]:
    yield from _plain_section(model)
    for name, info in model.model_fields.items():
        blocks = _blocks(info.annotation)
        inner = f"{path}.{name}" if path else name
        if len(blocks) == 1:
            yield from (f"## `{inner}`", "")
            yield from _section(blocks[0], inner)
        elif blocks:
            yield from (f"## `{inner}`: one of", "")
            for block in blocks:
                tag = next(key for key in ("kind", "name") if key in block.model_fields)
                tags = get_args(block.model_fields[tag].annotation)
                yield from (f"### `{inner}: {' | '.join(map(str, tags))}`", "")
                yield from _section(block, inner)


def field_reference() -> str:
    """Return the reference as Markdown: every section, field, unit, default and what it means."""
    lines = [
        "# Experiment files",
        "",
        "Written by `python -m calstudy fields`; do not edit. An experiment file is YAML. Everything but `name` has a",
        "default, which is the paper's value where the paper has one. Physical quantities are written with their unit",
        '(`"80 kHz"`, `100 ns`, `-40 dB`). Where a block is a choice, its name alone stands for it with its defaults:',
        "`beam: airy` is `beam: {kind: airy}`. Relative paths of input files start at the experiment file.",
        "",
        *_section(Experiment, ""),
        "## `variants`: each",
        "",
        *_section(Experiment.model_fields["variants"].annotation.__args__[1], "variants"),
        "## `instrument.antenna_beams`: each",
        "",
        *_plain_section(AntennaBeam),
        "`beam` takes what `instrument.beam` does.",
        "",
        "# Collection files",
        "",
        "A file with the key `experiments` is a collection. `python -m calstudy run` makes every member in its own run",
        "folder, and what compares them in a folder of the collection; `--scale` and `--set` go to every member.",
        "",
        *_section(CollectionFile, ""),
        "## `experiments`: each",
        "",
        *_section(Member, "experiments"),
        "",
        "# Run-time files",
        "",
        "A file with the key `runtime` is a run-time study. `python -m calstudy run` times the solvers here,",
        "one array after the other; what it measured is kept under a key that names the machine.",
        "",
        *_section(RuntimeStudy, ""),
    ]
    return "\n".join(lines).rstrip() + "\n"
