"""What the package declares about itself."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def normalized(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def declared():
    """Of the package and of the extras that calibrators and file formats need; setup installs all of them."""
    requirements = [
        *PROJECT["dependencies"],
        *PROJECT["optional-dependencies"]["ms"],
        *PROJECT["optional-dependencies"]["dp3"],
    ]
    return {normalized(re.match(r"[\w.-]+", requirement)[0]) for requirement in requirements}


def imported():
    """Names of the third-party modules that the package imports anywhere, with the files that import them."""
    found = {}
    for path in (ROOT / "calstudy").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            else:
                continue
            for name in names:
                found.setdefault(name.partition(".")[0], set()).add(str(path.relative_to(ROOT)))
    return {name: paths for name, paths in found.items() if name not in {*sys.stdlib_module_names, "calstudy"}}


def test_every_import_belongs_to_a_declared_dependency():
    distributions = packages_distributions()
    missing = {
        name: sorted(paths)
        for name, paths in imported().items()
        if not declared() & {normalized(owner) for owner in distributions.get(name, [name])}
    }
    assert missing == {}


def test_every_dependency_is_pinned():
    pinned = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().split()}
    assert declared() <= {normalized(name) for name in pinned}


def test_the_package_says_that_it_is_typed():
    assert files("calstudy").joinpath("py.typed").is_file()


def test_version_and_licence_agree_with_the_citation_file():
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {PROJECT['version']}\n" in citation
    assert f"\nlicense: {PROJECT['license']}\n" in citation
