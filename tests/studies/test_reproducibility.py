"""The same file and seeds give the same keys and the same arrays, whoever makes them and in whatever pieces."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from pyuvdata import UVCal, UVData
from tiny import tiny

from calstudy.experiment.files import override, validate
from calstudy.products.calibration import calibration
from calstudy.products.corruption import data
from calstudy.products.graph import Graph
from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.store import Product, Store
from calstudy.studies.kinds.experiment import ExperimentStudy

TOLERANCE = 1e-10


def made(folder: Path, workers: int, changes: dict[str, object] | None = None) -> dict[str, Product]:
    """Return the calibration of the tiny study, and its true gains, made in a store of its own."""
    folder.mkdir()
    settings = tiny(folder)
    for path, value in (changes or {}).items():
        settings = override(settings, path, value)
    graph = Graph(validate(settings, folder))
    store = Store(folder / "store")
    store.prepare()
    residual = graph.experiment.variants["residual"]
    targets = {"calibration": calibration(graph, residual, "even"), "data": data(graph, residual, "even")}
    products = execute(schedule(targets.values(), store).todo, store, Workers(workers, folder / "run.log"))
    return {name: products[task.key] for name, task in targets.items()}


def arrays(products: dict[str, Product]) -> dict[str, np.ndarray]:
    calibration = products["calibration"].path
    return {
        "data": UVData.from_file(products["data"].path / "data.uvh5").data_array,
        "gains": UVCal.from_file(calibration / "gains.calh5").gain_array,
        "model": UVData.from_file(calibration / "model.uvh5").data_array,
        "residual": UVData.from_file(calibration / "residual.uvh5").data_array,
    }


def assert_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    for name, values in one.items():
        scale = np.sqrt(np.mean(np.abs(values) ** 2))
        assert scale > 0, name
        assert np.abs(values - other[name]).max() <= TOLERANCE * scale, name


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> dict[str, Product]:
    return made(tmp_path_factory.mktemp("reference") / "study", workers=1)


@pytest.mark.slow
def test_worker_processes_change_nothing(reference, tmp_path):
    other = made(tmp_path / "study", workers=2)
    assert {name: product.record["key"] for name, product in reference.items()} == {
        name: product.record["key"] for name, product in other.items()
    }
    assert_equal(arrays(reference), arrays(other))


@pytest.mark.chain
def test_calibration_chunks_change_nothing_without_warm_starts(tmp_path):
    """With warm starts a chunk's first integration starts from unity: the number of chunks is part of the key."""
    cold = {"calibration.solver": {"name": "gauss-newton", "warm_start": False}}
    whole = made(tmp_path / "whole", 1, {**cold, "calibration.chunks": 1})
    pieces = made(tmp_path / "pieces", 1, {**cold, "calibration.chunks": 2})
    assert whole["calibration"].record["key"] != pieces["calibration"].record["key"]
    assert_equal(arrays(whole), arrays(pieces))


def test_another_process_finds_the_same_keys(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(tiny(tmp_path)))
    code = (
        "import sys; from pathlib import Path; from calstudy.experiment.files import StudyFile; "
        "from calstudy.studies.kinds.experiment import ExperimentStudy; "
        "print(*[task.key for task in ExperimentStudy(StudyFile.open(Path(sys.argv[1])).experiment()).tasks])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONHASHSEED": "12345", "PATH": ""},
    )
    keys = [task.key for task in ExperimentStudy(validate(tiny(tmp_path), tmp_path)).tasks]
    assert found.stdout.split() == keys


def test_keys_do_not_depend_on_where_things_are(tmp_path):
    here, there = (ExperimentStudy(validate(tiny(tmp_path / name), tmp_path)) for name in ("here", "there"))
    assert [task.key for task in here.tasks] == [task.key for task in there.tasks]
    assert here.folder.name == there.folder.name
