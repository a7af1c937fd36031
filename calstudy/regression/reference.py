"""Reference results on disk: what is kept of a finished run, read and accepted."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import yaml

from calstudy.claims.statement import Claim
from calstudy.claims.tables import CLAIMS_JSON, CLAIMS_MARKDOWN, from_json
from calstudy.errors import InputError
from calstudy.experiment.files import read_mapping

EXPERIMENT, MANIFEST = "experiment.yaml", "manifest.json"
KEPT = ("png", "npz")
"""Endings of a figure's files that are kept: the picture and its arrays."""


@dataclass(frozen=True)
class Results:
    """Figures and claims of a run or of a reference.

    Attributes
    ----------
    figures
        Arrays by figure and name.
    claims
        Evaluated; empty if there are none.
    """

    figures: dict[str, dict[str, np.ndarray]]
    claims: list[Claim]


def find_references(folders: Sequence[Path]) -> list[Path]:
    """Return the reference folders among these and directly below them.

    Raises
    ------
    InputError
        If a folder neither is one nor holds any.
    """
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


def read_reference(folder: Path) -> Results:
    """Read what is kept of a run; raises InputError if an array or claim file is not readable."""
    return _read(folder, folder)


def read_run(folder: Path) -> Results:
    """Read a finished run or collection; raises InputError if it is none."""
    if not (folder / "figures").is_dir() or not (folder / MANIFEST).is_file():
        raise InputError(f"{folder}: is not the folder of a finished run; give one that 'calstudy run' printed")
    return _read(folder, folder / "figures")


def _read(folder: Path, figures: Path) -> Results:
    try:
        arrays = {path.stem: _arrays(path) for path in sorted(figures.glob("*.npz"))}
        claims = (
            from_json((folder / CLAIMS_JSON).read_text(encoding="utf-8")) if (folder / CLAIMS_JSON).is_file() else []
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder}: its results cannot be read ({error})") from None
    return Results(arrays, claims)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def accept(run: Path, reference: Path) -> None:
    """Make a finished run the reference: its pictures, arrays, claims, manifest and experiment replace what is there.

    A collection keeps the experiments of its members as they are in the references beside it, by the members' names.

    Parameters
    ----------
    run
        Folder of a finished run of an experiment or a collection.
    reference
        Made if it does not exist. Pictures and arrays of figures that the run does not have are removed.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    sources = {path.name: path for ending in KEPT for path in (run / "figures").glob(f"*.{ending}")}
    sources |= {name: run / name for name in (CLAIMS_JSON, CLAIMS_MARKDOWN, MANIFEST)}
    description = yaml.safe_dump(_experiment(run), sort_keys=False, allow_unicode=True, width=100)
    try:
        reference.mkdir(parents=True, exist_ok=True)
        for stale in [path for ending in KEPT for path in reference.glob(f"*.{ending}") if path.name not in sources]:
            stale.unlink()
        for name, source in sources.items():
            _replace(reference / name, source.read_bytes())
        _replace(reference / EXPERIMENT, description.encode())
    except OSError as error:
        raise InputError(f"{reference}: cannot be written ({error.strerror})") from None


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_name(f".{path.name}-{uuid4().hex}")
    partial.write_bytes(content)
    shutil.move(partial, path)


def _experiment(run: Path) -> dict[str, Any]:
    """Return what the run was of, without the folders of the machine where it was made."""
    if (run / EXPERIMENT).is_file():
        experiment = read_mapping(run / EXPERIMENT)
        outputs = {key: value for key, value in experiment.get("outputs", {}).items() if key not in ("store", "runs")}
        return {**experiment, "outputs": outputs}
    manifest = json.loads((run / MANIFEST).read_text(encoding="utf-8"))
    figures = sorted(path.stem for path in (run / "figures").glob("*.npz"))
    return {
        "name": manifest["name"],
        "description": manifest["description"],
        "experiments": [f"../{name}/{EXPERIMENT}" for name in manifest["members"]],
        "figures": figures,
        "roles": manifest["roles"],
    }
