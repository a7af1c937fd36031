"""The validation ladder, loaded as the command does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calstudy.experiment.files import StudyFile
from calstudy.validation.ladder import Ladder


def load_ladder(steps: Sequence[str] = (), scale: str = "full", overrides: Sequence[str] = ()) -> Ladder:
    """Return the steps with these numbers or in these files, all by default."""
    return Ladder.load(StudyFile(Path(), {"steps": steps}, scale, overrides))
