"""Evaluate the statements of papers on the folder of a finished run, or of a finished collection."""

from __future__ import annotations

import json
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
from calstudy.claims.results import RunResults
from calstudy.claims.run_times import RunTimes
from calstudy.experiment.files import validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import PAPERS
from calstudy.experiment.yaml_files import read_mapping
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import write_claims, write_claims_by_solver

MANIFEST, EXPERIMENT = "manifest.json", "experiment.yaml"
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
    manifest = _manifest(folder)
    if "points" in manifest:
        raise InputError(f"{folder}: is the folder of a sweep; give that of one of its points, below {folder}/points")
    named = [_paper(name) for name in papers]
    with nullcontext() if run_code else without_code_of_files(INSTEAD):
        found, by_solver = _evaluated(folder, manifest, named)
    evaluated = EvaluatedRun(manifest["name"], found.verdicts, found.without_role)
    try:
        write_claims(found.verdicts, folder, evaluated.title, manifest["stand_ins"], found.without_role)
        if by_solver:
            write_claims_by_solver(by_solver, folder, evaluated.title, manifest["stand_ins"])
    except OSError as error:
        raise InputError(f"{folder}: the claims cannot be written ({error.strerror})") from None
    return evaluated


def _evaluated(
    folder: Path, manifest: Mapping[str, Any], named: Sequence[Paper]
) -> tuple[Evaluation, Mapping[str, list[Verdict]]]:
    """Return the verdicts of a folder, and those by solver of a collection."""
    if manifest.get("kind") == "runtime":
        study = read_mapping(folder / EXPERIMENT)
        times = RunTimes.of(manifest["name"], _tables(folder))
        return evaluate_run_times(_named(named, study.get("papers", ()), folder), times), {}
    if "members" in manifest:
        held_to, runs = _played(folder, manifest, named)
        return evaluate_members(held_to, runs), evaluate_by_solver(held_to, runs)
    run = _results(folder, named)
    return evaluate_run(_named(named, run.experiment.papers, folder), run), {}


def _played(
    folder: Path, manifest: Mapping[str, Any], named: Sequence[Paper]
) -> tuple[list[Paper], dict[str, RunResults | PooledResults]]:
    """Return the papers of a collection, and its members by the role that they play."""
    members = {name: _results(folder.resolve().parent / place, named) for name, place in manifest["members"].items()}
    own = {paper.reference: paper for run in members.values() for paper in run.experiment.papers}
    chosen = _named(named, list(own.values()), folder)
    experiments = {name: run.experiment for name, run in members.items()}
    roles = members_by_role(chosen, experiments, manifest["roles"])
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


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(
            f"{folder}: is not the folder of a finished run (it has no readable manifest.json); give one that "
            "'calstudy run' printed"
        ) from None


def _tables(folder: Path) -> Path:
    if not (folder / "tables").is_dir():
        raise InputError(f"{folder}: has no tables; run the experiment again")
    return folder / "tables"


def _results(folder: Path, named: Sequence[Paper]) -> RunResults | PooledResults:
    content = dict(read_mapping(folder / EXPERIMENT))
    if named:
        content.pop("papers", None)
    experiment = validate(content, folder)
    if experiment.realizations:
        figures = folder / "figures"
        return PooledResults.of(experiment, figures if figures.is_dir() else folder)
    return RunResults(experiment, (_tables(folder),))
