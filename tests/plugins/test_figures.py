"""A figure of one's own, from a single file: by its path, and installed with an entry point."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import yaml
from installed import install
from plugin_files import sections
from rich.console import Console
from tiny import tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.experiment.model import FIGURES
from calstudy.plotting.style import journal_style
from calstudy.regression import accept, compare_figures, read_reference, read_run, rules_of
from calstudy.report.page import read_contents
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import Run, run_study

DRAWN = True

NAME = "retained_power"
CODE = sections()["A figure"]["python"]
CAPTION = "Power of the residual over that of the EoR, outside the wedge, with 95 % bars."
BROKEN = """
from calstudy.figures import StudyFigure

class Broken(StudyFigure):
    fault: str = "raise"

    def inputs(self, graph):
        return {"spectrum": "power"} if self.fault == "inputs" else {}

    def draw(self, job):
        if self.fault == "return":
            return "a picture"
        raise KeyError("no such array")
"""
SIZES = """
import matplotlib

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style

class Sizes(StudyFigure):
    of = ("collection",)
    caption = "Sizes."
    titles = {"small": "Small", "large": "Large"}

    def inputs(self, graph):
        return {}

    def draw(self, job):
        sides = [job.settings["layouts"][role].side for role in self.titles]
        return Drawing(style.new_figure(2.0, 2.0), {"sides": sides, "size": matplotlib.rcParams["font.size"]})
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    """Where all runs of this file go: they share the products of the tiny experiment."""
    folder = tmp_path_factory.mktemp("figures")
    (folder / "store").symlink_to(shared_store)
    return folder


def study_of(folder: Path, *figures: Any, **changes: Any):
    """Return the tiny experiment with these figures, and with the figure of the page beside its file."""
    if not (folder / f"{NAME}.py").exists():
        (folder / f"{NAME}.py").write_text(CODE)
    data = tiny(folder)
    data = {**data, "outputs": {**data["outputs"], "figures": list(figures)}, **changes}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(data))
    return load_study(path)


def run_of(folder: Path, *figures: Any) -> Run:
    return run_study(study_of(folder, *figures), Budget(workers=1))


@pytest.fixture(scope="module")
def finished(folder) -> Run:
    return run_of(folder, "wedge", {"kind": f"{NAME}.py", "max_k": "0.6 h/Mpc"}, "layout")


@pytest.mark.chain
def test_it_is_drawn_into_the_run_folder_with_its_caption_in_the_order_of_the_file(finished):
    made = {path.name for path in (finished.folder / "figures").iterdir()}
    assert {f"{NAME}.{ending}" for ending in ("png", "pdf", "npz")} <= made
    with np.load(finished.folder / "figures" / f"{NAME}.npz") as arrays:
        assert set(arrays.files) == {"k", "ratio", "ratio_error"}
        assert 0 < arrays["k"].max() <= 0.6
    captions = json.loads((finished.folder / "manifest.json").read_text())["captions"]
    assert list(captions) == ["wedge", NAME, "layout"]
    assert captions[NAME] == CAPTION
    shown = {picture.name: picture.caption for picture in read_contents(RunFolder(finished.folder)).pictures}
    assert list(shown) == ["wedge", NAME, "layout"]
    assert f"{NAME}</strong>: {CAPTION}" in (finished.folder / "report.html").read_text()


@pytest.mark.chain
def test_an_installed_one_is_used_by_its_name(folder, finished, monkeypatch, tmp_path):
    point = "calstudy.figures: retained-power = retained_power_package:RetainedPower"
    install(monkeypatch, tmp_path, "retained_power_package", CODE, point, "1.0")
    assert "retained-power" in FIGURES.names()
    run = run_of(folder, {"kind": "retained-power", "max_k": "0.6 h/Mpc"})
    with (
        np.load(run.folder / "figures" / "retained-power.npz") as installed,
        np.load(finished.folder / "figures" / f"{NAME}.npz") as by_path,
    ):
        np.testing.assert_array_equal(installed["ratio"], by_path["ratio"])
    assert rules_of("retained-power") == FIGURES.find("retained-power").tolerances != ()


