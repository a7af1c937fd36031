"""Slow checks: the whole sky, all 36 tiles, several processes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulation_cases import observe, random_sky, relative_error

from calstudy.instrument.telescope import subset_template
from calstudy.simulate.dense import DenseEngine
from calstudy.simulate.reference import PyuvsimEngine
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources

RANKS_PROGRAM = """
import sys
import numpy as np
from simulation_cases import observe, random_sky
from calstudy.instrument import settings
from calstudy.instrument.beams import make_beam
from calstudy.simulate.reference import PyuvsimEngine
template = observe()
beam = make_beam(settings.MwaAnalyticBeam(kind="mwa-analytic"))
cube = PyuvsimEngine().simulate(random_sky(template), beam, template)
from mpi4py import MPI
np.save(f"{sys.argv[1]}/{MPI.COMM_WORLD.rank}.npy", cube)
assert MPI.COMM_WORLD.size == 2
"""


@pytest.mark.slow
def test_the_dense_engine_agrees_with_pyuvsim_on_the_whole_default_sky(embedded_beam):
    template = observe(count=36, channels=2, width="20 MHz", times=2, integration="110 s", polarizations=("xx",))
    sky = make_foregrounds(SyntheticSources(), template.freq_array).sky
    assert sky.Ncomponents > 200_000
    for time, frequency in zip(template.time_array[:: template.Nbls], template.freq_array, strict=True):
        slot = subset_template(template, np.array([time]), np.array([frequency]))
        expected = PyuvsimEngine().simulate(sky, embedded_beam, slot)
        assert relative_error(DenseEngine().simulate(sky, embedded_beam, slot), expected) < 1e-10


@pytest.mark.slow
def test_ranks_of_mpiexec_share_the_work_and_all_get_the_same_bits(tmp_path, tile_beam):
    template = observe()
    serial = PyuvsimEngine().simulate(random_sky(template), tile_beam, template)
    launcher = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or "mpiexec"
    command = [launcher, "-n", "2", sys.executable, "-c", RANKS_PROGRAM, str(tmp_path)]
    subprocess.run(command, check=True, timeout=300, cwd=Path(__file__).parent)
    for rank in (0, 1):
        np.testing.assert_array_equal(np.load(tmp_path / f"{rank}.npy"), serial)
