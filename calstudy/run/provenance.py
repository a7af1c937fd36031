"""Where results come from: versions, commit, machine, seeds."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

from calstudy import __version__
from calstudy.base.resources import cores

PACKAGES = (
    "numpy",
    "scipy",
    "astropy",
    "pyuvdata",
    "pyuvsim",
    "pyradiosky",
    "hera_pspec",
    "tensorflow",
    "fftvis",
    "finufft",
    "healpy",
    "dask",
    "mwa_pb",
    "matplotlib",
)


def package_versions() -> dict[str, str | None]:
    """Return the versions of the packages that results depend on; None for one that is not installed."""
    versions: dict[str, str | None] = {"calstudy": __version__}
    for name in PACKAGES:
        versions[name] = _version(name)
    # Without CUDA the same module comes in a package of another name.
    versions["tensorflow"] = versions["tensorflow"] or _version("tensorflow-cpu")
    return versions


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def git_commit() -> str | None:
    """Return the commit of the checkout that calstudy runs from, with ``-dirty`` if it was changed, or None."""
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
    """Return the model of this machine's processor, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    """Return the processor and its cores, memory, system and Python of this machine."""
    return {
        "processor": processor(),
        "cores": cores(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def seeds(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return every seed in nested settings, by its dotted path."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if key in ("seed", "seeds"):
            found[f"{prefix}{key}"] = value
        elif isinstance(value, Mapping) and key != "scales":
            found |= seeds(value, f"{prefix}{key}.")
        elif isinstance(value, list):
            blocks = {str(place): item for place, item in enumerate(value) if isinstance(item, Mapping)}
            found |= seeds(blocks, f"{prefix}{key}.")
    return found
