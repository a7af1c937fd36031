"""The paper's step and ours are timed on the same problem, as often as asked, on the device asked for."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from calstudy.base.errors import InputError
from calstudy.base.tensorflow import tf
from calstudy.calibrate.settings import BasisSettings
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.array_layouts.geometric import LinearLayout
from calstudy.instrument.settings import Channels
from calstudy.products.run_times import TimedArray, measured_apart, steps_to
from calstudy.products.step_times import PaperStep, descend, make_simulation, time_steps

CHANNELS = Channels(first="120.3 MHz", width="600 kHz", count=100)
LINE = LinearLayout(kind="linear", count=4, spacing="33 m")
ARRAY = TimedArray(layout=LINE, channels=CHANNELS, basis=BasisSettings())


@pytest.mark.chain
def test_every_solver_is_timed_as_often_as_asked():
    found = time_steps(ARRAY, {"steps": 13, "calls": 3, "solves": 2}, "cpu")
    counts = {name: len(samples) for name, samples in found["seconds"].items()}
    steps = counts.pop("default-step")
    assert counts == {"paper-step": 13, "paper-sum": 13, "adamax-step": 3, "default-solve": 2}
    assert steps > 2
    assert min(min(samples) for samples in found["seconds"].values()) > 0
    assert sum(found["seconds"]["default-solve"]) > sum(found["seconds"]["default-step"])
    # A step holds the sum and its gradient. The shortest of all samples is that with the least of the machine in it.
    assert min(found["seconds"]["paper-step"]) > min(found["seconds"]["paper-sum"])
    assert (found["antennas"], found["baselines"]) == (4, 6)
    assert found["longest"] == pytest.approx(99.0)
    # 380 ns on either side over 60 MHz, and some more until the sequences leave the band.
    assert 46 < found["vectors"] < 62
    assert found["vectors"] < found["coefficients"] < 6 * found["vectors"]
    assert found["basis_bytes"] == 4 * found["vectors"] * 6 * 100


@pytest.mark.chain
def test_the_papers_step_and_ours_descend_alike():
    simulation = Simulation(Case(antennas=5, channels=96, extent=40.0))
    problem = simulation.problem(0, simulation.structure(), 0)
    step = PaperStep(problem).step
    paper = [float(step()) for _ in range(41)]
    ours = solve(problem, Adamax(max_steps=50, tolerance=0.0)).record.loss_history
    ours = ours[:41] / np.mean(np.abs(problem.visibilities) ** 2)
    assert paper[0] == pytest.approx(ours[0], rel=1e-5)
    # The first step goes by the signs of gradients that are rounding, for the start is a minimum in the foregrounds.
    assert np.abs(np.log(paper / ours)).max() < 0.5
    assert paper[40] < 0.5 * paper[0]


@pytest.mark.chain
def test_solvers_are_timed_on_a_gpu():
    """Without a GPU, TensorFlow with soft placement uses the processor for what the code requests of a GPU."""
    placement = tf.config.get_soft_device_placement()
    tf.config.set_soft_device_placement(True)
    try:
        found = time_steps(ARRAY, {"steps": 2, "calls": 1, "solves": 1}, "gpu")
    finally:
        tf.config.set_soft_device_placement(placement)
    assert min(min(samples) for samples in found["seconds"].values()) > 0


def test_a_descent_is_counted_from_its_losses():
    losses = np.array([5.0, 1.2, 1.04, 1.06, 1.005])
    assert [steps_to(losses, 1.0, excess) for excess in (0.05, 0.01, 0.001)] == [2, 4, None]


@pytest.mark.chain
def test_the_papers_descent_comes_close_to_the_minimum():
    found = descend(ARRAY, 500)
    losses, floor = np.array(found["losses"]), found["floor"]
    assert losses.size == 501
    assert losses[0] > 100 * floor
    assert floor < losses.min() < 2 * losses[-1]
    assert steps_to(losses, floor, 1e9) == 0


def test_the_sky_is_seen_over_the_given_band():
    simulation = make_simulation(LINE, CHANNELS)
    assert simulation.case.frequencies[[0, -1]] == pytest.approx([120.3e6, 179.7e6])
    assert simulation.positions.shape == (4, 3)
    assert np.ptp(simulation.positions[:, 0]) == pytest.approx(99.0)


def test_a_process_that_fails_says_why(monkeypatch):
    failed = subprocess.CompletedProcess([], 1, stdout="", stderr="noise\n--device gpu: no GPU\n")
    asked = []

    def run(command, **options):
        asked.append((command, options["env"]["OMP_NUM_THREADS"]))
        return failed

    monkeypatch.setattr(subprocess, "run", run)
    samples = {"steps": 1, "calls": 2, "solves": 3}
    with pytest.raises(InputError, match="failed: --device gpu: no GPU"):
        measured_apart(ARRAY, samples=samples, device="gpu")
    ((command, threads),) = asked
    assert (command[0], threads) == (sys.executable, "1")
    asked_for = {"array": ARRAY.model_dump(mode="json"), "samples": samples, "device": "gpu"}
    assert json.loads(command[-1]) == asked_for
