"""The settings of a calibration from a file and from what was typed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calstudy.calibrate.settings import CalibrationSettings
from calstudy.errors import ExperimentError, InputError
from calstudy.experiment.files import override, parse_override, read_mapping
from calstudy.experiment.messages import sentences


def read_settings(path: Path | None, changes: dict[str, Any], overrides: list[str]) -> CalibrationSettings:
    """Return the settings of a YAML file, or the defaults, with changes; None changes nothing.

    Parameters
    ----------
    path
        A file whose content is that of a `calibration` section, or that has one.
    changes
        Dotted path to value, applied first.
    overrides
        ``path=value`` texts, applied last.

    Raises
    ------
    InputError
        If the file cannot be read, or a field holds what is not allowed.
    """
    content = {} if path is None else dict(read_mapping(path))
    content = content.get("calibration", content)
    for field, value in changes.items():
        if value is not None:
            content = override(content, field, value)
    for text in overrides:
        content = override(content, *parse_override(text))
    try:
        settings = CalibrationSettings.model_validate(content)
    except ValidationError as error:
        raise ExperimentError(sentences(error, CalibrationSettings, content)) from None
    blocks = [block for block in (settings.weights, settings.initial_gains) if block.kind == "file"]
    for block in (*blocks, settings.joint_basis):
        if block is not None and not block.path.exists():
            raise InputError(f"{block.path}: no such file")
    return settings
