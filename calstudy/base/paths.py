"""Fields of nested blocks by their dotted paths: read one, change one, list them all, and compare two blocks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from copy import deepcopy
from typing import Any

from calstudy.base.errors import InputError


def value_at(content: Any, path: str, missing: Any = None) -> Any:
    """Return the value at a dotted path, with items of lists counted from 0; `missing` if there is none."""
    for step in path.split("."):
        if isinstance(content, Mapping) and step in content:
            content = content[step]
        elif isinstance(content, list | tuple) and _is_number(step) and int(step) < len(content):
            content = content[int(step)]
        else:
            return missing
    return content


def with_value(
    content: Mapping[str, Any], path: str, value: Any, block_for: Callable[[str, Any], Any] = lambda above, given: None
) -> dict[str, Any]:
    """Return a copy of a block with the field at a dotted path set to a value.

    Items of a list are counted from 0. Keys of the block may themselves be dotted paths. `block_for` returns the block
    or list for a value above the field, with its path, that is neither; None if there is none.
    """
    result = deepcopy(dict(content))
    block: Any = result
    above, rest = "", path
    while True:
        key, step, rest = _split(block, rest, path)
        if not rest:
            block[key] = value
            return result
        above = f"{above}.{step}" if above else step
        inner = block.get(key) if isinstance(block, dict) else block[key]
        if not isinstance(inner, dict | list):
            given, inner = inner, block_for(above, inner)
            if inner is None:
                raise InputError(f"{path}: cannot be set, for {step!r} is {given!r} and not a block of keys")
        block[key] = block = inner


def _split(block: dict[str, Any] | list[Any], rest: str, path: str) -> tuple[Any, str, str]:
    """Split a path after its first step, or after the dotted key that a block has; return the key and both parts."""
    steps = rest.split(".")
    if isinstance(block, dict):
        dotted = (count for count in range(len(steps), 1, -1) if ".".join(steps[:count]) in block)
        count = next(dotted, 1)
        step = ".".join(steps[:count])
        return step, step, ".".join(steps[count:])
    if not _is_number(steps[0]) or int(steps[0]) >= len(block):
        raise InputError(
            f"{path}: cannot be set, for {steps[0]!r} is not an item of a list of {len(block)}, counted from 0"
        )
    return int(steps[0]), steps[0], ".".join(steps[1:])


def _is_number(step: str) -> bool:
    """Return whether a step is a number of plain digits, and not one such as ²."""
    return step.isascii() and step.isdecimal()


def leaves(
    content: Any, whole: Callable[[Mapping[str, Any]], bool] = lambda block: False, path: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the value of every field, also in lists of blocks.

    Empty blocks are values, and so are those that are `whole`.
    """
    blocks: Mapping[Any, Any] = {}
    if isinstance(content, Mapping):
        blocks = {} if whole(content) else content
    elif isinstance(content, list | tuple) and any(isinstance(item, Mapping) for item in content):
        blocks = dict(enumerate(content))
    for key, item in blocks.items():
        yield from leaves(item, whole, f"{path}.{key}" if path else str(key))
    if path and not blocks:
        yield path, content


def differences(first: Any, second: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted path and both values of every field that differs.

    A value that one block lacks is None. Blocks with another `kind` differ as a whole.
    """
    if isinstance(first, Mapping) and isinstance(second, Mapping) and first.get("kind") == second.get("kind"):
        for key in {**first, **second}:
            yield from differences(first.get(key), second.get(key), f"{path}.{key}" if path else key)
    elif first != second:
        yield path, first, second


def texts(value: Any, below: Collection[str] = ()) -> Iterator[str]:
    """Yield all texts in nested blocks and lists, or only those below one of some keys."""
    if isinstance(value, str):
        if not below:
            yield value
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from texts(item, () if key in below else below)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from texts(item, below)


def mapped(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a content in which everything but mappings and lists is changed by a function."""
    if isinstance(value, Mapping):
        return {name: mapped(item, change) for name, item in value.items()}
    return [mapped(item, change) for item in value] if isinstance(value, list | tuple) else change(value)
