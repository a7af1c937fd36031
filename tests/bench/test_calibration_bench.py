"""The calibrator is timed against the paper's solver, and the table has what its rows say."""

from __future__ import annotations

import numpy as np
import pytest
import tensorflow as tf

from calstudy.base.errors import InputError
from calstudy.bench.calibration import adamax_step, clock_of, time_calibrator, use_device
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.paper_step import PaperStep
from calstudy.calibrate.solvers.first_order import FirstOrder, Optimizer
from calstudy.calibrate.solvers.interface import solve

SMALL = Case(antennas=5, channels=96, extent=40.0)


@pytest.mark.parametrize("mode", ["step", "eager_step"])
def test_the_papers_step_and_ours_descend_alike(mode):
    simulation = Simulation(SMALL)
    problem = simulation.problem(0, simulation.structure())
    step = getattr(PaperStep(problem), mode)
    paper = [float(step()) for _ in range(41)]
    ours = solve(problem, FirstOrder(Optimizer(max_steps=50), tolerance=0.0)).loss_history
    ours = ours[:41] / np.mean(np.abs(problem.visibilities) ** 2)
    assert paper[0] == pytest.approx(ours[0], rel=1e-5)
    # The first step goes by the signs of gradients that are rounding, for the start is a minimum in the foregrounds.
    assert np.abs(np.log(paper / ours)).max() < 0.5
    assert paper[40] < 0.5 * paper[0]


def test_cases_drift_and_have_the_noise_they_say():
    simulation = Simulation(SMALL)
    structure = simulation.structure()
    first, later = simulation.foregrounds(0), simulation.foregrounds(20)
    change = np.linalg.norm(later - first) / np.linalg.norm(first)
    assert 1e-3 < change < 0.5
    even, odd = (simulation.problem(0, structure, realization).visibilities for realization in (0, 1))
    noise = np.sqrt(np.mean(np.abs(even - odd) ** 2) / 2) / np.sqrt(np.mean(np.abs(even) ** 2))
    assert noise == pytest.approx(SMALL.noise, rel=0.1)
    lengths = np.linalg.norm(np.ptp(simulation.positions[:2], axis=0))
    assert lengths == pytest.approx(40.0)


def test_the_table_has_every_ratio():
    rows = {row.name: row for row in time_calibrator(SMALL, 2, 50)}
    assert "not in 50" in (rows["Adamax 0.01, steps to 0.2 % above the minimum"].value)
    assert rows["that over the default solver, to 0.2 %"].value.startswith("at least")
    assert rows["2 integrations"].note.endswith("converged")
    assert rows["default solver, cold"].value.endswith("CPU s")
    for mode in ("graph", "without a graph"):
        assert rows[f"Adamax step, paper-style {mode}"].note.endswith("x ours")


def test_steps_run_in_the_context_of_a_gpu(monkeypatch):
    """There is no GPU here: with soft placement TensorFlow puts on the processor what the code asks a GPU for."""
    monkeypatch.setattr("tensorflow.config.list_physical_devices", lambda kind: [kind])
    placement = tf.config.get_soft_device_placement()
    tf.config.set_soft_device_placement(True)
    try:
        with use_device("gpu"):
            simulation = Simulation(SMALL)
            problem = simulation.problem(0, simulation.structure())
            step = PaperStep(problem).step
            first = float(step())
            assert float(step()) < first
            assert adamax_step(problem, clock_of("gpu")) > 0
    finally:
        tf.config.set_soft_device_placement(placement)


def test_a_missing_device_is_a_sentence(monkeypatch):
    monkeypatch.setattr("tensorflow.config.list_physical_devices", lambda kind: [])
    with pytest.raises(InputError, match="finds no GPU"):
        use_device("gpu")
    with pytest.raises(InputError, match="not a device"):
        use_device("tpu")
