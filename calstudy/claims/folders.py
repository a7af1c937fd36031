"""Evaluate the claims on the folder of a finished run, or of a finished collection."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calstudy.claims.evaluation import evaluate, roles_of
from calstudy.claims.run_times import RunTimes
from calstudy.claims.statement import Claim
from calstudy.claims.study import Study
from calstudy.claims.tables import write_claims
from calstudy.errors import InputError
from calstudy.experiment.files import read_mapping


@dataclass(frozen=True)
class EvaluatedRun:
    """The claims of one run folder, and its name."""

    title: str
    claims: list[Claim]


def evaluate_folder(folder: Path) -> EvaluatedRun:
    """Evaluate the claims on the tables of a run folder, and write claims.json and claims.md into it.

    Parameters
    ----------
    folder
        Of a run (``experiment.yaml``, ``tables/``), or of a collection, whose members' folders are beside it.

    Raises
    ------
    InputError
        If it is neither, or cannot be written.
    """
    manifest = _manifest(folder)
    if manifest.get("kind") == "runtime":
        studies = {"run_time": RunTimes.of(manifest["name"], _tables(folder))}
    elif "members" in manifest:
        members = manifest["members"]
        studies = {role: _study(folder.resolve().parent / members[name]) for role, name in manifest["roles"].items()}
    else:
        study = _study(folder)
        studies = dict.fromkeys(roles_of(study), study)
    evaluated = EvaluatedRun(manifest["name"], evaluate(studies))
    try:
        write_claims(evaluated.claims, folder, evaluated.title, manifest["stand_ins"])
    except OSError as error:
        raise InputError(f"{folder}: the claims cannot be written ({error.strerror})") from None
    return evaluated


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(
            f"{folder}: is not the folder of a finished run (it has no readable manifest.json); give one that "
            "'calstudy run' printed"
        ) from None


def _tables(folder: Path) -> Path:
    if not (folder / "tables").is_dir():
        raise InputError(f"{folder}: has no tables; run the experiment again")
    return folder / "tables"


def _study(folder: Path) -> Study:
    return Study.of(read_mapping(folder / "experiment.yaml"), [_tables(folder)])
