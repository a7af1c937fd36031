"""The number of workers does not change the visibilities, that of chunks by less than the tolerance of the nodes.

Chunks have patches of the sky and blocks of channels of their own, with their own errors of interpolation and rounding.
"""

from pathlib import Path

import numpy as np
import pytest
from pyuvdata import UVData
from tiny import tiny

from calstudy.experiment.files import override, validate
from calstudy.products.graph import Graph
from calstudy.products.simulation import eor, foregrounds
from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.store import Store
from calstudy.simulate.settings import Nodes

pytestmark = pytest.mark.chain


def visibilities(folder: Path, chunks: int, workers: int) -> list[np.ndarray]:
    """Return F and S of the tiny study."""
    folder.mkdir()
    graph = Graph(validate(override(tiny(folder), "simulation.chunks", chunks), folder))
    store = Store(folder / "store")
    store.prepare()
    targets = [foregrounds(graph), eor(graph)]
    products = execute(schedule(targets, store).todo, store, Workers(workers, folder / "run.log"))
    return [UVData.from_file(products[task.key].path / "visibilities.uvh5").data_array for task in targets]


def largest_difference(one: np.ndarray, other: np.ndarray) -> float:
    rms = np.sqrt(np.mean(np.abs(one) ** 2))
    assert rms > 0
    return np.abs(one - other).max() / rms


def test_workers_change_nothing_and_chunks_little(tmp_path):
    whole = visibilities(tmp_path / "whole", chunks=1, workers=1)
    pieces = visibilities(tmp_path / "pieces", chunks=9, workers=1)
    parallel = visibilities(tmp_path / "parallel", chunks=9, workers=2)
    for one, other in zip(pieces, parallel, strict=True):
        assert np.array_equal(one, other)
    foregrounds_change, eor_change = (largest_difference(*pair) for pair in zip(whole, pieces, strict=True))
    nodes = Nodes()
    assert foregrounds_change < nodes.tolerance
    assert eor_change < 0.1 * nodes.eor_tolerance
