"""Reference results on disk: the kept part of a finished run, its reading and acceptance, and its study run again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import yaml
from pydantic import ValidationError
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.experiment.model import FIGURES
from calstudy.results.folder import EXPERIMENT, MANIFEST, NO_RUN, RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import CLAIMS_FILES
from calstudy.verdicts.tolerances import Rules

KEPT = ("png", "npz")
"""Endings of the kept files of a figure: the picture and its arrays."""
TABLES = ("realizations.md", "comparison.md")
"""Tables for readers, kept beside the figures."""


@dataclass(frozen=True)
class Reference:
    """Figures (arrays by figure and name) and claims of a run or of a reference.

    `tolerances` are those of the figures that the experiment of a reference names, by label. `on_machines` is true for
    a reference of run times, which are those of a machine.
    """

    figures: dict[str, dict[str, np.ndarray]]
    claims: list[Verdict]
    tolerances: dict[str, Rules] = field(default_factory=dict)
    on_machines: bool = False


def find_references(folders: Sequence[Path]) -> list[Path]:
    """Return the reference folders among these and directly below; raise InputError for a folder without any."""
    found: list[Path] = []
    for folder in folders:
        inside = (
            [folder]
            if (folder / EXPERIMENT).is_file()
            else sorted(path.parent for path in folder.glob("*/" + EXPERIMENT))
        )
        if not inside:
            raise InputError(f"{folder}: holds no reference results (a folder with {EXPERIMENT}, or folders with one)")
        found += [path for path in inside if path not in found]
    return found


def read_reference(folder: Path) -> Reference:
    """Read a reference; raise InputError if an array, claim or experiment file is not readable."""
    run = RunFolder(folder)
    return Reference(run.arrays(), run.claims, _tolerances(run.content, folder), "runtime" in run.content)


def _tolerances(experiment: Mapping[str, Any], folder: Path) -> dict[str, Rules]:
    """Return the tolerances of the figures that an experiment or a collection names; a collection has them on top.

    A user's figure that no longer exists has none, so that its arrays may not move at all.
    """
    named = experiment.get("figures", (experiment.get("outputs") or {}).get("figures", ()))
    found = {}
    for block in named:
        try:
            figure = FIGURES.make(block, folder=folder)
        except (InputError, ValidationError):
            continue
        found[figure.label] = figure.tolerances
    return found


def read_run(folder: Path) -> Reference:
    """Read a finished run or collection; raise InputError for another folder."""
    run = RunFolder(folder)
    if not (folder / "figures").is_dir() or not run.manifest:
        raise InputError(f"{folder}: {NO_RUN}")
    return Reference(run.arrays(), run.claims)


def accept(run: Path, reference: Path) -> None:
    """Make a finished run the reference: its pictures, arrays, tables, claims and description replace the old ones.

    The run may be of an experiment or a collection. Files that the run does not have are removed from the reference
    folder, which is made if it does not exist. A collection keeps the experiments of its members as they are in the
    references beside it, by the members' names. Raise InputError if the run is not readable, or the folder cannot be
    written; the complete run is read before anything is written.
    """
    try:
        manifest = RunFolder(run).manifest
        paths = {path.name: path for ending in KEPT for path in (run / "figures").glob(f"*.{ending}")}
        paths |= {name: run / name for name in CLAIMS_FILES if (run / name).is_file()}
        paths |= {name: run / "tables" / name for name in TABLES if (run / "tables" / name).is_file()}
        # A collection can be assembled from references with these (`calstudy.studies.finished`).
        listed = {name for entry in manifest.get("products", []) for name in entry.get("files", ())}
        paths |= {f"tables/{name}": run / "tables" / name for name in sorted(listed)}
        contents = {name: path.read_bytes() for name, path in paths.items()}
        contents[MANIFEST] = (run / MANIFEST).read_bytes()
        if "members" in manifest:
            beside = {**manifest, "members": {name: name for name in manifest["members"]}}
            contents[MANIFEST] = json.dumps(beside, indent=1).encode()
        description = yaml.safe_dump(_experiment(run), sort_keys=False, allow_unicode=True, width=100)
    except (OSError, ValueError) as error:
        raise InputError(f"{run}: cannot be read ({error})") from None
    try:
        (reference / "tables").mkdir(parents=True, exist_ok=True)
        kept = [path for ending in KEPT for path in reference.glob(f"*.{ending}")]
        kept += [*(reference / name for name in (*CLAIMS_FILES, *TABLES)), *(reference / "tables").iterdir()]
        for old in kept:
            if old.relative_to(reference).as_posix() not in contents:
                old.unlink(missing_ok=True)
        for name, content in contents.items():
            _replace(reference / name, content)
        _replace(reference / EXPERIMENT, description.encode())
        if not listed:
            (reference / "tables").rmdir()
    except OSError as error:
        raise InputError(f"{reference}: cannot be written ({error.strerror})") from None


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_name(f".{path.name}-{uuid4().hex}")
    partial.write_bytes(content)
    shutil.move(partial, path)


def _experiment(run: Path) -> dict[str, Any]:
    """Return the description of the run, without the folders of the machine where it was made."""
    finished = RunFolder(run)
    if (run / EXPERIMENT).is_file():
        return _without_folders(finished.content)
    manifest = finished.manifest
    drawn = sorted(path.stem for path in (run / "figures").glob("*.npz"))
    return {
        "name": manifest["name"],
        "description": manifest["description"],
        "experiments": [f"../{name}/{EXPERIMENT}" for name in manifest["members"]],
        "figures": manifest.get("figures", drawn),
        "roles": manifest["roles"],
    }


def _without_folders(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an experiment, or a comparison with one in it, without its store and folder of runs."""
    if isinstance(content.get("experiment"), Mapping):
        worlds = {
            world: {path: value for path, value in changes.items() if path not in ("outputs.store", "outputs.runs")}
            for world, changes in content["worlds"].items()
        }
        return {**content, "experiment": _without_folders(content["experiment"]), "worlds": worlds}
    outputs = {key: value for key, value in content.get("outputs", {}).items() if key not in ("store", "runs")}
    return {**content, "outputs": outputs}


def remake(reference: Path, overrides: Sequence[str], budget: Budget, console: Console) -> Path:
    """Run the study of a reference folder with ``path=value`` overrides, and return the run's folder.

    Products of other code are made again.

    Raise InputError if the experiment is a sweep, or as the run raises it.
    """
    study = load_study(reference / EXPERIMENT, None, overrides)
    if not study.has_reference:
        raise InputError(f"{reference}: is a {study.key}, which has no reference results")
    return run_study(study, budget, console, strict=True).folder