@pytest.mark.parametrize(
    ("figure", "changes", "told"),
    [
        (
            f"{NAME}.py",
            {"variants": {"eor": {"components": ["eor"]}}},
            f"outputs.figures: asks for '{NAME}', which needs the variant(s) residual",
        ),
        (
            f"{NAME}.py",
            {"variants": {"eor": {"components": ["eor"]}, "residual": {"components": ["foregrounds"]}}},
            f"outputs.figures: asks for '{NAME}', which needs variants.residual to have foregrounds",
        ),
        ({"kind": f"{NAME}.py", "max_k": "1 s"}, {}, "outputs.figures.1.max_k: '1 s' is not a wavenumber"),
        ({"kind": f"{NAME}.py", "max_k": "-1 h/Mpc"}, {}, "outputs.figures.1.max_k = '-1 h/Mpc': must be greater than"),
        ({"kind": f"{NAME}.py", "maxk": "1 h/Mpc"}, {}, "outputs.figures.1.maxk: unknown key, did you mean 'max_k'?"),
        ("none.py", {}, "cannot be read (No such file or directory)"),
        ("wegde", {}, "outputs.figures.1: 'wegde' is not a figure, did you mean 'wedge'? (there are: baselines, "),
        ("layout", {}, "outputs.figures.1: 'layout' cannot name a picture, or does so already"),
        ("sizes.py", {}, "outputs.figures: asks for 'sizes', which is a figure for collection files"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_sentence(tmp_path, figure, changes, told):
    (tmp_path / "sizes.py").write_text(SIZES)
    with pytest.raises(ExperimentError) as caught:
        study_of(tmp_path, "layout", figure, **changes)
    assert any(told in sentence for sentence in caught.value.faults), caught.value.faults


def test_settings_and_the_content_of_the_file_decide_the_product(tmp_path):
    def key(**settings: str) -> str:
        (figure,) = study_of(tmp_path, {"kind": f"{NAME}.py", **settings}).figures
        return figure.key

    first = key()
    assert key() == key(max_k="2 h/Mpc") == first
    assert key(max_k="1 h/Mpc") != first
    (tmp_path / f"{NAME}.py").write_text(CODE + "\n# changed\n")
    assert key() != first


def test_a_new_version_of_its_package_makes_an_installed_one_again(tmp_path, monkeypatch):
    keys = []
    for version in ("1.0", "1.1"):
        place = tmp_path / version
        place.mkdir()
        with monkeypatch.context() as patch:
            install(patch, place, "versioned", CODE, "calstudy.figures: mine = versioned:RetainedPower", version)
            keys.append(study_of(tmp_path, "mine").figures[0].key)
    assert keys[0] != keys[1]


@pytest.mark.chain
def test_its_tolerance_is_used_by_regress(finished, tmp_path):
    reference = tmp_path / "reference"
    accept(finished.folder, reference)
    old, new = read_reference(reference), read_run(finished.folder).figures
    assert {item.status for item in compare_figures(old.figures, new, old.tolerances)} == {"same"}
    arrays = new[NAME]
    for sigmas, status in ((3.0, "moved"), (4.5, "beyond")):
        ratio = arrays["ratio"].copy()
        ratio[-1] += sigmas * np.sqrt(2) * arrays["ratio_error"][-1]
        moved = {**new, NAME: {**arrays, "ratio": ratio}}
        compared = {(item.figure, item.name): item for item in compare_figures(old.figures, moved, old.tolerances)}
        assert compared[NAME, "ratio"].status == status
        assert compared[NAME, "ratio"].largest == pytest.approx(sigmas)
        assert compared[NAME, "ratio"].tolerance.startswith("largest 4 σ")


@pytest.mark.chain
def test_a_reference_whose_figure_is_gone_can_be_read(finished, tmp_path):
    accept(finished.folder, tmp_path)
    text = (tmp_path / "experiment.yaml").read_text()
    assert f"{NAME}.py" in text
    (tmp_path / "experiment.yaml").write_text(text.replace(f"{NAME}.py", "gone.py"))
    assert set(read_reference(tmp_path).tolerances) == {"wedge", "layout"}


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raise", "broken.py line 13, in draw: KeyError: 'no such array'"),
        ("return", "figure 'broken': draw returned a str, expected a Drawing"),
        ("inputs", "broken: inputs returned {'spectrum': 'power'}; tasks are needed, such as those of the graph"),
    ],
)
def test_what_goes_wrong_in_it_is_told_with_its_line(folder, fault, told):
    (folder / "broken.py").write_text(BROKEN)
    with pytest.raises(InputError) as caught:
        run_of(folder, {"kind": "broken.py", "fault": fault})
    assert str(caught.value) == told


@pytest.mark.chain
def test_one_that_compares_members_of_a_collection_without_papers(folder):
    study_of(folder)
    (folder / "sizes.py").write_text(SIZES)
    members = ["experiment.yaml", {"file": "experiment.yaml", "name": "other", "overrides": {"power.taper": "hann"}}]
    collection = {"name": "both", "experiments": members, "figures": ["sizes.py"]}
    path = folder / "both.yaml"
    path.write_text(yaml.safe_dump(collection))
    with pytest.raises(ExperimentError, match=r"'sizes', which needs a member in the role\(s\) small, large"):
        load_study(path)
    path.write_text(yaml.safe_dump({**collection, "roles": {"small": "tiny", "large": "other"}}))
    run = run_study(load_study(path), Budget(workers=1), Console(file=io.StringIO()))
    with np.load(run.folder / "figures" / "sizes.npz") as arrays:
        assert arrays["sides"].tolist() == [2, 2]
        with journal_style():
            assert arrays["size"] == mpl.rcParams["font.size"] != mpl.rcParamsDefault["font.size"]
    assert not (run.folder / "claims.json").exists()
    assert json.loads((run.folder / "manifest.json").read_text())["captions"] == {"sizes": "Sizes."}
    accept(run.folder, folder / "reference")
    assert set(read_reference(folder / "reference").tolerances) == {"sizes"}
