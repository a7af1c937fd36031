"""A kind of study is one file: what it makes of its members has its own run folder, and is found again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from installed import install
from tiny import load, tiny

from calstudy.base.errors import InputError
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.load import load_study
from calstudy.studies.reference import plugin_reference
from calstudy.studies.study import run_study

CODE = '''
"""An experiment with several seeds of its EoR, each with a run folder of its own."""
from pydantic import Field

from calstudy.experiment.files import override, validate
from calstudy.experiment.model import FIGURES, Experiment
from calstudy.figures import Drawing, StudyFigure, members_of
from calstudy.plotting import style
from calstudy.results.reader import Tables
from calstudy.studies.kinds.experiment import Family


class SeedsFile(Experiment):
    seeds: tuple[int, ...] = Field(min_length=2, description="Seeds of the EoR.")


class Power(StudyFigure):
    of = ("experiment", "collection")

    def draw(self, job):
        folders = {label: inputs["spectra"] for label, inputs in members_of(job).items()}
        found = {label or "all": Tables((folder,)).spherical("eor", "all-modes") for label, folder in folders.items()}
        return Drawing(style.new_figure(2.0, 2.0), {name: spectrum.power.real for name, spectrum in found.items()})


class Seeds(Family):
    model = SeedsFile

    @classmethod
    def load(cls, file):
        plain = {key: value for key, value in file.changed().items() if key != "seeds"}
        drawn = {seed: override(plain, "sky.eor.seed", seed) for seed in file.read(SeedsFile).seeds}
        return cls(file.read(SeedsFile), {f"seed-{seed}": validate(data, file.folder) for seed, data in drawn.items()})

    @property
    def parts(self):
        return self.studies

    @property
    def figures(self):
        return [self.draw(FIGURES.make(__file__))]
'''


# Of members that share the foregrounds; nothing is calibrated.
VARIANTS = {"eor": {"components": ["eor"]}, "both": {"components": ["foregrounds", "eor"]}}


def write(folder: Path, **changes) -> Path:
    (folder / "seeds.py").write_text(CODE)
    data = {**tiny(folder), "variants": VARIANTS, "study": "seeds.py", "seeds": [1, 2], **changes}
    data["outputs"] = {**data["outputs"], "figures": ["seeds.py"]}
    path = folder / "seeds.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "store").symlink_to(shared_store)
    return folder


@pytest.fixture(scope="module")
def finished(folder):
    return run_study(load_study(write(folder)), Budget(workers=1))


@pytest.mark.chain
def test_one_figure_is_drawn_of_each_member_and_of_all(finished):
    def arrays(folder: Path) -> dict[str, np.ndarray]:
        return RunFolder(folder).arrays()["seeds"]

    whole = arrays(finished.folder)
    assert set(whole) == {"seed-1", "seed-2"}
    assert not np.array_equal(whole["seed-1"], whole["seed-2"])
    for label, part in finished.parts.items():
        np.testing.assert_array_equal(arrays(part.folder)["all"], whole[label])


@pytest.mark.chain
def test_members_share_the_products_that_do_not_depend_on_what_differs(finished):
    one, two = ({task.key for task in part.tasks if task.stage.name == "simulate"} for part in finished.parts.values())
    assert len(one & two) == 1
    assert len(one ^ two) == 2


@pytest.mark.chain
def test_the_report_and_the_results_lead_to_the_members(finished):
    run = RunFolder(finished.folder)
    assert [run.parts[name].path.resolve() for name in finished.parts] == [
        part.folder for part in finished.parts.values()
    ]
    page = (finished.folder / "report.html").read_text()
    assert all(part.folder.name in page for part in finished.parts.values())


def test_the_resolved_file_is_the_same_study(finished):
    again = load_study(finished.folder / "experiment.yaml")
    assert again.folder == finished.folder
    assert [task.key for task in again.targets] == [
        task.key for task in load_study(again.folder / "experiment.yaml").targets
    ]
    manifest = json.loads((finished.folder / "manifest.json").read_text())
    assert {entry["key"] for entry in manifest["products"]} == {task.key for task in again.own}


def test_a_change_of_the_file_has_another_run_folder(folder):
    assert load_study(write(folder), None, ["seeds=[1, 3]"]).folder != load_study(write(folder)).folder


def test_an_installed_kind_is_named_by_its_entry_point(folder, monkeypatch, tmp_path):
    point = "calstudy.kinds: seeds = seeds_package:Seeds"
    install(monkeypatch, tmp_path, "seeds_package", CODE, point, "1.0")
    found = load_study(write(folder, study="seeds"))
    assert list(found.members) == ["seed-1", "seed-2"]


def test_a_file_without_the_key_is_an_experiment(folder):
    path = write(folder, study=None, seeds=None)
    assert isinstance(load_study(path), ExperimentStudy)
    assert load(path).name == load_study(path).name


def test_its_fields_are_listed(folder):
    write(folder)
    page = plugin_reference(folder / "seeds.py")
    assert "# Files with `study: seeds.py:Seeds`" in page
    assert "| `seeds` | list of whole numbers | required | Seeds of the EoR. |" in page


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"study": "sweeep"}, "'sweeep' is not a kind, did you mean 'sweep'?"),
        ({"study": "none.py"}, "cannot be read"),
        ({"seeds": [1]}, "seeds: "),
        ({"sky": {"eor": {"seed": "x"}}}, "sky.eor.seed"),
    ],
)
def test_a_fault_is_told_in_the_files_own_terms(folder, changes, told):
    with pytest.raises(InputError) as caught:
        load_study(write(folder, **changes))
    assert told in str(caught.value)
