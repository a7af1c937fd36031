"""Neither the number of chunks nor that of workers changes the visibilities, to 1e-12 of their rms."""

from pathlib import Path

import numpy as np
from pyuvdata import UVData
from tiny import tiny

from calstudy.experiment.files import override, validate
from calstudy.products.graph import Graph
from calstudy.products.simulation import eor, foregrounds
from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.store import Store


def visibilities(folder: Path, chunks: int, workers: int) -> list[np.ndarray]:
    """Return F and S of the tiny study."""
    folder.mkdir()
    graph = Graph(validate(override(tiny(folder), "simulation.chunks", chunks), folder))
    store = Store(folder / "store")
    store.prepare()
    targets = [foregrounds(graph), eor(graph)]
    products = execute(schedule(targets, store).todo, store, Workers(workers, folder / "run.log"))
    return [UVData.from_file(products[task.key].path / "visibilities.uvh5").data_array for task in targets]


def test_chunks_and_workers_change_nothing(tmp_path):
    whole = visibilities(tmp_path / "whole", chunks=1, workers=1)
    pieces = visibilities(tmp_path / "pieces", chunks=5, workers=2)
    for one, other in zip(whole, pieces, strict=True):
        rms = np.sqrt(np.mean(np.abs(one) ** 2))
        assert rms > 0
        assert np.abs(one - other).max() < 1e-12 * rms
