"""Packages that are installed for the time of a test, with entry points."""

from __future__ import annotations

from importlib import invalidate_caches
from pathlib import Path

import pytest


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, module: str, text: str, point: str, version: str) -> None:
    """Install a package of one module with one entry point.

    Parameters
    ----------
    monkeypatch
        Undoes it.
    folder
        Empty; where it is installed.
    module, text
        Name and content of the module.
    point
        The entry point, such as ``calstudy.figures: name = module:Class``.
    version
        Of the package, which has the name of the module.
    """
    group, _, entry = point.partition(": ")
    (folder / f"{module}.py").write_text(text)
    metadata = folder / f"{module}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: {version}\n")
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")
    monkeypatch.syspath_prepend(str(folder))
    invalidate_caches()
