"""The folder of a finished run, or of reference results: manifest, experiment, tables, figures and claims."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.table import Table, from_json
from calstudy.experiment.files import validate
from calstudy.experiment.model import Experiment
from calstudy.experiment.yaml_files import read_mapping
from calstudy.products.files import COMPARISON
from calstudy.results.reader import Tables
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.standing import LIMIT, InBand, standings
from calstudy.verdicts.tables import CLAIMS_JSON
from calstudy.verdicts.tables import from_json as verdicts_from_json

MANIFEST, EXPERIMENT, SHOWN = "manifest.json", "experiment.yaml", "tables.json"
NO_RUN = "is not the folder of a finished run; give one that 'calstudy run' printed"


@dataclass(frozen=True)
class RunFolder:
    """The folder of a finished run, or of a reference, whose figures are beside its manifest.

    Every property reads its file when it is first used, and raises InputError if the file is damaged.
    """

    path: Path

    @cached_property
    def manifest(self) -> Mapping[str, Any]:
        """The content of manifest.json; raises InputError if the folder is not that of a finished run."""
        path = self.path / MANIFEST
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{self.path}: {NO_RUN} ({MANIFEST}: {error.strerror})") from None
        except ValueError:
            raise InputError(f"{path}: not valid JSON; the same run again writes it anew") from None
        if not isinstance(found, dict) or "name" not in found:
            raise InputError(f"{path}: not the manifest of a run")
        return found

    @property
    def name(self) -> str:
        """Name of the study."""
        return str(self.manifest["name"])

    @property
    def products(self) -> Sequence[Mapping[str, Any]]:
        """The manifest's entries of all products."""
        return self.manifest.get("products", [])

    @property
    def keys(self) -> frozenset[str]:
        """The keys of all products."""
        return frozenset(entry["key"] for entry in self.products)

    @property
    def finished(self) -> datetime:
        """Time when the run finished."""
        return datetime.fromisoformat(self.manifest["finished"])

    @property
    def size(self) -> int:
        """Size of all files in bytes."""
        return sum(file.stat().st_size for file in self.path.rglob("*") if file.is_file())

    @property
    def members(self) -> Mapping[str, RunFolder]:
        """Folders of the members of a collection, by name."""
        beside = self.path.resolve().parent
        return {name: RunFolder(beside / place) for name, place in self.manifest.get("members", {}).items()}

    @property
    def parts(self) -> Mapping[str, RunFolder]:
        """Folders of the runs of which this one consists, such as members of a collection, by name."""
        # Runs of earlier versions have their points alone.
        points = {item["folder"].rpartition("/")[2]: item["folder"] for item in self.manifest.get("points", [])}
        places = self.manifest.get("parts", points)
        return {**{name: RunFolder(self.path / place) for name, place in places.items()}, **self.members}

    @cached_property
    def content(self) -> Mapping[str, Any]:
        """The content of experiment.yaml; raises InputError if there is none."""
        return read_mapping(self.path / EXPERIMENT)

    def experiment(self, without: Sequence[str] = ()) -> Experiment:
        """Return the validated experiment of a run of one experiment, without some of its sections."""
        return validate({key: value for key, value in self.content.items() if key not in without}, self.path)

    @property
    def tables(self) -> Tables:
        """The tables of the run; raises InputError if there are none."""
        if not (self.path / "tables").is_dir():
            raise InputError(f"{self.path}: has no tables; run the experiment again")
        return Tables((self.path / "tables",))

    @property
    def shown(self) -> list[Table]:
        """The tables of a report that were made with the products; none in runs of earlier versions."""
        path = self.path / "tables" / SHOWN
        return from_json(path.read_text(encoding="utf-8")) if path.is_file() else []

    @property
    def figures(self) -> Path:
        """The folder of the figures; that of a reference is the folder itself."""
        inside = self.path / "figures"
        return inside if inside.is_dir() else self.path

    def arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the arrays of all figures, by figure and name."""
        try:
            return {path.stem: _arrays(path) for path in sorted(self.figures.glob("*.npz"))}
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{self.path}: its figures cannot be read ({error})") from None

    def standings(self, limit: float = LIMIT, worlds: Sequence[str] | None = None) -> list[InBand]:
        """Return how calibrators stand against a limit of the bias, in all or some worlds; empty without comparison."""
        scores = self._scores
        for world in worlds or ():
            if world not in scores:
                raise InputError(f"{world!r}: no world of the comparison (there are: {', '.join(scores)})")
        chosen = {world: scores[world] for world in worlds or scores}
        return standings(chosen, self.manifest.get("refusals", ()), limit)

    @property
    def _scores(self) -> Mapping[str, Mapping[str, Any]]:
        """The scores of a comparison by world and calibrator; empty for other runs."""
        path = self.path / "tables" / COMPARISON
        if not path.is_file():
            return {}
        try:
            scores = json.loads(path.read_text(encoding="utf-8"))
            # Reads all that is needed.
            standings(scores)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            raise InputError(f"{path}: is damaged; run the comparison again") from None
        return scores

    @property
    def has_claims(self) -> bool:
        """True if statements of papers were evaluated on the run."""
        return (self.path / CLAIMS_JSON).is_file()

    @property
    def claims(self) -> list[Verdict]:
        """Verdicts on the statements of papers; empty without claims.json."""
        return self.verdicts(self.path / CLAIMS_JSON, f"write it again: calstudy claims {self.path}")

    def verdicts(self, path: Path, remedy: str = "run the experiment again") -> list[Verdict]:
        """Return the verdicts of a JSON file; empty if it does not exist."""
        if not path.is_file():
            return []
        try:
            return verdicts_from_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError, KeyError):
            raise InputError(f"{path}: is damaged; {remedy}") from None


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def find_runs(folder: Path) -> list[RunFolder]:
    """Return the finished runs in a folder and its subfolders, the latest first; raises InputError without a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of runs")
    runs = (RunFolder(path.parent) for path in sorted(folder.rglob(MANIFEST)))
    return sorted(filter(_is_readable, runs), key=lambda run: run.finished, reverse=True)


def _is_readable(run: RunFolder) -> bool:
    try:
        return run.finished is not None and run.keys is not None
    except (InputError, ValueError, KeyError, TypeError):
        return False
