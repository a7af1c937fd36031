"""The reference of all fields of an experiment file, as text, and as the JSON schema by which editors check files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import wrap
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import models_json_schema
from pydantic_core import PydanticUndefined

from calstudy.base.errors import InputError, nearest
from calstudy.base.plugins import Plugin, Registry
from calstudy.base.schema import KindField, Kinds, alternatives
from calstudy.base.user_code import load_file
from calstudy.experiment.model import Experiment
from calstudy.studies.study import KINDS, Study, built_in_kinds

PLAIN: dict[Any, str] = {int: "whole number", float: "number", str: "text", Path: "path"}


def _blocks(annotation: Any) -> list[type[BaseModel]]:
    return [item for item in alternatives(annotation) if isinstance(item, type) and issubclass(item, BaseModel)]


def _kinds(info: FieldInfo) -> Kinds[Any] | None:
    """Return the kinds of block in a field, one or a list of them; None for other fields."""
    items = [data for item in get_args(info.annotation) for data in getattr(item, "__metadata__", ())]
    return next((data.kinds for data in [*info.metadata, *items] if isinstance(data, KindField)), None)


def _unit(info: FieldInfo) -> str | None:
    """Return the unit of a physical quantity, even if the field may be null; None for other fields."""
    fields = [info, *(data for item in get_args(info.annotation) for data in getattr(item, "__metadata__", ()))]
    extras = [field.json_schema_extra for field in fields if isinstance(field, FieldInfo)]
    return next((str(extra["unit"]) for extra in extras if isinstance(extra, dict) and "unit" in extra), None)


def _kind(info: FieldInfo) -> str:
    """Describe the values of a field: its choices, its unit, or its type."""
    if (unit := _unit(info)) is not None:
        return f"quantity in {unit}"
    words = []
    for item in alternatives(info.annotation):
        if get_origin(item) is Literal:
            words.append(" \\| ".join(f"`{value}`" for value in get_args(item)))
        elif get_origin(item) in (tuple, list):
            entry = get_args(item)[0]
            choices = " \\| ".join(f"`{value}`" for value in get_args(entry) if isinstance(value, str))
            entries = choices or (f"{PLAIN[entry]}s" if entry in PLAIN else "")
            words.append(f"list of {entries}" if entries else "list")
        elif get_origin(item) is dict or _blocks(item):
            words.append("block")
        else:
            words.append("true or false" if item is bool else PLAIN.get(item, ""))
    return ", or ".join(dict.fromkeys(word for word in words if word))


def _default(info: FieldInfo) -> str:
    if info.default is PydanticUndefined:
        return "built in" if info.default_factory is not None else "required"
    if info.default is None:
        return "null"
    if isinstance(info.default, BaseModel):
        return "see below"
    unit = f" {_unit(info)}" if _unit(info) else ""
    value = info.default
    if isinstance(value, tuple):
        value = [item.label if isinstance(item, Plugin) else item for item in value]
    return f"`{value:g}{unit}`" if isinstance(value, float) else f"`{value}{unit}`"


def _rows(model: type[BaseModel]) -> Iterator[str]:
    tag = model.registry.tag if issubclass(model, Plugin) else None
    for name, info in model.model_fields.items():
        words = any(get_origin(item) is Literal for item in alternatives(info.annotation))
        if name != tag and (words or not _blocks(info.annotation)):
            yield f"| `{name}` | {_kind(info)} | {_default(info)} | {info.description or ''} |"


def _plain_section(model: type[BaseModel]) -> Iterator[str]:
    yield (model.__doc__ or "").strip().replace("\n    ", "\n")
    yield ""
    rows = list(_rows(model))
    if rows:
        yield from ("| field | takes | default | |", "|---|---|---|---|", *rows, "")


def _section(model: type[BaseModel], path: str, listed: dict[str, str]) -> Iterator[str]:
    """Write a block and all blocks in it; `listed` has the path under which each kind of plug-in was listed before."""
    yield from _plain_section(model)
    for name, info in model.model_fields.items():
        yield from _blocks_of(info, f"{path}.{name}" if path else name, listed)


def _blocks_of(info: FieldInfo, path: str, listed: dict[str, str]) -> Iterator[str]:
    """Write the blocks that a field accepts; nothing for other fields."""
    blocks = _blocks(info.annotation)
    if (kinds := _kinds(info)) is not None:
        if path not in listed:
            listed[path] = path
            yield from (f"## `{path}`: {'one' if blocks else 'a list, each'} of", "")
            yield from _any_of(kinds, path, listed)
    elif len(blocks) == 1:
        yield from (f"## `{path}`", "")
        yield from _section(blocks[0], path, listed)
    elif len(items := _items(info.annotation)) == 1:
        yield from (f"## `{path}`: each", "", *_section(items[0], path, listed))


def _items(annotation: Any) -> list[type[BaseModel]]:
    """Return the blocks, but for plug-ins, that a field accepts as items of a list, or as values of a mapping."""
    lists = [item for item in alternatives(annotation) if get_origin(item) in (tuple, dict)]
    return [
        block for item in lists for value in get_args(item) for block in _blocks(value) if not issubclass(block, Plugin)
    ]


def _any_of(kinds: Kinds[Any], path: str, listed: dict[str, str]) -> Iterator[str]:
    """Write all kinds of block, with those of installed packages; blocks that several share are written once."""
    names = kinds.built_in()
    if isinstance(kinds, Registry):
        if path != (first := listed.setdefault(kinds.noun, path)):
            yield from (f"See `{first}`.", "")
            return
        yield from (f"`{kinds.tag}` is the name of {kinds.a_noun}, or the path of a Python file that holds one.", "")
        names = kinds.names()
    by_class: dict[type[BaseModel], list[str]] = {}
    for name in names:
        try:
            by_class.setdefault(kinds.find(name), []).append(name)
        except InputError as error:
            yield from (f"### `{path}: {{{kinds.tag}: {name}}}`", "", f"Cannot be used here: {error}", "")
    shared: dict[str, FieldInfo] = {}
    for found, own in by_class.items():
        yield from (f"### `{path}: {{{kinds.tag}: {' | '.join(own)}}}`", "")
        yield from _plain_section(found)
        blocks = {key: info for key, info in found.model_fields.items() if _blocks(info.annotation)}
        if blocks:
            yield from (f"And the blocks {', '.join(f'`{key}`' for key in blocks)}.", "")
        shared |= blocks
    for name, info in shared.items():
        yield from _blocks_of(info, f"{path}.{name}", listed)


def plugin_reference(path: Path) -> str:
    """Return the Markdown reference of the plug-ins in a Python file; InputError if it cannot be run, or has none."""
    module = load_file(path)
    own = [thing for thing in vars(module).values() if isinstance(thing, type) and thing.__module__ == module.__name__]
    kinds = [thing for thing in own if issubclass(thing, Study)]
    found = [thing for thing in own if issubclass(thing, Plugin)]
    if not found and not kinds:
        raise InputError(
            f"{path}: holds no calibrator, figure or the like (no subclass of calstudy.base.plugins.Plugin)"
        )
    lines = []
    for plugin in found:
        tag = plugin.registry.tag
        lines += [f"# {plugin.registry.noun.capitalize()} `{tag}: {path.name}:{plugin.__name__}`", ""]
        lines += _section(plugin, "", {})
    for kind in kinds:
        lines += [f"# Files with `{KINDS.tag}: {path.name}:{kind.__name__}`", "", *_section(kind.model, "", {})]
    return "\n".join(lines).rstrip() + "\n"


def section_reference(section: str) -> str:
    """Return the reference of a section, such as ``calibration.basis``, and of those in it; InputError without one."""
    sections: list[str] = []
    for kind_of_file in re.split(r"^(?=# )", field_reference(), flags=re.MULTILINE):
        parts = re.split(r"^(?=##+ `([\w.]+))", kind_of_file, flags=re.MULTILINE)[1:]
        paths, texts = parts[::2], parts[1::2]
        chosen = [text for path, text in zip(paths, texts, strict=True) if f"{path}.".startswith(f"{section}.")]
        if chosen:
            return "".join(chosen).rstrip() + "\n"
        sections += paths
    first = ", ".join(dict.fromkeys(path for path in sections if "." not in path))
    raise InputError(
        f"{section}: neither a section of experiment files{nearest(section, sections)} (at the top: {first}), "
        "nor a Python file"
    )


def field_reference() -> str:
    """Return the reference as Markdown: every section, field, unit, default and meaning."""
    listed: dict[str, str] = {}
    lines = [
        "# Experiment files",
        "",
        "An experiment file is YAML. Everything but `name` has a default, that of the paper with few exceptions.",
        'Physical quantities are written with their unit (`"80 kHz"`, `100 ns`, `-40 dB`). Where a block is a',
        "choice, its name alone stands for it with its defaults: `beam: airy` is `beam: {kind: airy}`. Relative paths",
        "of input files start at the experiment file. `calstudy fields SECTION` prints one section of this page.",
        "",
        *_section(Experiment, "", listed),
    ]
    for kind in built_in_kinds():
        if kind.heading:
            lines += [f"# {kind.heading}", "", *wrap(kind.guide, 120), "", *_section(kind.model, "", listed)]
    return "\n".join(lines).rstrip() + "\n"


SCHEMA_FILE = "experiment.schema.json"
"""Name of the published schema, next to the experiments."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"
SCHEMA_TITLE = "calstudy experiment"


