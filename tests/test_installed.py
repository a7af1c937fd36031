"""The wheel: commands find the published experiments and reference results wherever they are run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from calstudy.base.errors import InputError
from calstudy.base.package_files import experiment_names, find_experiment, published, reference_folder
from calstudy.experiment.files import StudyFile

pytestmark = pytest.mark.chain

ROOT = Path(__file__).parents[1]
SOURCES = ("calstudy", "experiments", "figures", "pyproject.toml", "README.md", "LICENSE")


def test_in_a_checkout_published_files_are_its_own(monkeypatch, tmp_path):
    assert published("experiments") == ROOT / "experiments"
    assert experiment_names() == sorted(path.stem for path in (ROOT / "experiments").glob("*.yaml"))
    monkeypatch.chdir(tmp_path)
    assert find_experiment(Path("quickstart")) == ROOT / "experiments" / "quickstart.yaml"
    assert reference_folder() == ROOT / "figures"
    Path("figures").mkdir()
    assert reference_folder() == Path("figures")


def test_a_file_comes_before_a_published_experiment_of_its_name(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("quickstart").write_text("name: mine")
    assert find_experiment(Path("quickstart")) == Path("quickstart")
    for path in (Path("mine.yaml"), Path("folder/quickstart")):
        assert find_experiment(path) == path
    with pytest.raises(
        InputError, match=r"quickstrat: neither a file nor a published experiment, did you mean 'quickstart'\?"
    ):
        find_experiment(Path("quickstrat"))


def test_a_folder_does_not_hide_a_published_experiment_of_its_name(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("checks", "mine"):
        Path(name).mkdir()
    assert find_experiment(Path("checks")) == ROOT / "experiments" / "checks.yaml"
    with pytest.raises(InputError, match="mine: is a folder, not a file"):
        StudyFile.open(Path("mine"))


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder that the wheel was installed into, without its dependencies.

    It is made from a git repository: where setuptools_scm is installed, which pyuvdata needs, setuptools asks git.
    """
    folder = tmp_path_factory.mktemp("installed")
    sources = folder / "sources"
    sources.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / name, sources / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(ROOT / name, sources)
    git = ["git", "-C", str(sources), "-c", "user.name=Someone", "-c", "user.email=", "-c", "core.compression=0"]
    for arguments in (("init", "--quiet"), ("add", "."), ("commit", "--quiet", "--message=Sources")):
        subprocess.run([*git, *arguments], check=True)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    wheels = folder / "wheels"
    subprocess.run([*pip, "wheel", str(sources), "--no-deps", "--no-build-isolation", "-w", str(wheels)], check=True)
    (wheel,) = wheels.iterdir()
    # Most of it are the references, with figures of half a megabyte for each study.
    studies = sum(path.is_dir() for path in (ROOT / "figures").iterdir())
    assert wheel.stat().st_size < 0.57e6 * studies
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    shutil.rmtree(sources)
    return folder / "site"


def python(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the installed package, in another folder than the checkout."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_an_installed_package_plans_a_published_experiment(installed, tmp_path):
    result = python(installed, tmp_path, "-m", "calstudy", "plan", "quickstart")
    assert result.returncode == 0, result.stderr
    assert "quickstart: plan for" in result.stdout
    assert str(tmp_path / "store") in result.stdout


def test_an_installed_package_has_steps_and_references(installed, tmp_path):
    result = python(installed, tmp_path, "-m", "calstudy", "validate", "9.9")
    assert result.returncode == 2
    assert "9.9: not a step of the ladder (there are: -1, 0.0" in result.stderr
    read = (
        "from calstudy.base.package_files import reference_folder\n"
        "from calstudy.regression import find_references, read_reference\n"
        "for folder in find_references([reference_folder()]):\n"
        "    print(folder.parents[2].name, folder.name, len(read_reference(folder).figures))\n"
    )
    result = python(installed, tmp_path, "-c", read)
    assert result.returncode == 0, result.stderr
    found = {line.split()[1]: line.split()[::2] for line in result.stdout.splitlines()}
    assert found.keys() >= {"minredundant", "redundant", "lowsnr", "paper"}
    assert all(package == "calstudy" and int(figures) > 0 for package, figures in found.values())


@pytest.mark.slow
def test_an_installed_package_validates(installed, tmp_path):
    result = python(installed, tmp_path, "-m", "calstudy", "validate", "-1", "--scale", "small")
    assert result.returncode == 0, result.stdout + result.stderr
    (table,) = (tmp_path / "runs").glob("validation-*/claims.md")
    assert "1 of 1 steps pass" in table.read_text()
