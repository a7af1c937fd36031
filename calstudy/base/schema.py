"""Sections of an experiment file, and fields with a section of one of several kinds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError
from pydantic_core.core_schema import with_info_wrap_validator_function

from calstudy.base.errors import InputError, nearest

UNKEYED: JsonDict = {"keyed": False}
"""`json_schema_extra` of a field that affects how results are computed, but not their values (except for rounding)."""
REVISED = "revised"
"""Key of `json_schema_extra`: the version of the results of a field's values other than its default."""
NAMES_FILES: JsonDict = {"names_files": True}
"""`json_schema_extra` of a block for a user's code, whose texts may be the paths of files that the code reads."""
FOLDER: JsonDict = {"folder": True}
"""`json_schema_extra` of a path that is a folder of input files."""
NESTED = "nested"
"""Type of the validation error that contains the faults of a block's own settings."""
NOT_IN_FILES = ("tuple", "set", "frozenset", "lax-or-strict")
"""Types of pydantic's schemas for values that a file holds as lists or texts; the last one is that of paths."""


def _of_files(schema: Any) -> Any:
    """Return pydantic's schema of a section, in which types that a file cannot hold also take lists and texts."""
    if isinstance(schema, list):
        return [_of_files(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    kind = schema.get("type")
    if not isinstance(kind, str):
        # A table of fields, which may have any name.
        return {name: _of_files(part) for name, part in schema.items()}
    relaxed = {"strict": False} if kind in NOT_IN_FILES else {}
    kept = ("default", "metadata", "serialization")
    return relaxed | {name: part if name in kept else _of_files(part) for name, part in schema.items()}


class Section(BaseModel):
    """A validated, immutable, keyword-only block of an experiment file.

    Unknown keys are errors, values are never coerced between kinds (``"3"`` is not ``3``), except that a list of the
    file becomes a tuple or set, and a text a path, where the field has this type. Every physical quantity carries its
    unit in the file and is a plain SI float once validated (see `calstudy.base.units`).
    Paths are those of input files, which must exist, unless `holds_input_files` is false.
    """

    holds_input_files: ClassVar[bool] = True

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Accept what a file can hold for fields of a type that it cannot."""
        return _of_files(handler(source))

    @field_validator("*")
    @classmethod
    def _paths_can_be_used(cls, value: Any, info: ValidationInfo) -> Any:
        """Make the path of an input file absolute, which starts at the folder of the experiment file."""
        if not isinstance(value, Path):
            return value
        if "\0" in str(value):
            raise unusable("no file can have this name")
        folder = folder_of_files(info)
        try:
            path = value.expanduser()
            if folder is None or not cls.holds_input_files:
                return value
            path = folder / path
            wanted = "folder" if cls.model_fields[str(info.field_name)].json_schema_extra == FOLDER else "file"
            found = path.is_dir() if wanted == "folder" else path.is_file()
        except RuntimeError:
            raise unusable("there is no such home folder") from None
        except OSError as error:
            raise unusable(f"cannot be read ({error.strerror}; looked for {path})") from None
        if not found:
            raise unusable(f"{path} is not a {wanted}" if path.exists() else f"no such {wanted} (looked for {path})")
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


def alternatives(annotation: Any) -> list[Any]:
    """Return the plain types that a type allows, without Annotated and unions."""
    if get_origin(annotation) is Annotated:
        return alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return [found for member in get_args(annotation) for found in alternatives(member)]
    return [annotation]


S = TypeVar("S", bound=Section)


class Kinds(Generic[S]):
    """The kinds of block that a field may hold, of which the field `tag` of the block names one.

    A name alone stands for the block with its defaults: ``beam: airy`` for ``beam: {kind: airy}``. The kinds are those
    in the type of the field: sections with a literal as tag, and words, which stand for no block.
    """

    def __init__(self, tag: str) -> None:
        self.tag = tag
        self.words: tuple[str, ...] = ()
        self._found: dict[str, type[S]] = {}

    def read(self, annotation: Any) -> None:
        """Take the kinds from a union of types."""
        for kind in get_args(annotation):
            if get_origin(kind) is Literal:
                self.words = get_args(kind)
            else:
                self._found |= dict.fromkeys(get_args(kind.model_fields[self.tag].annotation), kind)

    @property
    def base(self) -> Any:
        """The class, or the classes, of the blocks."""
        return tuple(self._found.values())

    @property
    def wanted(self) -> str:
        """What is allowed, in words."""
        return f"one of {', '.join(self.names())}"

    def built_in(self) -> list[str]:
        """Return the names of the built-in kinds of block."""
        return list(self._found)

    def names(self) -> list[str]:
        """Return all names and words."""
        return [*self.words, *self.built_in()]

    def others(self) -> list[JsonSchemaValue]:
        """Return the JSON schemas of what is allowed besides the names and the built-in blocks."""
        return []

    def find(self, reference: str) -> type[S]:
        """Return the class of a kind; raises InputError, without the field, if there is none of this name."""
        if reference not in self._found:
            names = self.names()
            raise InputError(f"{reference!r} is not a choice{nearest(reference, names)} (allowed: {', '.join(names)})")
        return self._found[reference]

    def class_of(self, block: Mapping[str, Any], default: str | None, folder: Path | None) -> tuple[type[S], str]:
        """Return the class for a block of settings, and its name or absolute path; raises as `make`."""
        del folder
        reference = block.get(self.tag, default)
        if not isinstance(reference, str):
            raise InputError(f"needs {self.tag!r}, {self.wanted}")
        return self.find(reference), reference

    def having(self, key: str) -> list[str]:
        """Return the built-in kinds of block with a key."""
        return [name for name in self.built_in() if key in self.find(name).model_fields]

    def make(self, block: Any, default: str | None = None, **context: Any) -> S:
        """Return the section that a name, a path or a block of settings describes; a section or word is unchanged.

        A block without the tag is of the kind `default`. Relative paths of files start at the `folder` of the context
        of the validation, or at the working directory. Raises pydantic.ValidationError if the settings are invalid, and
        InputError if there is no such kind.
        """
        if isinstance(block, self.base) or block in self.words:
            return block
        block = {self.tag: block} if isinstance(block, str) else dict(block)
        found, reference = self.class_of(block, default, context.get("folder"))
        return found.model_validate({**block, self.tag: reference}, context=context)

    def field(self, default: str | None = None) -> KindField:
        """Return the annotation of a field of an experiment file with one of the kinds."""
        return KindField(self, default)


def choice(tag: str, default: str | None = None) -> KindField:
    """Return the annotation of a field whose type is a union of sections; a block without the tag is the default."""
    return KindField(Kinds(tag), default)


@dataclass(frozen=True, eq=False)
class KindField:
    """The annotation of a field with one of several kinds of block, from `Kinds.field` or `choice`."""

    kinds: Kinds[Any]
    default: str | None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate blocks by their kind; the type of the field alone decides how they are written."""
        self.kinds.read(source)
        return with_info_wrap_validator_function(self._validate, handler(source))

    def _validate(self, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        del handler
        kinds, context = self.kinds, info.context or {}
        if not isinstance(value, (str, Mapping, kinds.base)):
            raise unusable(f"must be {kinds.wanted}, or a block with {kinds.tag!r}")
        try:
            return kinds.make(value, self.default, **context)
        except ValidationError as error:
            content = dict(value) if isinstance(value, Mapping) else {kinds.tag: value}
            model, _ = kinds.class_of(content, self.default, context.get("folder"))
            nested = {"error": error, "content": content, "model": model, "kinds": kinds}
            raise PydanticCustomError(NESTED, "nested", nested) from None
        except InputError as error:
            raise fault(kinds.tag if isinstance(value, Mapping) else "", str(error)) from None

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema of the names, of the blocks of built-in kinds, and of references to files."""
        tag, union = self.kinds.tag, handler(core).get("anyOf", [])
        allowed = [{"enum": self.kinds.names()}, *self.kinds.others(), *union]
        # The type of a field with plug-ins has no blocks; a union has those with a tag.
        for name in filter(None, [self.default]) if union else self.kinds.built_in():
            block = handler.resolve_ref_schema(handler(self.kinds.find(name).__pydantic_core_schema__))
            required = [field for field in block.get("required", []) if field != tag]
            properties = {**block.get("properties", {}), tag: {"const": name}}
            tagged = required if name == self.default else [*required, tag]
            allowed.append({**block, "properties": properties, "required": tagged})
        return {"anyOf": allowed}


def folder_of_files(info: ValidationInfo) -> Path | None:
    """Return the folder at which paths of input files start, which must exist; None if they are not looked for."""
    context = info.context or {}
    return context.get("folder") if context.get("files", True) else None


def unusable(sentence: str) -> PydanticCustomError:
    """Return the error for the value of a field, which the message has before the sentence."""
    return PydanticCustomError("unusable", "{sentence}", {"sentence": sentence})


def fault(path: str, sentence: str) -> PydanticCustomError:
    """Return the error for a fault that involves several fields, with the dotted `path` of a field and a sentence."""
    return PydanticCustomError("fault", "{sentence}", {"path": path, "sentence": sentence})
