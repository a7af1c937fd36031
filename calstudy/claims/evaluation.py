"""Evaluation of the statements of papers: on runs, on the folders of finished ones, and as a product of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.plugins import guarded, refusal_of
from calstudy.base.resources import Cost
from calstudy.base.user_code import without_code_of_files
from calstudy.calibrate.settings import GainFit
from calstudy.claims.paper import Paper
from calstudy.claims.realizations import PooledResults
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import PAPERS, Experiment
from calstudy.products.run_times import RUN_TIME, RUNTIME, RunTimeTable
from calstudy.results.reader import Results, RunFolder, Tables
from calstudy.run.task import Input, Inputs, Task
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.statement import Statement
from calstudy.verdicts.tables import (
    BY_SOLVER_JSON,
    BY_SOLVER_MARKDOWN,
    CLAIMS_MARKDOWN,
    tally,
    write_claims,
    write_claims_by_solver,
)


@dataclass(frozen=True)
class Evaluation:
    """Verdicts on the statements of papers, one for each statement, and those `by_solver` (`evaluate_by_solver`).

    `without_role` has a sentence, with the reasons, for each paper in which a run plays no role, and which therefore
    has no verdicts, and for each member of a collection whose results do not suit its role.
    """

    verdicts: list[Verdict]
    without_role: tuple[str, ...] = ()
    by_solver: Mapping[str, list[Verdict]] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether no statement was evaluated."""
        return all(verdict.measured is None for verdict in self.verdicts)


def evaluate_run(papers: Sequence[Paper], results: Results | PooledResults | RunTimeTable) -> Evaluation:
    """Evaluate the statements of papers on the roles that one run plays."""
    verdicts: dict[str, list[Verdict]] = {}
    without_role = []
    for paper in papers:
        refusals = refusals_of_run(paper, results)
        played = [role for role, refusal in refusals.items() if refusal is None]
        if played:
            verdicts[paper.label] = _evaluate(paper, dict.fromkeys(played, results), only_played=True)
        else:
            without_role.append(_told(paper, refusals))
    return Evaluation(_with_names_of_papers(verdicts), tuple(without_role))


def _with_names_of_papers(verdicts: Mapping[str, list[Verdict]]) -> list[Verdict]:
    """Return the verdicts of all papers, by label; if there are several, sections are named with their paper."""
    several = sum(map(bool, verdicts.values())) > 1
    return [
        replace(verdict, section=f"{label}: {verdict.section}") if several else verdict
        for label, found in verdicts.items()
        for verdict in found
    ]


def refusals_of_run(paper: Paper, results: Results | PooledResults | RunTimeTable) -> dict[str, str | None]:
    """Return the reason why a run cannot play each role of a paper, None for the roles that it plays."""
    if isinstance(results, RunTimeTable):
        return {RUN_TIME: None} if RUN_TIME in paper.roles else {}
    return _refusals(paper, dict.fromkeys(paper.roles, results))


def _refusals(paper: Paper, runs: Mapping[str, Results | PooledResults]) -> dict[str, str | None]:
    """Return why runs cannot play their roles, None for those that can; another paper may have roles of these names."""
    with guarded(paper):
        return {role: paper.refusal_of_run(role, run) for role, run in runs.items() if role in paper.roles}


def _told(paper: Paper, refusals: Mapping[str, str | None]) -> str:
    roles: dict[str, list[str]] = {}
    for role, refusal in refusals.items():
        roles.setdefault(str(refusal), []).append(role)
    reasons = "; ".join(f"{refusal} ({', '.join(names)})" for refusal, names in roles.items())
    return f"The run plays no role in {paper.label}: {reasons or 'the paper has none for it'}."


def evaluate_members(papers: Sequence[Paper], runs: Mapping[str, Results | PooledResults]) -> Evaluation:
    """Evaluate every statement of papers on the runs by role; those on single runs not if all pool realizations."""
    pooled = bool(runs) and all(isinstance(run, PooledResults) for run in runs.values())
    verdicts = {paper.label: _evaluate(paper, _accepted(paper, runs), pooled) for paper in papers}
    refused = [reason for paper in papers for reason in _refused(paper, runs)]
    return Evaluation(_with_names_of_papers(verdicts), tuple(refused), evaluate_by_solver(papers, runs))


