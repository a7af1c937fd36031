"""Make the results of a reference again, from cached or fresh products."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.regression.reference import EXPERIMENT
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study


def remake(reference: Path, overrides: Sequence[str], budget: Budget, console: Console) -> Path:
    """Run the study of a reference folder with ``path=value`` overrides, and return the run's folder.

    Products of other code are made again.

    Raise InputError if the experiment is a sweep, or as the run raises it.
    """
    study = load_study(reference / EXPERIMENT, None, overrides)
    if not study.has_reference:
        raise InputError(f"{reference}: is a {study.key}, which has no reference results")
    return run_study(study, budget, console, strict=True).folder
