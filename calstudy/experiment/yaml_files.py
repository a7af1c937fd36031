"""Read the YAML of experiment files, without duplicate keys and ambiguous numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from calstudy.base.errors import InputError


class _Loader(yaml.SafeLoader):
    """Safe YAML that refuses duplicate keys and reads 1e-9 as a number (as YAML 1.2 does)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(problem=f"key {key!r} is not a text", problem_mark=key_node.start_mark)
            if key in keys:
                raise yaml.MarkedYAMLError(problem=f"key {key!r} appears twice", problem_mark=key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)
OCTAL = re.compile(r"[-+]?0[0-7_]+")


def _whole_number(loader: _Loader, node: yaml.ScalarNode) -> int:
    """Read a whole number; refuse texts that YAML 1.1 and a reader take for different numbers."""
    text = str(node.value)
    number = int(loader.construct_yaml_int(node))
    if OCTAL.fullmatch(text):
        hint = f"leave out the zero in front, or write {number} if that is meant"
        raise yaml.MarkedYAMLError(
            problem=f"{text} is an octal number in YAML, {number}; {hint}", problem_mark=node.start_mark
        )
    if ":" in text:
        raise _base_60(node, number)
    return number


def _real_number(loader: _Loader, node: yaml.ScalarNode) -> float:
    """Read a real number; refuse one to the base 60."""
    number = float(loader.construct_yaml_float(node))
    if ":" in str(node.value):
        raise _base_60(node, number)
    return number


def _base_60(node: yaml.ScalarNode, number: float) -> yaml.MarkedYAMLError:
    problem = f"{node.value} is a number to the base 60 in YAML, {number:g}; write a number with a unit, such as 6.4 h"
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


_Loader.add_constructor("tag:yaml.org,2002:int", _whole_number)
_Loader.add_constructor("tag:yaml.org,2002:float", _real_number)


KINDS_OF_YAML: dict[type, str] = {list: "a list", str: "a text", int: "a number", float: "a number", bool: "a word"}
UNKNOWN_TAG = re.compile(r"could not determine a constructor for the tag '(.*)'")


def parse_yaml(text: str, origin: str) -> Any:
    """Parse YAML text; raises InputError with one sentence (origin, line, problem) if it is not valid."""
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        raise InputError(f"{origin}:{line} {_problem(error)}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{origin}: not valid YAML ({str(error).splitlines()[0]})") from None


def _problem(error: yaml.MarkedYAMLError) -> str:
    tag = UNKNOWN_TAG.search(error.problem or "")
    if tag is None:
        return error.problem or "not valid YAML"
    if tag[1] == "tag:yaml.org,2002:merge":
        return "merge keys (<<) are not read; write the block out"
    return f"the tag {tag[1]} is refused: only texts, numbers, lists and blocks of keys are read, never objects"


def read_mapping(path: Path, example: str = "name: quickstart") -> dict[str, Any]:
    """Read a YAML file with a block of keys, such as the example; raises InputError for any other file."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file in UTF-8") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a file (YAML) of an experiment") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    data = parse_yaml(text, str(path))
    if not isinstance(data, dict):
        held = "is empty" if data is None else f"holds {KINDS_OF_YAML.get(type(data), 'something else')}"
        raise InputError(f"{path}: must hold a block of keys such as {example!r}, and {held}")
    return data
