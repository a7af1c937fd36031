"""Plan and run what a file holds: one experiment, the family that its sweep makes, or a collection of several."""

from __future__ import annotations

import dataclasses

from rich.console import Console

from calstudy.experiment.collection import Collection
from calstudy.experiment.model import Experiment
from calstudy.experiment.runtime import RuntimeStudy
from calstudy.experiment.sweep import Sweep, expand
from calstudy.graph.collections import CollectionGraph
from calstudy.graph.runtimes import RuntimeGraph
from calstudy.graph.sweeps import SweepGraph
from calstudy.graph.tasks import Graph
from calstudy.running.capacity import fit
from calstudy.running.collection_runs import collection_folder, run_collection
from calstudy.running.plans import show_claims, show_collection_result, show_plan, show_result
from calstudy.running.preflight import require_basis_fits
from calstudy.running.runs import run, run_folder
from calstudy.running.runtime_runs import fit_runtime, run_runtime, runtime_folder, timed_machine
from calstudy.running.sweep_runs import run_sweep

Study = Experiment | Collection | Sweep


def fit_study(
    study: Study, workers: int | None, max_memory: str | None, scheduler: str | None = None
) -> tuple[Study, int]:
    """Fit an experiment, or all of a collection or sweep, to the machine, as `calstudy.running.capacity.fit` does.

    An experiment with a sweep becomes the family of its points.
    """
    if isinstance(study, Experiment) and study.sweep:
        study = expand(study)
    if isinstance(study, Sweep):
        fits = [[fit(point.experiment, workers, max_memory, scheduler) for point in block] for block in study.blocks]
        blocks = tuple(
            tuple(
                dataclasses.replace(point, experiment=experiment)
                for point, (experiment, _) in zip(block, fitted, strict=True)
            )
            for block, fitted in zip(study.blocks, fits, strict=True)
        )
        return dataclasses.replace(study, blocks=blocks), min(count for fitted in fits for _, count in fitted)
    if not isinstance(study, Collection):
        return fit(study, workers, max_memory, scheduler)
    fitted = {name: fit(experiment, workers, max_memory, scheduler) for name, experiment in study.members.items()}
    members = {name: experiment for name, (experiment, _) in fitted.items()}
    return dataclasses.replace(study, members=members), min(count for _, count in fitted.values())


def _experiments(study: Study) -> list[Experiment]:
    if isinstance(study, Collection):
        return list(study.members.values())
    if isinstance(study, Sweep):
        return [point.experiment for block in study.blocks for point in block]
    return [study]


def plan_study(study: Study | RuntimeStudy, workers: int | None, max_memory: str | None, console: Console) -> None:
    """Print what a run would do.

    Parameters
    ----------
    study
        An experiment, with a sweep or without, a collection, or a run-time study.
    workers, max_memory
        As for `calstudy.running.capacity.fit`.
    console
        Where it is written.
    """
    if isinstance(study, RuntimeStudy):
        fit_runtime(study, workers, max_memory, None)
        show_plan(study, RuntimeGraph(study, timed_machine(study)), [runtime_folder(study)], 1, console)
        return
    study, count = fit_study(study, workers, max_memory)
    for experiment in _experiments(study):
        require_basis_fits(experiment)
    if isinstance(study, Collection):
        folders = [run_folder(experiment) for experiment in study.members.values()] + [collection_folder(study)]
        show_plan(study, CollectionGraph(study), folders, count, console)
    elif isinstance(study, Sweep):
        show_plan(study.base, SweepGraph(study), [run_folder(study.base)], count, console)
    else:
        show_plan(study, Graph(study), [run_folder(study)], count, console)


def run_study(
    study: Study | RuntimeStudy, workers: int | None, max_memory: str | None, scheduler: str | None, console: Console
) -> None:
    """Run an experiment or a collection, and print what was made and which claims hold; parameters as above.

    Parameters
    ----------
    study
        An experiment, with a sweep or without, a collection, or a run-time study.
    workers, max_memory
        As for `calstudy.running.capacity.fit`.
    scheduler, console
        As for `calstudy.running.runs.run`.
    """
    if isinstance(study, RuntimeStudy):
        fit_runtime(study, workers, max_memory, scheduler)
        timed = run_runtime(study, console)
        show_result(timed, console)
        show_claims(timed.folder, console)
        return
    study, count = fit_study(study, workers, max_memory, scheduler)
    for experiment in _experiments(study):
        require_basis_fits(experiment)
    if isinstance(study, Collection):
        collected = run_collection(study, count, scheduler, console)
        show_collection_result(collected, console)
        show_claims(collected.folder, console)
    elif isinstance(study, Sweep):
        show_result(run_sweep(study, count, scheduler, console).whole, console)
    else:
        result = run(study, count, scheduler, console)
        show_result(result, console)
        show_claims(result.folder, console)
