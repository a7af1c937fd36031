"""The base of every section of an experiment file."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, BeforeValidator, ConfigDict
from pydantic_core import PydanticCustomError


class Section(BaseModel):
    """A validated, immutable, keyword-only block of an experiment file.

    Unknown keys are errors, values are never coerced between kinds (``"3"`` is not ``3``), and every physical
    quantity carries its unit in the file and is a plain SI float once validated (see `calstudy.units`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def choice(key: str, default: str | None = None) -> BeforeValidator:
    """Make the tag `key` of a choice between blocks easy to write.

    A bare string stands for the block with its defaults (``beam: airy`` for ``beam: {kind: airy}``), and a block
    without the tag is the `default` one.
    """

    def expand(value: Any) -> Any:
        if isinstance(value, str):
            return {key: value}
        if isinstance(value, dict) and key not in value and default is not None:
            return {key: default, **value}
        return value

    return BeforeValidator(expand)


def fault(path: str, sentence: str) -> PydanticCustomError:
    """Return the error for a fault that involves several fields; `path` is the dotted path to name, `sentence` why."""
    return PydanticCustomError("fault", "{sentence}", {"path": path, "sentence": sentence})
