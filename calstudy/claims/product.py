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
from calstudy.results.reader import Results, Tables
from calstudy.run.task import Input, Inputs, Task
from calstudy.verdicts.tables import tally, write_claims, write_claims_by_solver

if TYPE_CHECKING:
    from pathlib import Path

    from calstudy.claims.evaluation import Evaluation
    from calstudy.claims.realizations import PooledResults

REALIZATIONS = "realizations"
"""Figure with the measurements on all realizations of an experiment."""
TABLES = ("spectra", "agreement", "transfer", "score", "sky_model")


def _facts(experiment: Experiment) -> Experiment:
    """Return the experiment without settings that no statement reads, to keep them out of the key of the claims."""
    return experiment.with_defaults("description", "sweep", "scales", "outputs")


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
    return Claims(
        "claims",
        papers=list(experiment.papers),
        title=experiment.name,
        notes=list(notes),
        experiments={"": _facts(experiment)},
        tables=_inputs_of({"": graph}),
    )


def combined_claims(
    title: str, graphs: Mapping[str, Graph], papers: Sequence[Paper], roles: Mapping[str, str], notes: Sequence[str]
) -> Task | None:
    """Return the task that evaluates the statements of papers on several runs by role; None without papers.

    The notes are the substitutions of all members for the papers' ingredients.
    """
    playing = {name: graphs[name] for name in roles.values()}
    if not papers:
        return None
    return Claims(
        "claims of all",
        papers=list(papers),
        title=title,
        notes=list(notes),
        roles=dict(roles),
        experiments={name: _facts(graph.experiment) for name, graph in playing.items()},
        tables=_inputs_of(playing),
    )


def _inputs_of(graphs: Mapping[str, Graph]) -> dict[str, Task]:
    return {f"{table}:{name}": task for name, graph in graphs.items() for table, task in _inputs(graph).items()}


def run_time_claims(title: str, papers: Sequence[Paper], run_times: Task) -> Task | None:
    """Return the task that evaluates the statements of papers on a table of run times; None without papers."""
    return RunTimeClaims("claims", papers=list(papers), title=title, runtime=run_times) if papers else None


class Claims(Task, stage="claims", version=12, cost=Cost(1, disk=1e5)):
    """The statements of papers, evaluated on one run, or on the members of a collection in the roles that they play."""

    papers: Sequence[Any]
    title: str
    notes: Sequence[str]
    roles: Mapping[str, str] | None = None
    experiments: Mapping[str, Experiment]
    tables: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the claims, and those by solver."""
        from calstudy.claims.evaluation import evaluate_by_solver, evaluate_members, evaluate_run

        results = {name: self._results(name, experiment) for name, experiment in self.experiments.items()}
        if self.roles is None:
            return _write(output, evaluate_run(self.papers, results[""]), self.title, self.notes)
        runs = {role: results[name] for role, name in self.roles.items()}
        if by_solver := evaluate_by_solver(self.papers, runs):
            write_claims_by_solver(by_solver, output, self.title, self.notes)
        return _write(output, evaluate_members(self.papers, runs), self.title, self.notes)

    def _results(self, name: str, experiment: Experiment) -> Results | PooledResults:
        from calstudy.claims.realizations import PooledResults

        if experiment.realizations:
            return PooledResults.of(experiment, self.tables[f"{REALIZATIONS}:{name}"])
        tables = (self.tables.get(f"{table}:{name}") for table in TABLES)
        return Results(tuple(folder for folder in tables if folder is not None), experiment)


class RunTimeClaims(Task, stage="runtime-claims", version=4, cost=Cost(1, disk=1e5)):
    """The statements of papers, evaluated on a run-time study."""

    papers: Sequence[Paper]
    title: str
    runtime: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write claims.json and claims.md."""
        from calstudy.claims import evaluation
        from calstudy.claims.run_times import RunTimes

        times = RunTimes.of(self.title, Tables((self.runtime,)))
        return _write(output, evaluation.evaluate_run_times(self.papers, times), self.title)


def _write(output: Path, found: Evaluation, title: str, notes: Sequence[str] = ()) -> dict[str, Any]:

    write_claims(found.verdicts, output, title, notes, found.without_role)
    contradicted = [claim.name for claim in found.verdicts if claim.verdict == "contradicted"]
    return {"verdicts": tally(found.verdicts), "contradicted": contradicted, "without_role": list(found.without_role)}
