"""What the package declares about itself."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions
from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.cli.main import app
from calstudy.run import provenance

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMPORTED = ("cpu", "gpu", "engines", "ms", "dp3")
"""Extras whose packages calstudy imports or runs."""


def normalized(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def declared():
    """Of the package and of the extras that calibrators, engines and file formats need."""
    extras = PROJECT["optional-dependencies"]
    requirements = [*PROJECT["dependencies"], *(each for name in IMPORTED for each in extras[name])]
    return {normalized(re.match(r"[\w.-]+", requirement)[0]) for requirement in requirements}


def pinned():
    """Return the versions in constraints.txt, by package."""
    pairs = (line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines())
    return {normalized(name): version for name, version in pairs}


def locked():
    """Return the packages of uv.lock."""
    return tomllib.loads((ROOT / "uv.lock").read_text())["package"]


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
    # The only module of an extra whose package has another name; it need not be installed.
    distributions = {"casacore": ["python-casacore"], **packages_distributions()}
    missing = {
        name: sorted(paths)
        for name, paths in imported().items()
        if not declared() & {normalized(owner) for owner in distributions.get(name, [name])}
    }
    assert missing == {}


def test_every_dependency_is_pinned():
    assert declared() <= pinned().keys()


def test_pip_and_uv_install_the_same_versions():
    """There is one version of each package, for all Pythons; CUDA's libraries are those that TensorFlow asks for."""
    versions = {package["name"]: package["version"] for package in locked() if package["name"] != "calstudy"}
    assert len(versions) == len(locked()) - 1
    cuda = {name for name in versions if name.startswith("nvidia-")}
    assert pinned() == {name: version for name, version in versions.items() if name not in cuda}


def test_the_lock_names_public_places_only():
    text = (ROOT / "uv.lock").read_text()
    assert set(re.findall(r"\w+://[^/\"]+", text)) == {"https://pypi.org", "https://files.pythonhosted.org"}
    sources = [package["source"] for package in locked() if package["name"] != "calstudy"]
    assert all(source == {"registry": "https://pypi.org/simple"} for source in sources)


def test_tensorflow_of_any_package_is_recorded(monkeypatch):
    installed = {"tensorflow-cpu": "2.21.0"}

    def version(name):
        if name not in installed:
            raise PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(provenance, "version", version)
    monkeypatch.setattr(provenance, "_version", provenance._version.__wrapped__)
    assert provenance.package_versions()["tensorflow"] == "2.21.0"
    installed["tensorflow"] = "2.22.0"
    assert provenance.package_versions()["tensorflow"] == "2.22.0"


@pytest.mark.parametrize(
    "arguments",
    [
        ["plan", str(ROOT / "experiments" / "quickstart.yaml")],
        ["plan", str(ROOT / "experiments" / "runtime.yaml")],
    ],
    ids=" ".join,
)
def test_without_tensorflow_commands_say_what_is_missing(arguments, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorflow", None)
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, InputError)
    assert "TensorFlow is not installed: pip install 'calstudy[cpu]', or 'calstudy[gpu]'" in str(result.exception)


def test_a_command_that_takes_no_tensorflow_goes_on_without(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorflow", None)
    planned = ["plan", str(ROOT / "experiments" / "quickstart.yaml"), "--set", "calibration={calibrator: none}"]
    result = CliRunner().invoke(app, planned)
    assert result.exit_code == 0, result.output


def test_the_package_says_that_it_is_typed():
    assert files("calstudy").joinpath("py.typed").is_file()


def test_version_and_licence_agree_with_the_citation_file():
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {PROJECT['version']}\n" in citation
    assert f"\nlicense: {PROJECT['license']}\n" in citation
