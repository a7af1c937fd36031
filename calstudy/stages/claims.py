"""Stages `claims` and `combined-claims`: the sentences of the paper against the tables of one run, or of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calstudy.claims.evaluation import evaluate as evaluate_claims
from calstudy.claims.evaluation import roles_of
from calstudy.claims.run_times import RunTimes
from calstudy.claims.statement import Claim
from calstudy.claims.study import Study
from calstudy.claims.tables import tally, write_claims
from calstudy.stages.registry import Job

TABLES = ("spectra", "agreement")


def evaluate(job: Job) -> Mapping[str, Any]:
    """Write claims.json and claims.md of one run."""
    study = Study.of(job.settings["experiment"], [job.inputs[name] for name in TABLES if name in job.inputs])
    return _write(job, evaluate_claims(dict.fromkeys(roles_of(study), study)))


def evaluate_combined(job: Job) -> Mapping[str, Any]:
    """Write claims.json and claims.md of the runs of a collection, each in the role that it plays there."""
    studies = {
        role: Study.of(
            job.settings["experiments"][member],
            [job.inputs[f"{name}:{member}"] for name in TABLES if f"{name}:{member}" in job.inputs],
        )
        for role, member in job.settings["roles"].items()
    }
    return _write(job, evaluate_claims(studies))


def evaluate_run_times(job: Job) -> Mapping[str, Any]:
    """Write claims.json and claims.md of a run-time study."""
    study = RunTimes.of(job.settings["title"], job.inputs["runtime"])
    return _write(job, evaluate_claims({"run_time": study}))


def _write(job: Job, claims: Sequence[Claim]) -> dict[str, Any]:
    write_claims(claims, job.output, job.settings["title"], job.settings["notes"])
    failed = [claim.name for claim in claims if claim.verdict == "FAIL"]
    return {"verdicts": tally(claims), "failed": failed}
