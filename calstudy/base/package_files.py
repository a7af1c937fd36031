"""Files of packages: experiments and their reference results, which calstudy publishes, and data of other packages.

What calstudy publishes is in a checkout its folders ``experiments`` and ``figures``, to which ``calstudy/published``
links; an installed package has copies.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from calstudy.base.errors import InputError

PUBLISHED = Path(__file__).resolve().parents[1] / "published"


class PackageFile(NamedTuple):
    """A data file that an installed package brings; products that depend on it have its SHA-256 in their record."""

    package: str
    name: str

    @property
    def path(self) -> Path:
        """Where it is; the package is not imported, which can take a second."""
        found = find_spec(self.package)
        if found is None or found.origin is None:
            raise InputError(f"the package {self.package} is not installed; it brings {self.name}")
        return Path(found.origin).parent / self.name


def published(kind: str) -> Path:
    """Return the folder of published files: "experiments", or "figures" for the reference results."""
    return (PUBLISHED / kind).resolve()


def experiment_names() -> list[str]:
    """Return the names of the published experiments."""
    return sorted(path.stem for path in published("experiments").glob("*.yaml"))


def find_experiment(path: Path) -> Path:
    """Return the path of an experiment file, given its path or the name of a published one, such as ``quickstart``.

    Raises InputError if it is a name without suffix or folder, and neither a file nor a published experiment.
    """
    if path.exists() or path.name != str(path) or path.suffix:
        return path
    if path.name in experiment_names():
        return published("experiments") / f"{path.name}.yaml"
    listed = ", ".join(experiment_names())
    raise InputError(f"{path}: neither a file nor a published experiment (there are: {listed})")


def reference_folder() -> Path:
    """Return the folder of reference results: ``figures`` in the working directory, or the published ones.

    Raises InputError if neither exists.
    """
    for folder in (Path("figures"), published("figures")):
        if folder.is_dir():
            return folder
    raise InputError("there are no reference results here; give the folder of some: calstudy regress FOLDER")
