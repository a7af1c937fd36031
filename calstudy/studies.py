"""Plan and run what a file holds: one experiment, or a collection of several."""

from __future__ import annotations

from rich.console import Console

from calstudy.collection_runs import collection_folder, run_collection
from calstudy.collection_tasks import CollectionGraph
from calstudy.experiment.collection import Collection
from calstudy.experiment.model import Experiment
from calstudy.plans import choose_workers, show_claims, show_collection_result, show_plan, show_result
from calstudy.runs import run, run_folder
from calstudy.tasks import Graph

Study = Experiment | Collection


def graph_of(study: Study) -> Graph | CollectionGraph:
    """Return the tasks of an experiment or a collection."""
    return CollectionGraph(study) if isinstance(study, Collection) else Graph(study)


def plan_study(study: Study, workers: int | None, console: Console) -> None:
    """Print what a run would do; `workers` is their number, or None for as many as there is room for."""
    graph = graph_of(study)
    if isinstance(study, Collection):
        folders = {name: run_folder(experiment) for name, experiment in study.members.items()}
        folders[study.name] = collection_folder(study)
    else:
        folders = {study.name: run_folder(study)}
    show_plan(graph, study, folders, choose_workers(graph, workers), console)


def run_study(study: Study, workers: int | None, scheduler: str | None, console: Console) -> None:
    """Run an experiment or a collection, and print what was made and which claims hold."""
    count = choose_workers(graph_of(study), workers)
    if isinstance(study, Collection):
        collected = run_collection(study, count, scheduler, console)
        show_collection_result(collected, console)
        show_claims(collected.folder, console)
    else:
        result = run(study, count, scheduler, console)
        show_result(result, console)
        show_claims(result.folder, console)