def experiment_schema() -> str:
    """Return the JSON schema of the files of all built-in kinds of study as text.

    It has strings for quantities; only ``calstudy plan`` checks units and conditions on several fields.
    """
    kinds = {kind.model: kind.key for kind in built_in_kinds() if kind.model is not Experiment}
    models: list[type[BaseModel]] = [Experiment, *kinds]
    references, found = models_json_schema([(model, "validation") for model in models])
    schema: dict[str, Any] = references[Experiment, "validation"]
    for model, key in kinds.items():
        schema = {"if": {"required": [key]}, "then": references[model, "validation"], "else": schema}
    definitions = {name: _plain(block) for name, block in found["$defs"].items()}
    whole = {"$schema": DIALECT, "title": SCHEMA_TITLE, "type": "object", **schema, "$defs": definitions}
    return json.dumps(whole, indent=1, sort_keys=True) + "\n"


def _plain(block: Any) -> Any:
    """Return a schema without the titles that pydantic derives from names, and without defaults of whole blocks."""
    if isinstance(block, list):
        return [_plain(item) for item in block]
    if not isinstance(block, dict):
        return block
    left_out = {"title"} if isinstance(block.get("title"), str) else set()
    if isinstance(block.get("default"), dict | list):
        left_out.add("default")
    return {key: _plain(value) for key, value in block.items() if key not in left_out}
