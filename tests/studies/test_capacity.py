"""Runs are fitted to the memory there is, without changing what they make."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny import load, tiny

from calstudy.base.errors import InputError
from calstudy.base.resources import parse_memory
from calstudy.experiment.files import override, validate
from calstudy.experiment.model import Experiment
from calstudy.products import corruption, simulation
from calstudy.products.calibration import CalibrateChunk
from calstudy.products.graph import Graph
from calstudy.run import execution
from calstudy.run.store import Store
from calstudy.run.task import Task
from calstudy.studies import capacity
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.study import Budget

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def targets_of(experiment: Experiment) -> list[Task]:
    return ExperimentStudy(experiment).targets


def fit(experiment: Experiment, *budget: int | str | bool | None, targets: Callable = targets_of):
    return capacity.fit(experiment, Budget(*budget), targets)


def tasks_of(experiment: Experiment) -> list[Task]:
    return ExperimentStudy(experiment).tasks


def foregrounds_of(experiment: Experiment) -> list[Task]:
    return [simulation.foregrounds(Graph(experiment))]


def eor_of(experiment: Experiment) -> Task:
    return simulation.eor(Graph(experiment))


@pytest.fixture
def paper(tmp_path) -> Experiment:
    """The paper's study at full scale, with an empty store."""
    return load(EXPERIMENTS / "minredundant.yaml", None, [f"outputs.store={tmp_path / 'store'}"])


def largest_piece(experiment: Experiment) -> float:
    return max(task.cost.memory for task in eor_of(experiment).pieces.values())


@pytest.mark.parametrize(("text", "size"), [("6 GB", 6e9), ("500MB", 5e8), (" 1.5 GB ", 1.5e9), ("2 TB", 2e12)])
def test_an_amount_of_memory_is_a_number_and_a_unit(text, size):
    assert parse_memory(text) == size


@pytest.mark.parametrize("text", ["6", "6 G", "GB", "-1 GB", "0 GB", "1.2.3 GB", "six GB"])
def test_other_texts_are_refused(text):
    with pytest.raises(InputError, match="--max-memory"):
        parse_memory(text)


def test_only_what_is_wanted_has_to_fit(paper):
    assert fit(paper, 8, "8 GB", targets=lambda experiment: [corruption.gains(Graph(experiment))]) == (paper, 8)
    assert fit(paper, 8, "8 GB", targets=foregrounds_of)[1] > fit(paper, 8, "8 GB")[1]


def test_less_memory_means_smaller_pieces_and_fewer_workers(paper):
    plenty, many = fit(paper, 8, "100 GB")
    assert (plenty, many) == (paper, 8)
    little, few = fit(paper, 8, "8 GB")
    assert little.simulation.chunks > paper.simulation.chunks
    assert largest_piece(little) < largest_piece(paper)
    assert 1 <= few < 8
    costs = [task.cost.memory for task in tasks_of(little)]
    assert few * max(costs) < 8e9


def test_smaller_pieces_are_the_same_products(paper):
    little, _ = fit(paper, 8, "8 GB")
    assert little.simulation.chunks > paper.simulation.chunks
    assert [task.key for task in targets_of(paper)] == [task.key for task in targets_of(little)]
    before, after = eor_of(paper), eor_of(little)
    assert before.key == after.key
    assert not {task.key for task in before.pieces.values()} & {task.key for task in after.pieces.values()}
    assert ExperimentStudy(paper).folder == ExperimentStudy(little).folder


def test_the_run_folder_is_named_by_the_study_alone(tmp_path, monkeypatch):
    """And not by what lies in the folders of products and runs, which would also be read in full."""
    monkeypatch.chdir(tmp_path)
    content = override(tiny(tmp_path), "outputs.figures", ["spherical"])
    outputs = {name: value for name, value in content["outputs"].items() if name not in ("store", "runs")}
    names = []
    for folder in (None, "store", "runs"):
        if folder is not None:
            (tmp_path / folder).mkdir()
            (tmp_path / folder / "file").write_text("content")
        names.append(ExperimentStudy(validate({**content, "outputs": outputs}, tmp_path)).folder.name)
    assert len(set(names)) == 1