def evaluate_by_solver(
    papers: Sequence[Paper], runs: Mapping[str, Results | PooledResults]
) -> dict[str, list[Verdict]]:
    """Evaluate every statement of papers on the runs (by role) with the paper's own solver, and on those with another.

    Papers in which no run plays both roles of a pair in `Paper.own_solver_roles` are left out. The result has
    verdicts by solver, on the same statements in the same order; it is empty without any.
    """
    own: list[Verdict] = []
    other: list[Verdict] = []
    names: dict[str, None] = {}
    for paper in papers:
        played = _accepted(paper, runs)
        with_other = {role: played[role] for role in paper.own_solver_roles if role in played}
        both = {role: played[of_own] for role, of_own in paper.own_solver_roles.items() if of_own in played}
        if with_other.keys() & both.keys():
            with_own = both | {paper.own_solver_roles[role]: run for role, run in both.items()}
            own += _evaluate(paper, with_own)
            other += _evaluate(paper, with_other)
            names |= dict.fromkeys(_solver(run) for run in with_other.values())
    return {"the paper's solver": own, ", ".join(names): other} if own else {}


def _solver(run: Results | PooledResults) -> str:
    calibration = run.experiment.calibration
    return calibration.solver.name if isinstance(calibration, GainFit) else calibration.label


def _accepted(paper: Paper, runs: Mapping[str, Results | PooledResults]) -> dict[str, Results | PooledResults]:
    return {role: runs[role] for role, refusal in _refusals(paper, runs).items() if refusal is None}


def _refused(paper: Paper, runs: Mapping[str, Results | PooledResults]) -> list[str]:
    """Explain why the results of runs do not suit their roles, where the settings do."""
    with guarded(paper):
        return [
            f"{runs[role].name} does not play the role {role} of {paper.label}: {refusal}."
            for role, refusal in _refusals(paper, runs).items()
            if refusal is not None and paper.refusal(role, runs[role].experiment) is None
        ]


def _evaluate(
    paper: Paper, runs: Mapping[str, Results | PooledResults | RunTimeTable], only_played: bool = False
) -> list[Verdict]:
    """Evaluate the statements of a paper; with `only_played`, only those with a role that a run plays."""
    found = []
    with guarded(paper):
        for statement in paper.statements():
            measured, usable = _measured_on(statement, runs)
            if not only_played or any(role in usable for role in statement.roles):
                found.append(measured.evaluate(usable, paper.roles))
    return found


def _measured_on(statement: Statement, runs: Mapping[str, Any]) -> tuple[Statement, dict[str, Any]]:
    """Return a statement, with its measure on realizations if these play its roles, and the runs for its measure."""
    played = [runs[role] for role in statement.roles if role in runs]
    if statement.pooled and played and all(isinstance(run, PooledResults) for run in played):
        quantity = f"{statement.quantity}; mean over realizations"
        return replace(statement, measure=statement.pooled, quantity=quantity), dict(runs)
    return statement, {role: run for role, run in runs.items() if not isinstance(run, PooledResults)}


def members_by_role(
    papers: Sequence[Paper], members: Mapping[str, Experiment], named: Mapping[str, str]
) -> dict[str, str]:
    """Return the members of a collection by the role that they play in any of the papers.

    The usual members are those of the first paper that has a role; `named` has members by role in place of the usual
    ones. Members that a paper refuses are left out.
    """
    usual = {role: name for paper in reversed(papers) for role, name in paper.usual_members.items() if name in members}
    return {
        role: name
        for role, name in (usual | dict(named)).items()
        if any(role in paper.roles for paper in papers) and refusal_of_role(papers, role, members[name]) is None
    }


def refusal_of_role(papers: Sequence[Paper], role: str, experiment: Experiment) -> str | None:
    """Return why an experiment cannot play a role in any of the papers that have it, or None if it can in one."""
    found = [refusal_of(paper, role, experiment) for paper in papers if role in paper.roles]
    return None if None in found else next(iter(found), None)


INSTEAD = "use --run-code if you trust who wrote the folder, or, if it is a paper, name one by --paper"


def evaluate_folder(folder: Path, papers: Sequence[str] = (), run_code: bool = True) -> Evaluation:
    """Evaluate statements of papers on the tables of a run folder, and write claims.json and claims.md into it.

    The folder is that of a run, or of a collection, whose members' folders are beside it. If members differ only in the
    paper's own solver, claims-by-solver.json and .md are written too. If no statement is evaluated, nothing is written.
    `papers` are names or files in place of those that the run names. Python files of these are always run, those of the
    folder's experiments only with `run_code`.
    Raises InputError for another folder, if it names no paper or code that may not be run, or cannot be written.
    """
    run = RunFolder(folder)
    _require_evaluable(run)
    named = [_paper(name) for name in papers]
    with nullcontext() if run_code else without_code_of_files(INSTEAD):
        found = _evaluated(run, named)
    if found.is_empty:
        return found
    with errors_of_files(f"{folder}: the claims cannot be written"):
        # Those of an earlier evaluation, of other members or papers.
        for name in (BY_SOLVER_JSON, BY_SOLVER_MARKDOWN):
            (folder / name).unlink(missing_ok=True)
        _write(folder, found, run.name, run.manifest["stand_ins"])
    return found


