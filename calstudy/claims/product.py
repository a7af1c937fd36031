"""The claims of a run or a collection: the statements of papers, evaluated on tables of products."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.claims.paper import Paper, stand_ins
from calstudy.experiment.model import FIGURES, Experiment
from calstudy.figures import figure_task
from calstudy.products import agreement, score, signal_loss, sky_model, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from calstudy.claims.evaluation import Evaluation
    from calstudy.claims.realizations import PooledResults
    from calstudy.results.reader import Results

REALIZATIONS = "realizations"
"""Figure with the measurements on all realizations of an experiment."""
TABLES = ("spectra", "agreement", "transfer", "score", "sky_model")


def _facts(experiment: Experiment) -> Experiment:
    """Return the experiment without settings that no statement reads, to keep them out of the key of the claims."""
    return experiment.reset("description", "sweep", "scales", "outputs")


def _inputs(graph: Graph) -> dict[str, Task]:
    if graph.experiment.realizations:
        return {REALIZATIONS: figure_task(FIGURES.make(REALIZATIONS), {"": graph}, stand_ins(graph.experiment))}
    inputs = {
        "spectra": spectra.spectra(graph),
        "agreement": agreement.agreement(graph),
        "transfer": signal_loss.transfer(graph),
        "score": score.score(graph),
        "sky_model": sky_model.error(graph),
    }
    return {name: task for name, task in inputs.items() if task is not None}


def claims(graph: Graph, notes: Sequence[str]) -> Task | None:
    """Return the task that evaluates the statements of an experiment's papers on it alone; None without papers.

    The notes are its substitutions for the papers' ingredients.
    """
    experiment = graph.experiment
    if not experiment.papers:
        return None
    settings = {"papers": list(experiment.papers), "title": experiment.name, "notes": list(notes)}
    return Task(EVALUATE, "claims", {**settings, "experiments": {"": _facts(experiment)}}, _inputs_of({"": graph}))


def combined_claims(
    title: str, graphs: Mapping[str, Graph], papers: Sequence[Paper], roles: Mapping[str, str], notes: Sequence[str]
) -> Task | None:
    """Return the task that evaluates the statements of papers on several runs by role; None without papers.

    The notes are the substitutions of all members for the papers' ingredients.
    """
    playing = {name: graphs[name] for name in roles.values()}
    if not papers:
        return None
    settings = {
        "papers": list(papers),
        "title": title,
        "notes": list(notes),
        "roles": dict(roles),
        "experiments": {name: _facts(graph.experiment) for name, graph in playing.items()},
    }
    return Task(EVALUATE, "claims of all", settings, _inputs_of(playing))


def _inputs_of(graphs: Mapping[str, Graph]) -> dict[str, Task]:
    return {f"{table}:{name}": task for name, graph in graphs.items() for table, task in _inputs(graph).items()}


def run_time_claims(title: str, papers: Sequence[Paper], run_times: Task) -> Task | None:
    """Return the task that evaluates the statements of papers on a table of run times; None without papers."""
    if not papers:
        return None
    return Task(EVALUATE_RUN_TIMES, "claims", {"papers": list(papers), "title": title}, {"runtime": run_times})


def evaluate(job: Job) -> Mapping[str, Any]:
    """Write the claims of one run, or of the members of a collection in the roles that they play."""
    from calstudy.claims.evaluation import evaluate_by_solver, evaluate_members, evaluate_run
    from calstudy.verdicts.tables import write_claims_by_solver

    results = {name: _results(job, name, experiment) for name, experiment in job.settings["experiments"].items()}
    papers = job.settings["papers"]
    if "roles" not in job.settings:
        return _write(job, evaluate_run(papers, results[""]))
    runs = {role: results[name] for role, name in job.settings["roles"].items()}
    if by_solver := evaluate_by_solver(papers, runs):
        write_claims_by_solver(by_solver, job.output, job.settings["title"], job.settings["notes"])
    return _write(job, evaluate_members(papers, runs))


def _results(job: Job, name: str, experiment: Experiment) -> Results | PooledResults:
    from calstudy.claims.realizations import PooledResults
    from calstudy.results.reader import Results

    if experiment.realizations:
        return PooledResults.of(experiment, job.inputs[f"{REALIZATIONS}:{name}"])
    tables = (job.inputs.get(f"{table}:{name}") for table in TABLES)
    return Results(tuple(folder for folder in tables if folder is not None), experiment)


def evaluate_run_times(job: Job) -> Mapping[str, Any]:
    """Write claims.json and claims.md of a run-time study."""
    from calstudy.claims import evaluation
    from calstudy.claims.run_times import RunTimes
    from calstudy.results.reader import Tables

    times = RunTimes.of(job.settings["title"], Tables((job.inputs["runtime"],)))
    return _write(job, evaluation.evaluate_run_times(job.settings["papers"], times))


def _write(job: Job, found: Evaluation) -> dict[str, Any]:
    from calstudy.verdicts.tables import tally, write_claims

    write_claims(found.verdicts, job.output, job.settings["title"], job.settings.get("notes", ()), found.without_role)
    contradicted = [claim.name for claim in found.verdicts if claim.verdict == "contradicted"]
    return {"verdicts": tally(found.verdicts), "contradicted": contradicted, "without_role": list(found.without_role)}


EVALUATE = Stage(name="claims", version=12, make=evaluate, cost=lambda task: Cost(1, disk=1e5))
EVALUATE_RUN_TIMES = Stage(
    name="runtime-claims", version=4, make=evaluate_run_times, cost=lambda task: Cost(1, disk=1e5)
)