def test_a_strict_run_has_room_for_what_is_of_other_code(paper):
    """Such a product is in the store, and is made again."""

    def targets(experiment):
        return [eor_of(experiment)]

    empty = fit(paper, 8, "8 GB", targets=targets)
    assert empty[0].simulation.chunks > paper.simulation.chunks
    task, store = eor_of(paper), Store(paper.outputs.store)
    store.prepare()
    with store.building(task.stage.name, task.key) as folder:
        store.seal(folder, {"stage": task.stage.name, "key": task.key, "lineage": "of other code"})
    assert fit(paper, 8, "8 GB", targets=targets) == (paper, 8)
    assert fit(paper, 8, "8 GB", None, True, targets=targets) == empty


def test_what_cannot_fit_is_refused_in_one_sentence(paper):
    with pytest.raises(InputError, match=r"--max-memory leaves 0\.2 GB .*but [\w-]+ \(.+\) needs about \d\.\d GB"):
        fit(paper, None, "1 GB")


def test_free_memory_is_the_default(paper, monkeypatch):
    monkeypatch.setattr(execution, "free_memory", lambda: 1.5e9)
    with pytest.raises(InputError, match=r"this machine has 0\.7 GB"):
        fit(paper, None, None)
    monkeypatch.setattr(execution, "free_memory", lambda: 200e9)
    monkeypatch.setattr(capacity, "cores", lambda: 5)
    assert fit(paper, None, None)[1] == 5


def test_workers_asked_for_without_a_limit_are_given(paper, monkeypatch):
    monkeypatch.setattr(execution, "free_memory", lambda: 6e9)
    assert fit(paper, 16, None)[1] == 16


def test_a_cluster_is_taken_as_it_is(paper, monkeypatch):
    monkeypatch.setattr(execution, "free_memory", lambda: 1)
    assert fit(paper, None, None, "tcp://somewhere:8786") == (paper, 1)


def test_the_number_of_chunks_in_a_file_does_not_change_the_product(tmp_path):
    keys = {
        eor_of(validate(override(tiny(tmp_path), "simulation.chunks", count), tmp_path)).key for count in (1, 2, 16, 32)
    }
    assert len(keys) == 1


@pytest.fixture
def many(tmp_path) -> Experiment:
    """All 128 tiles, with an empty store."""
    changes = ["instrument.layout={kind: mwa-compact}", "instrument.times.count=2", "calibration.chunks=1"]
    return load(EXPERIMENTS / "minredundant.yaml", None, [f"outputs.store={tmp_path / 'store'}", *changes])


def solve_estimate(experiment: Experiment) -> float:
    return max(task.cost.memory for task in tasks_of(experiment) if isinstance(task, CalibrateChunk))


def test_solves_work_on_fewer_models_where_memory_is_short(many):
    plenty, _ = fit(many, 1, "200 GB")
    assert plenty.calibration == many.calibration
    share = solve_estimate(many) - 3e8
    little, _ = fit(many, 1, f"{(share + 0.8e9) / 1e9:.3f} GB")
    assert little.calibration.models_at_once < many.calibration.models_at_once
    assert solve_estimate(little) <= share + 1e6
    assert [task.key for task in targets_of(many)] == [task.key for task in targets_of(little)]
    told = [task.calibration for task in tasks_of(little) if isinstance(task, CalibrateChunk)]
    assert {settings.models_at_once for settings in told} == {little.calibration.models_at_once}


def test_solves_that_cannot_fit_are_refused(many):
    with pytest.raises(InputError, match=r"--max-memory leaves 1\.2 GB .* needs about \d+\.\d GB"):
        fit(many, 1, "2 GB")
