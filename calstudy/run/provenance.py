"""Provenance of results: source, versions, data files of packages, commit, machine, seeds."""

from __future__ import annotations

import platform
import subprocess
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from calstudy import __version__
from calstudy.base.errors import InputError
from calstudy.base.files import digest_json, sha256
from calstudy.base.kept_arrays import kept_arrays
from calstudy.base.package_files import PackageFile
from calstudy.base.paths import leaves
from calstudy.base.resources import cores, total_memory
from calstudy.run.source import source_of
from calstudy.run.store import Product
from calstudy.run.task import Task

PACKAGES = (
    "numpy",
    "scipy",
    "astropy",
    "astropy-iers-data",
    "numba",
    "pyuvdata",
    "pyuvsim",
    "pyradiosky",
    "hera_pspec",
    "hera-calibration",
    "hera_qm",
    "tensorflow",
    "fftvis",
    "matvis",
    "finufft",
    "healpy",
    "dask",
    "mwa_pb",
    "matplotlib",
)
IMPORTED_AS = {"astropy-iers-data": "astropy", "hera-calibration": "hera_cal"}
"""Import names of packages, where they differ; the tables of the first are read by astropy."""


def package_versions() -> dict[str, str | None]:
    """Return the versions of the packages that results depend on; None for one that is not installed."""
    return {"calstudy": __version__, **{name: _version(name) for name in PACKAGES}}


@cache
def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        # Without CUDA the same module is in a package of another name.
        return _version("tensorflow-cpu") if package == "tensorflow" else None


def made_with(task: Task) -> dict[str, Any]:
    """Return the digest of the source of a product, and the versions and data files of the packages that it uses.

    Together with its key they determine a product.
    """
    source = source_of(type(task), task.settings)
    versions = {name: _version(name) for name in PACKAGES if IMPORTED_AS.get(name, name) in source.packages}
    files = {f"{file.package}/{file.name}": _digest_of(file) for file in sorted(source.files)}
    return {"source": source.digest, "versions": versions, "files": files}


@cache
def _digest_of(file: PackageFile) -> str | None:
    """Return the SHA-256 of a file of a package, or None if it is missing; kept, because the largest takes a second."""
    try:
        path, state = file.path, file.path.stat()
    except (InputError, OSError):
        return None
    identity = {"path": str(path), "modified": state.st_mtime_ns, "size": state.st_size}
    return str(kept_arrays("sha256", identity, lambda: {"sha256": np.asarray(sha256(path))})["sha256"])


def lineage(own: Mapping[str, Any], needs: Iterable[str]) -> str:
    """Return the digest of a product's `made_with` and of the lineages of the products that it needs.

    It does not depend on the number of pieces.
    """
    return digest_json([own, sorted(set(needs))])


def lineages(tasks: Iterable[Task]) -> dict[str, str]:
    """Return by key the lineages that products would have if they were made now; every task follows its inputs."""
    found: dict[str, str] = {}
    for task in tasks:
        found[task.key] = lineage(made_with(task), (found[needed.key] for needed in task.needs.values()))
    return found


def of_other_code(tasks: Sequence[Task], products: Mapping[str, Product]) -> frozenset[str]:
    """Return the keys of products whose lineage differs from the one that they would have if they were made now.

    Every task follows its inputs; products of some tasks may be missing.
    """
    current = lineages(tasks) if products else {}
    return frozenset(key for key, product in products.items() if product.record["lineage"] != current.get(key))


def other_code(stages: Sequence[str]) -> str | None:
    """Return a sentence that counts products of other code by their stages, or None if there are none."""
    if not stages:
        return None
    counts = ", ".join(f"{stage} {count}" for stage, count in Counter(stages).items())
    return (
        f"{len(stages)} products in the store are of other code of calstudy or other versions of packages, or made "
        f"from such ({counts}); 'calstudy run --strict' makes them again"
    )


@cache
def git_commit() -> str | None:
    """Return the commit of calstudy's checkout, with ``-dirty`` if it was changed, or None without a checkout."""
    checkout = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != checkout:
            return None
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def processor() -> str:
    """Return the model of this machine's processor, if the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


@cache
def libraries() -> list[str]:
    """Return the loaded BLAS libraries, each with its version and the kind of processor that it supports."""
    from threadpoolctl import threadpool_info

    found = (item for item in threadpool_info() if item["user_api"] == "blas")
    return sorted({f"{item['internal_api']} {item['version']} {item.get('architecture', '')}" for item in found})


def machine() -> dict[str, Any]:
    """Return the processor and its cores, memory, system and Python of this machine."""
    return {
        "processor": processor(),
        "cores": cores(),
        "memory_gb": round(total_memory() / 1e9, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def seeds(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return every seed in nested settings but those of scales, by its dotted path."""
    names = ("seed", "seeds", "seeds_without_eor")
    found = {path: value for path, value in leaves(settings) if path.rpartition(".")[2] in names}
    return {path: value for path, value in found.items() if not path.startswith("scales.")}
