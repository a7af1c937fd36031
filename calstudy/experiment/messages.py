"""Convert pydantic's errors to sentences with the field's dotted path, the value, and the allowed values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import NoneType
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from calstudy.base.errors import nearest
from calstudy.base.paths import value_at
from calstudy.base.schema import NESTED, Kinds, alternatives

KINDS = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a text",
    "path_type": "a path",
    "tuple_type": "a list",
    "dict_type": "a block of keys",
    "model_type": "a block of keys",
    "model_attributes_type": "a block of keys",
    "finite_number": "a finite number",
    "int_parsing": "a whole number",
}
BOUNDS = {
    "greater_than": ("greater than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
}
"""Words of a bound, and the key of its value."""
PREFIXED = ("Hz", "s", "m")
PREFIXES = {1e9: "G", 1e6: "M", 1e3: "k", 1.0: "", 1e-3: "m", 1e-6: "u", 1e-9: "n"}


def _items(annotation: Any) -> list[Any]:
    """Return the types of the items of a block or a list, or nothing for any other type."""
    position = {dict: 1, tuple: 0}.get(get_origin(annotation))
    return [] if position is None else alternatives(get_args(annotation)[position])


def _locate(root: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, type[BaseModel] | None]:
    """Follow a pydantic location; return the dotted path, and the block of its last step."""
    path: list[str] = []
    members: list[Any] = [root]
    holder: type[BaseModel] | None = None
    for step in map(str, location):
        members = [member for member in members if member is not NoneType]
        if len(members) > 1:
            members = []  # The step is pydantic's name of one of several types.
            continue
        path.append(step)
        holder = next((kind for kind in members if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
        if holder is None:
            members = [item for member in members for item in _items(member)]
        else:
            members = alternatives(holder.model_fields[step].annotation) if step in holder.model_fields else []
    return ".".join(path), holder


def _unit(holder: type[BaseModel] | None, field: int | str) -> str:
    """Return the unit of a field's bounds, or an empty string."""
    info = holder.model_fields.get(str(field)) if holder else None
    extra = info.json_schema_extra if info else None
    return str(extra.get("unit", "")) if isinstance(extra, dict) else ""


def _bound(number: float, unit: str) -> str:
    """Write a bound with its unit: 1e7 Hz as 10 MHz."""
    largest = 1.0 if unit == "s" else math.inf
    fitting = [factor for factor in PREFIXES if abs(number) >= factor and factor <= largest]
    if unit not in PREFIXED or not fitting:
        return f"{number:.10g} {unit}".strip()
    return f"{number / fitting[0]:.10g} {PREFIXES[fitting[0]]}{unit}"


def _unknown(key: str, holder: type[BaseModel] | None, data: Any, kinds: Kinds[Any] | None) -> str:
    """Return the sentence on a key that a block has not; `kinds` are those of the block, if it is one of several."""
    keys = sorted(holder.model_fields) if holder else []
    if kinds is not None and (others := kinds.having(key)):
        what = f"{data[kinds.tag]!r} has no such key, but {', '.join(others)} {'has' if len(others) == 1 else 'have'}"
    else:
        what = f"unknown key{nearest(key, keys)}"
    return f"{what} (allowed: {', '.join(keys)})"


def _sentence(root: type[BaseModel], error: Any, data: Any, prefix: str, kinds: Kinds[Any] | None) -> str:
    kind, context = error["type"], error.get("ctx", {})
    inner, holder = _locate(root, error["loc"])
    path = f"{prefix}{inner}" if inner else prefix.removesuffix(".")
    if kind == "fault":
        path = ".".join(part for part in (path, context["path"]) if part)
        return f"{path}: {context['sentence']}"
    if kind == "quantity":
        return f"{path}: {context['value']} {context['reason']}"
    if kind == "extra_forbidden":
        return f"{path}: {_unknown(str(error['loc'][-1]), holder, data, None if '.' in inner else kinds)}"
    if kind == "missing":
        return f"{path}: missing, and it has no default"
    if kind == "value_error":
        field, colon, text = str(context["error"]).partition(": ")
        return f"{path}.{field}: {text}" if colon and field.isidentifier() else f"{path}: {context['error']}"
    if kind in ("too_short", "too_long"):
        bound = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"{path}: must have {bound} item(s), has {context['actual_length']}"
    value = value_at(data, inner, {})
    written = " (empty)" if value is None else "" if isinstance(value, dict | list) else f" = {value!r}"
    return f"{path}{written}: {_wanted(error, holder)}"


def _wanted(error: Any, holder: type[BaseModel] | None) -> str:
    """Return the requirement that a value does not meet."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "literal_error":
        allowed = [word.strip(" '") for word in context["expected"].replace(" or ", ", ").split(",")]
        if str(error["input"]) in allowed:
            what, how = ("a text", "without") if isinstance(error["input"], str) else ("a number", "in")
            return f"is {what}; write it {how} quotes (allowed: {', '.join(allowed)})"
        return f"not a choice{nearest(error['input'], allowed)} (allowed: {', '.join(allowed)})"
    if kind in BOUNDS:
        words, key = BOUNDS[kind]
        return f"must be {words} {_bound(context[key], _unit(holder, error['loc'][-1]))}"
    if kind in KINDS:
        return f"must be {KINDS[kind]}"
    if kind == "string_pattern_mismatch":
        return f"must match {context['pattern']}"
    return str(error["msg"])


def _all(
    error: ValidationError, root: type[BaseModel], data: Any, prefix: str, kinds: Kinds[Any] | None = None
) -> Iterator[str]:
    found = error.errors()
    for item in found:
        # A list is too short for pydantic if one of its items is wrong, which has a sentence of its own.
        above = item["loc"]
        inside = (other["loc"] for other in found if other["loc"] != above and other["loc"][: len(above)] == above)
        if item["type"] == "too_short" and any(inside):
            continue
        if item["type"] == NESTED:
            path, context = f"{prefix}{_locate(root, item['loc'])[0]}.", item["ctx"]
            yield from _all(context["error"], context["model"], context["content"], path, context["kinds"])
        else:
            yield _sentence(root, item, data, prefix, kinds)


def sentences(error: ValidationError, root: type[BaseModel], data: Any) -> list[str]:
    """Return one sentence per fault that pydantic found in `data`, the content of a file, as the model `root`."""
    return list(dict.fromkeys(_all(error, root, data, "")))