def _require_evaluable(run: RunFolder) -> None:
    """Raise InputError for the folder of a comparison or sweep, and for a collection without its members' folders."""
    if not run.members and (run.parts or "cases" in run.manifest):
        such = f", such as {next(iter(run.parts.values())).path}" if run.parts else ", or of a collection"
        raise InputError(f"{run.path}: is the folder of several runs; give that of one of them{such}")
    if lacking := [str(member.path) for member in run.members.values() if not member.path.is_dir()]:
        written = f"; its written verdicts are in {run.path / CLAIMS_MARKDOWN}" if run.has_claims else ""
        raise InputError(
            f"{run.path}: the folders of its members are not beside it ({', '.join(lacking)}); run it again{written}"
        )


def _evaluated(run: RunFolder, named: Sequence[Paper]) -> Evaluation:
    if "members" in run.manifest:
        return evaluate_members(*_played(run, named))
    if run.manifest.get("kind") == "runtime":
        return evaluate_run(_named(named, run.content.get("papers", ()), run.path), _run_times(run.name, run.tables))
    results = _results(run, named)
    return evaluate_run(_named(named, results.experiment.papers, run.path), results)


def _played(run: RunFolder, named: Sequence[Paper]) -> tuple[list[Paper], dict[str, Results | PooledResults]]:
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
    return Results(run.tables.folders, experiment, lost=run.tables.lost)


REALIZATIONS = "realizations"
"""Figure with the measurements on all realizations of an experiment."""
TABLES = ("spectra", "agreement", "transfer", "score", "sky_model")


def _facts(experiment: Experiment) -> Experiment:
    """Return the experiment without settings that no statement reads, to keep them out of the key of the claims."""
    return experiment.with_defaults("description", "sweep", "scales", "outputs")


class Evaluated(NamedTuple):
    """A run as statements see it: its experiment, and its products by those of `TABLES`, or `REALIZATIONS` alone."""

    experiment: Experiment
    tables: Mapping[str, Task]


def claims(
    title: str,
    papers: Sequence[Any],
    runs: Mapping[str, Evaluated],
    notes: Sequence[str],
    roles: Mapping[str, str] | None = None,
) -> Task | None:
    """Return the task that evaluates the statements of papers on a run, or on several by role; None without papers.

    A single run has no name. The notes are the substitutions of all runs for the papers' ingredients.
    """
    if not papers:
        return None
    playing = runs if roles is None else {name: runs[name] for name in roles.values()}
    return Claims(
        "claims" if roles is None else "claims of all",
        papers=list(papers),
        title=title,
        notes=list(notes),
        roles=None if roles is None else dict(roles),
        experiments={name: _facts(run.experiment) for name, run in playing.items()},
        tables={f"{table}:{name}": task for name, run in playing.items() for table, task in run.tables.items()},
    )


class Claims(Task, stage="claims", version=16, cost=Cost(1, disk=1e5)):
    """The statements of papers, evaluated on one run, or on the members of a collection in the roles that they play."""

    papers: Sequence[Any]
    title: str
    notes: Sequence[str]
    roles: Mapping[str, str] | None = None
    experiments: Mapping[str, Experiment]
    tables: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the claims, and those by solver."""
        results = {name: self._results(name, experiment) for name, experiment in self.experiments.items()}
        if self.roles is None:
            return _write(output, evaluate_run(self.papers, results[""]), self.title, self.notes)
        runs = {role: results[name] for role, name in self.roles.items()}
        return _write(output, evaluate_members(self.papers, runs), self.title, self.notes)

    def _results(self, name: str, experiment: Experiment) -> Results | PooledResults:
        if experiment.realizations:
            return PooledResults.of(experiment, self.tables[f"{REALIZATIONS}:{name}"])
        tables = (self.tables.get(f"{table}:{name}") for table in TABLES)
        return Results(tuple(folder for folder in tables if folder is not None), experiment)


def _run_times(name: str, tables: Tables) -> RunTimeTable:
    return RunTimeTable.read(name, tables.path(RUNTIME, "the run has no table of run times"))


class RunTimeClaims(Task, stage="runtime-claims", version=5, cost=Cost(1, disk=1e5)):
    """The statements of papers, evaluated on a run-time study."""

    papers: Sequence[Paper]
    title: str
    runtime: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write claims.json and claims.md."""
        times = _run_times(self.title, Tables((self.runtime,)))
        return _write(output, evaluate_run(self.papers, times), self.title)


def _write(output: Path, found: Evaluation, title: str, notes: Sequence[str] = ()) -> dict[str, Any]:
    write_claims(found.verdicts, output, title, notes, found.without_role)
    if found.by_solver:
        write_claims_by_solver(found.by_solver, output, title, notes)
    contradicted = [claim.name for claim in found.verdicts if claim.verdict == "contradicted"]
    return {"verdicts": tally(found.verdicts), "contradicted": contradicted, "without_role": list(found.without_role)}
