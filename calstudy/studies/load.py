"""Read a file, and return the study that it describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calstudy.experiment.files import StudyFile
from calstudy.studies.study import KINDS, Study, kind_of


def load_study(path: Path, scale: str | None = None, overrides: Sequence[str] = ()) -> Study:
    """Read a YAML file, or a published one by its name, such as ``quickstart``, and return the study that it describes.

    Overrides are ``path=value`` texts, applied after the scale of the file's `scales`. Raises InputError if a file
    cannot be read, or a scale or override cannot be applied, and ExperimentError if fields are unknown, missing, or
    have values that are not allowed.
    """
    return study_of(StudyFile.open(path, scale, overrides))


def study_of(file: StudyFile) -> Study:
    """Return the study that the content of a file describes; errors as for `load_study`."""
    kind = kind_of(file.content, file.folder)
    plain = {key: value for key, value in file.content.items() if key != KINDS.tag}
    return kind.load(replace(file, content=plain))
