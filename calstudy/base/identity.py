"""The identity of a product: the fields of its settings that differ from their defaults, and the content of files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from calstudy.base.paths import mapped
from calstudy.base.plugins import Plugin
from calstudy.base.schema import NAMES_FILES, REVISED, defaults
from calstudy.base.user_code import digest_file, identity_of_file


def identity(value: Any) -> Any:
    """Return settings as JSON that is the same for settings that give the same result.

    Fields of sections are omitted if they have their default, so that a new field does not change the keys of earlier
    products; a change of a default requires a new version of the stages that read it, or of the field
    (`calstudy.base.schema.REVISED`). Files, and folders of them, are identified by their content (`identity_of_file`),
    those that are named by default too, and a plug-in by its file or the version of its package.
    """
    if isinstance(value, BaseModel):
        return _identity_of_section(value)
    if isinstance(value, Mapping):
        return {str(key): identity(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [identity(item) for item in value]
    if isinstance(value, Path):
        return _identity_of_folder(value) if value.is_dir() else identity_of_file(value)
    return value


def _identity_of_folder(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): f"sha256:{digest_file(path)}" for path in files}


def _as_file(value: Any) -> Any:
    """Return the path that a text is, if it is the absolute one of an existing file, or else the value."""
    # Of a name that is too long, Path.is_file raises OSError.
    named = isinstance(value, str) and Path(value).is_absolute() and os.path.isfile(value)  # noqa: PTH113
    return Path(value) if named else value


def _identity_of_section(section: BaseModel) -> dict[str, Any]:
    found: dict[str, Any] = {}
    fields = type(section).model_fields
    for name, default in defaults(type(section)).items():
        value, extra = getattr(section, name), fields[name].json_schema_extra
        if isinstance(section, Plugin) and name == section.registry.tag:
            found[name] = section.registry.identity(value)
        elif isinstance(extra, dict) and extra.get("keyed") is False:
            continue
        elif value != default or (isinstance(value, Path) and value.exists()):
            content = identity(mapped(value, _as_file) if extra == NAMES_FILES else value)
            # A block with the identity of the default is left out as well.
            if not (type(value) is type(default) and isinstance(value, BaseModel) and content == identity(default)):
                version = extra.get(REVISED) if isinstance(extra, dict) else None
                found[name] = content if version is None else {REVISED: version, "value": content}
    return found
