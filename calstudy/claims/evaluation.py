"""Evaluation of the statements of papers on runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from calstudy.base.plugins import guarded
from calstudy.calibrate.settings import GainFit
from calstudy.claims.paper import Paper
from calstudy.claims.realizations import PooledResults
from calstudy.claims.run_times import RUN_TIME, RunTimes
from calstudy.experiment.model import Experiment
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.statement import Statement

if TYPE_CHECKING:
    from calstudy.results.reader import Results


@dataclass(frozen=True)
class Evaluation:
    """Verdicts on the statements of papers, one for each statement.

    `without_role` has a sentence, with the reasons, for each paper in which a run plays no role, and which therefore
    has no verdicts.
    """

    verdicts: list[Verdict]
    without_role: tuple[str, ...] = ()


def evaluate_run(papers: Sequence[Paper], results: Results | PooledResults) -> Evaluation:
    """Evaluate the statements of papers on the roles that one run plays."""
    verdicts: list[Verdict] = []
    without_role = []
    for paper in papers:
        refusals = refusals_of_run(paper, results)
        played = [role for role, refusal in refusals.items() if refusal is None]
        if played:
            verdicts += _evaluate(paper, dict.fromkeys(played, results), only_played=True)
        else:
            without_role.append(_told(paper, refusals))
    return Evaluation(verdicts, tuple(without_role))


def refusals_of_run(paper: Paper, results: Results | PooledResults) -> dict[str, str | None]:
    """Return the reason why a run cannot play each role of a paper, None for the roles that it plays."""
    with guarded(paper):
        return {role: paper.refusal_of_run(role, results) for role in paper.roles}


def _told(paper: Paper, refusals: Mapping[str, str | None]) -> str:
    """Explain in one sentence why a run plays no role, with every reason once."""
    roles: dict[str, list[str]] = {}
    for role, refusal in refusals.items():
        roles.setdefault(str(refusal), []).append(role)
    reasons = "; ".join(f"{refusal} ({', '.join(names)})" for refusal, names in roles.items())
    return f"The run plays no role in {paper.label}: {reasons or 'the paper has none'}."


def evaluate_run_times(papers: Sequence[Paper], run: RunTimes) -> Evaluation:
    """Evaluate the statements of papers on run times."""
    verdicts: list[Verdict] = []
    without_role = []
    for paper in papers:
        if RUN_TIME in paper.roles:
            verdicts += _evaluate(paper, {RUN_TIME: run}, only_played=True)
        else:
            without_role.append(f"The run plays no role in {paper.label}: the paper says nothing on run times.")
    return Evaluation(verdicts, tuple(without_role))


def evaluate_members(papers: Sequence[Paper], runs: Mapping[str, Results | PooledResults]) -> Evaluation:
    """Evaluate every statement of papers on the runs by role.

    A statement whose roles no run plays is not evaluated, with the reason. If all runs pool realizations, statements
    on single runs are left out.
    """
    pooled = bool(runs) and all(isinstance(run, PooledResults) for run in runs.values())
    return Evaluation([verdict for paper in papers for verdict in _evaluate(paper, _accepted(paper, runs), pooled)])


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
        pairs = {role: role_of_own for role, role_of_own in paper.own_solver_roles.items() if role_of_own in played}
        if not any(role in played for role in pairs):
            continue
        with_own = {name: played[pairs[role]] for role in pairs for name in (role, pairs[role])}
        with_other = {role: played[role] for role in paper.own_solver_roles if role in played}
        own += _evaluate(paper, with_own)
        other += _evaluate(paper, with_other)
        names |= dict.fromkeys(_solver(run) for run in with_other.values())
    return {"the paper's solver": own, ", ".join(names): other} if own else {}


def _solver(run: Results | PooledResults) -> str:
    calibration = run.experiment.calibration
    return calibration.solver.name if isinstance(calibration, GainFit) else calibration.label


def _accepted(paper: Paper, runs: Mapping[str, Results | PooledResults]) -> dict[str, Results | PooledResults]:
    """Return the runs whose roles a paper accepts, because another paper may have a role of the same name."""
    with guarded(paper):
        return {
            role: run
            for role, run in runs.items()
            if role in paper.roles and paper.refusal(role, run.experiment) is None
        }


def _evaluate(
    paper: Paper, runs: Mapping[str, Results | PooledResults | RunTimes], only_played: bool = False
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
        return replace(statement, measure=statement.pooled), dict(runs)
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
    found: list[str | None] = []
    for paper in papers:
        if role in paper.roles:
            with guarded(paper):
                found.append(paper.refusal(role, experiment))
    return None if None in found else next(iter(found), None)
