"""The base class of every section of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, GetJsonSchemaHandler, ValidationInfo, field_validator
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

UNKEYED: JsonDict = {"keyed": False}
"""`json_schema_extra` of a field that affects how results are computed, but not their values (except for rounding)."""
FOLDER: JsonDict = {"folder": True}
"""`json_schema_extra` of a path that is a folder of input files."""


class Section(BaseModel):
    """A validated, immutable, keyword-only block of an experiment file.

    Unknown keys are errors, values are never coerced between kinds (``"3"`` is not ``3``), and every physical
    quantity carries its unit in the file and is a plain SI float once validated (see `calstudy.base.units`).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _input_files_exist(cls, value: Any, info: ValidationInfo) -> Any:
        """Make the path of an input file absolute, which starts at the folder of the experiment file."""
        folder = folder_of_files(info)
        if folder is None or not isinstance(value, Path):
            return value
        wanted = "folder" if cls.model_fields[str(info.field_name)].json_schema_extra == FOLDER else "file"
        path = folder / expand_user(value)
        try:
            found = path.is_dir() if wanted == "folder" else path.is_file()
        except OSError as error:
            raise unusable(f"cannot be read ({error.strerror}; looked for {path})") from None
        if not found:
            raise unusable(f"no such {wanted} (looked for {path})")
        return path.resolve()

    def with_defaults(self, *names: str) -> Self:
        """Return a copy in which the named fields have their defaults, for code that does not read them."""
        found = defaults(type(self))
        return self.model_copy(update={name: found[name] for name in names})


@cache
def defaults(section: type[BaseModel]) -> Mapping[str, Any]:
    """Return the default of every field of a section; it must not be changed.

    The defaults are cached, because pydantic makes a new copy at every call, which is slow.
    """
    return {name: field.get_default(call_default_factory=True) for name, field in section.model_fields.items()}


def plain(value: Any) -> Any:
    """Return nested settings as JSON-able values; sections with all their fields."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


@dataclass(frozen=True, kw_only=True)
class ChoiceValidator(BeforeValidator):
    """The validator of a choice between blocks, from `choice`."""

    key: str
    default: str | None

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema of the blocks, of their names, and of the default block without its name."""
        found = dict(handler(core))
        tags = found.pop("discriminator", {"mapping": {}})["mapping"]
        blocks = found.pop("oneOf", None) or [handler(core)]
        names: JsonSchemaValue = {"enum": list(tags)} if tags else {"type": "string"}
        allowed = [names, *blocks]
        if self.default in tags:
            block = handler.resolve_ref_schema({"$ref": tags[self.default]})
            allowed.append({**block, "required": [name for name in block.get("required", []) if name != self.key]})
        return {"anyOf": allowed}


def choice(key: str, default: str | None = None) -> BeforeValidator:
    """Allow short forms of a choice between blocks with the tag `key`.

    A bare string means the block with its defaults (``beam: airy`` for ``beam: {kind: airy}``), and a block
    without the tag is the `default` one.
    """

    def expand(value: Any) -> Any:
        if isinstance(value, str):
            return {key: value}
        if isinstance(value, dict) and key not in value and default is not None:
            return {key: default, **value}
        return value

    return ChoiceValidator(expand, key=key, default=default)


def folder_of_files(info: ValidationInfo) -> Path | None:
    """Return the folder at which paths of input files start, which must exist; None if they are not looked for."""
    context = info.context or {}
    return context.get("folder") if context.get("files", True) else None


def expand_user(path: Path) -> Path:
    """Replace a leading ~ by the home folder; for validators of paths."""
    if "\0" in str(path):
        raise unusable("no file can have this name")
    try:
        return path.expanduser()
    except RuntimeError:
        raise unusable("there is no such home folder") from None


def unusable(sentence: str) -> PydanticCustomError:
    """Return the error for the value of a field, which the message has before the sentence."""
    return PydanticCustomError("unusable", "{sentence}", {"sentence": sentence})


def fault(path: str, sentence: str) -> PydanticCustomError:
    """Return the error for a fault that involves several fields, with the dotted `path` of a field and a sentence."""
    return PydanticCustomError("fault", "{sentence}", {"path": path, "sentence": sentence})
