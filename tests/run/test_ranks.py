"""Several MPI ranks: the same results as one process, one voice, and never a rank left waiting."""

import copy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from pyuvdata import UVData
from tiny import tiny

from calstudy.experiment.files import validate
from calstudy.products.graph import Graph
from calstudy.products.simulation import eor, foregrounds
from calstudy.run.perform import WorkOrder, perform
from calstudy.run.store import Store
from calstudy.run.task import unique

MPIEXEC = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or "mpiexec"
PROGRAM = """
import sys
from calstudy.base import ranks
from calstudy.base.errors import InputError
from ranks_example import {work} as work
if ranks.is_helper():
    ranks.serve()
    sys.exit()
with ranks.leading():
    try:
        print(ranks.share(work, 10), flush=True)
    except InputError as error:
        print("refused:", error, flush=True)
    print("on", flush=True)
"""
EXAMPLE = """
from calstudy.base.errors import InputError

def places(rank, size, first):
    return first + rank, size

def refuses(rank, size, first):
    if rank == 1:
        raise InputError(f"rank {rank} has no {first}")
    return first

def breaks(rank, size, first):
    if rank == 1:
        raise ValueError("a defect")
    return first
"""


def mpiexec(*arguments: str, cwd: Path, ranks: int = 2) -> subprocess.CompletedProcess:
    command = [MPIEXEC, "-n", str(ranks), sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False, timeout=240)


def share(work: str, folder: Path, ranks: int = 2) -> subprocess.CompletedProcess:
    (folder / "ranks_example.py").write_text(EXAMPLE)
    (folder / "program.py").write_text(PROGRAM.format(work=work))
    return mpiexec("program.py", cwd=folder, ranks=ranks)


def study(folder: Path) -> dict:
    data = copy.deepcopy(tiny(folder))
    data["sky"]["foregrounds"]["count"] = 20
    data["simulation"]["engine"] = "pyuvsim"
    data["outputs"]["figures"] = ["layout"]
    data["variants"] = {name: {"components": [name]} for name in ("foregrounds", "eor")}
    return data


def test_what_the_ranks_return_comes_in_their_order(tmp_path):
    result = share("places", tmp_path, ranks=3)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == ["[(10, 3), (11, 3), (12, 3)]", "on"]


def test_a_refusal_on_any_rank_is_told_by_the_first_and_ends_nothing(tmp_path):
    result = share("refuses", tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == ["refused: rank 1 has no 10", "on"]


def test_a_defect_on_any_rank_ends_all(tmp_path):
    result = share("breaks", tmp_path)
    assert result.returncode != 0
    assert "ValueError: a defect" in result.stderr
    assert "on" not in result.stdout.splitlines()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run", "none.yaml"], "none.yaml: cannot be read"),
        (["run", "tiny.yaml", "--set", "simulation.engine=dense"], "does not share its work between MPI ranks"),
        (["run", "tiny.yaml", "--scheduler", "tcp://127.0.0.1:1"], "under mpiexec the ranks are the workers"),
    ],
)
def test_a_mistake_is_told_once(tmp_path, arguments, told):
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(study(tmp_path)))
    result = mpiexec("-m", "calstudy", *arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.count("calstudy: ") == 1
    assert told in result.stderr
    assert "Traceback" not in result.stderr


def test_a_run_on_two_ranks_has_the_visibilities_of_a_serial_one(tmp_path):
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(study(tmp_path)))
    result = mpiexec("-m", "calstudy", "run", "tiny.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    graph = Graph(validate(study(tmp_path), tmp_path))
    parallel, serial = Store(tmp_path / "store"), Store(tmp_path / "serial")
    serial.prepare()
    targets = [foregrounds(graph), eor(graph)]
    for task in unique(targets):
        perform(WorkOrder.of(task, serial))
    for task in targets:
        cubes = [
            UVData.from_file(store.find(task.stage.name, task.key).path / "visibilities.uvh5").data_array
            for store in (parallel, serial)
        ]
        assert np.abs(cubes[1]).min() > 0
        # The ranks may add up the sources in another order: the same to rounding, as between chunks.
        assert np.abs(cubes[0] - cubes[1]).max() < 1e-12 * np.sqrt(np.mean(np.abs(cubes[1]) ** 2))
