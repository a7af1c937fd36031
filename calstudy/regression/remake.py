"""Make the results of a reference again, from cached or fresh products."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from calstudy.errors import InputError
from calstudy.experiment.collection import Collection, load_study
from calstudy.experiment.runtime import RuntimeStudy
from calstudy.experiment.sweep import Sweep
from calstudy.regression.reference import EXPERIMENT
from calstudy.running.collection_runs import run_collection
from calstudy.running.runs import run
from calstudy.running.runtime_runs import fit_runtime, run_runtime
from calstudy.running.studies import fit_study


def remake(
    reference: Path,
    overrides: Sequence[str],
    workers: int | None,
    max_memory: str | None,
    scheduler: str | None,
    console: Console,
) -> Path:
    """Run the experiment or collection of a reference folder, and return the run's folder.

    Parameters
    ----------
    reference
        Folder with ``experiment.yaml``.
    overrides
        ``path=value`` texts, such as ``outputs.store=DIR``.
    workers, max_memory, scheduler, console
        As for `calstudy.running.studies.run_study`.

    Raises
    ------
    InputError
        If the experiment is a sweep, or as the run raises it.
    """
    loaded = load_study(reference / EXPERIMENT, None, overrides)
    if isinstance(loaded, RuntimeStudy):
        fit_runtime(loaded, workers, max_memory, scheduler)
        return run_runtime(loaded, console).folder
    study, count = fit_study(loaded, workers, max_memory, scheduler)
    if isinstance(study, Collection):
        return run_collection(study, count, scheduler, console).folder
    if isinstance(study, Sweep):
        raise InputError(f"{reference}: is a sweep, which has no reference results")
    return run(study, count, scheduler, console).folder
