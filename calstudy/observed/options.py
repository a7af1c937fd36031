"""The calibrator and its settings, from a file and from the command line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calstudy.base.errors import ExperimentError, InputError
from calstudy.calibrate.interface import CALIBRATORS, Calibrator
from calstudy.experiment.files import input_files, override, parse_override
from calstudy.experiment.messages import sentences
from calstudy.experiment.yaml_files import read_mapping

DEFAULT = "calamity"


def read_calibrator(
    path: Path | None, changes: Mapping[str, Any], defaults: Mapping[str, Any], overrides: Sequence[str]
) -> Calibrator:
    """Return the calibrator of a YAML file, or the default one, with changes; a value of None changes nothing.

    The file is a `calibration` section, or has one. `changes`, by dotted path, apply first, then `defaults` of fields
    that neither the file nor a change sets, and last `overrides`, ``path=value`` texts. Relative paths in the latter
    start at the working directory. Raise InputError if the file cannot be read, there is no such calibrator, or a field
    has an invalid value.
    """
    # Overrides may use the path of the field in an experiment file.
    typed = [(field.removeprefix("calibration."), value) for field, value in map(parse_override, overrides)]
    asked = _changed(_content(path), [(field, value) for field, value in changes.items() if value is not None])
    try:
        found, _ = CALIBRATORS.class_of(_changed(asked, typed), DEFAULT, None)
    except InputError as error:
        raise InputError(f"calibration.calibrator: {error}") from None
    usual = {key: value for key, value in defaults.items() if value is not None and key in found.model_fields}
    content = _changed({**usual, **asked}, typed)
    try:
        calibrator = CALIBRATORS.make(content, DEFAULT)
    except ValidationError as error:
        raise ExperimentError([f"calibration.{sentence}" for sentence in sentences(error, found, content)]) from None
    if calibrator.assumed:
        raise InputError(
            "calibration.assumed: is for simulated data; give the sky model of measured ones by --sky-model"
        )
    for field, section, name in input_files(calibrator):
        if not (file := getattr(section, name)).exists():
            raise InputError(f"calibration.{field} = {str(file)!r}: no such file")
    return calibrator


def _changed(content: dict[str, Any], changes: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    for field, value in changes:
        content = override(content, field, value)
    return content


def _content(path: Path | None) -> dict[str, Any]:
    """Return the calibration section of a file; the path of a calibrator in it starts at the file."""
    if path is None:
        return {}
    content = dict(read_mapping(path, f"{CALIBRATORS.tag}: {DEFAULT}"))
    section = content.get("calibration", content)
    content = {CALIBRATORS.tag: section} if isinstance(section, str) else dict(section)
    reference = content.get(CALIBRATORS.tag)
    if isinstance(reference, str) and ".py" in reference:
        content[CALIBRATORS.tag] = str(path.parent / Path(reference).expanduser())
    return content
