"""Evaluate the statements of papers on the folder of a finished run, or of a finished collection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calstudy.base.errors import InputError
from calstudy.base.plugins import without_code_of_files
from calstudy.claims.evaluation import (
    Evaluation,
    evaluate_by_solver,
    evaluate_members,
    evaluate_run,
    evaluate_run_times,
    members_by_role,
)
from calstudy.claims.paper import Paper
from calstudy.claims.realizations import PooledResults
from calstudy.claims.run_times import RunTimes
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import PAPERS
from calstudy.results.folder import RunFolder
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import write_claims, write_claims_by_solver

INSTEAD = "name a paper by --paper, or use --run-code if you trust who wrote the folder"


@dataclass(frozen=True)
class EvaluatedRun:
    """The claims of one run folder, its name, and a sentence for each paper in which it plays no role."""

    title: str
    claims: list[Verdict]
    without_role: tuple[str, ...] = ()


def evaluate_folder(folder: Path, papers: Sequence[str] = (), run_code: bool = True) -> EvaluatedRun:
    """Evaluate statements of papers on the tables of a run folder, and write claims.json and claims.md into it.

    If members of a collection differ only in the paper's own solver, claims-by-solver.json and .md are written too.

    Parameters
    ----------
    folder
        Of a run (``experiment.yaml``, ``tables/``), or of a collection, whose members' folders are beside it.
    papers
        Names of papers, or files, in place of those that the run names.
    run_code
        Whether Python files in the folder's experiments may be run; those of `papers` always are.

    Raises
    ------
    InputError
        If it is neither, names no paper or code that may not be run, or cannot be written.
    """
    run = RunFolder(folder)
    if run.parts and not run.members:
        part = next(iter(run.parts.values())).path
        raise InputError(f"{folder}: is the folder of several runs; give that of one of them, such as {part}")
    named = [_paper(name) for name in papers]
    with nullcontext() if run_code else without_code_of_files(INSTEAD):
        found, by_solver = _evaluated(run, named)
    evaluated = EvaluatedRun(run.name, found.verdicts, found.without_role)
    try:
        write_claims(found.verdicts, folder, evaluated.title, run.manifest["stand_ins"], found.without_role)
        if by_solver:
            write_claims_by_solver(by_solver, folder, evaluated.title, run.manifest["stand_ins"])
    except OSError as error:
        raise InputError(f"{folder}: the claims cannot be written ({error.strerror})") from None
    return evaluated


def _evaluated(run: RunFolder, named: Sequence[Paper]) -> tuple[Evaluation, Mapping[str, list[Verdict]]]:
    """Return the verdicts of a folder, and those by solver of a collection."""
    if run.manifest.get("kind") == "runtime":
        times = RunTimes.of(run.name, run.tables)
        return evaluate_run_times(_named(named, run.content.get("papers", ()), run.path), times), {}
    if "members" in run.manifest:
        held_to, runs = _played(run, named)
        return evaluate_members(held_to, runs), evaluate_by_solver(held_to, runs)
    results = _results(run, named)
    return evaluate_run(_named(named, results.experiment.papers, run.path), results), {}


def _played(run: RunFolder, named: Sequence[Paper]) -> tuple[list[Paper], dict[str, Results | PooledResults]]:
    """Return the papers of a collection, and its members by the role that they play."""
    members = {name: _results(member, named) for name, member in run.members.items()}
    own = {paper.reference: paper for member in members.values() for paper in member.experiment.papers}
    chosen = _named(named, list(own.values()), run.path)
    experiments = {name: member.experiment for name, member in members.items()}
    roles = members_by_role(chosen, experiments, run.manifest["roles"])
    return chosen, {role: members[name] for role, name in roles.items()}


def _paper(block: Any) -> Paper:
    try:
        return PAPERS.make(block)
    except ValidationError as error:
        found = "; ".join(sentences(error, PAPERS.base, block))
        raise InputError(f"paper {block!r}: {found}") from None


def _named(named: Sequence[Paper], own: Sequence[Any], folder: Path) -> list[Paper]:
    papers = list(named) or [_paper(paper) for paper in own]
    if not papers:
        names = ", ".join(PAPERS.names())
        raise InputError(f"{folder}: its experiment names no papers; give one with --paper ({names}, or a file.py)")
    return papers


def _results(run: RunFolder, named: Sequence[Paper]) -> Results | PooledResults:
    experiment = run.experiment(without=("papers",) if named else ())
    if experiment.realizations:
        return PooledResults.of(experiment, run.figures)
    return Results(run.tables.folders, experiment)
