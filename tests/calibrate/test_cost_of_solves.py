"""What solves took, as their records say: processor time apart from wall time, and unknown where nobody wrote it."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
from toy_data import SETTINGS, make_uvdata, sky_of

from calstudy.base.resources import Usage
from calstudy.calibrate.calibrators.other_packages import Skycal
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Calibration, Calibrator, Solve
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.products.calibration import read_result
from calstudy.products.files import GAINS, MODEL, RESIDUAL, SOLUTION, write_json, write_visibilities
from calstudy.products.score import cpu_seconds_per_integration

BUSY = "import time\nwhile time.process_time() < {}: pass"
"""A program that computes for some processor seconds."""
PAUSE = 0.5
"""Seconds of sleep: far more than the processor time of what is done around it here, which is some 10 ms."""


def compute(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_processor_time_is_that_of_the_process_and_of_programs_it_waited_for():
    with Usage() as asleep:
        time.sleep(PAUSE)
    assert asleep.seconds >= PAUSE
    assert asleep.cpu_seconds < PAUSE / 2
    with Usage() as usage:
        compute(0.2)
        subprocess.run([sys.executable, "-c", BUSY.format(0.4)], check=True)
    # Programs are counted in steps of 10 ms, at the start and at the end; a start of Python takes far below a second.
    assert 0.6 - 0.02 <= usage.cpu_seconds < 1.6


class Idle(Calibrator):
    """Gains of one, after a pause and some work of a program."""

    own: float | None = None

    def calibrate(self, observation, assumed, progress=None):
        time.sleep(PAUSE)
        subprocess.run([sys.executable, "-c", BUSY.format(0.3)], check=True)
        shape = (observation.n_antennas, observation.n_channels, observation.n_times, observation.n_polarizations)
        outcome = Solve(status="converged", message="nothing was fitted", cpu_seconds=self.own)
        return Calibration(gains=np.ones(shape, complex), outcomes=outcome)


def test_solves_without_times_of_their_own_share_those_of_the_whole(toy):
    uvd = make_uvdata(toy, 3)
    sky = sky_of(uvd, toy.foregrounds)
    records = run_calibrator(Idle(), uvd, sky).solutions
    assert len({record.cpu_seconds for record in records}) == 1
    assert 0.3 - 0.02 <= sum(record.cpu_seconds for record in records) < sum(record.seconds for record in records)
    own = run_calibrator(Idle(own=12.5), uvd, sky).solutions
    assert [record.cpu_seconds for record in own] == [12.5] * 3


class Pausing(GaussNewton):
    """Gauss-Newton with a pause before every step."""

    def step(self, state):
        time.sleep(PAUSE)
        return super().step(state)


def test_the_processor_does_not_work_while_a_solver_waits(toy):
    problem = toy.problem()
    solve(problem, GaussNewton())  # Compiles.
    solution = solve(problem, Pausing())
    assert solution.record.steps > 0
    assert solution.record.seconds >= PAUSE * solution.record.steps
    assert 0 < solution.record.cpu_seconds < solution.record.seconds / 2


@pytest.mark.parametrize("calibrator", [SETTINGS, Skycal()], ids=["calamity", "skycal"])
def test_records_add_up_to_at_most_the_whole_and_skipped_solves_took_nothing(calibrator, toy):
    uvd = make_uvdata(toy, 3)
    uvd.flag_array[uvd.Nbls : 2 * uvd.Nbls] = True
    with Usage() as usage:
        records = run_calibrator(calibrator, uvd, sky_of(uvd, toy.foregrounds)).solutions
    assert [record.status for record in records] == ["converged", "skipped", "converged"]
    assert records[1].cpu_seconds == records[1].seconds == 0
    assert records[0].cpu_seconds > 0
    assert sum(record.cpu_seconds for record in records) <= usage.cpu_seconds
    assert [record.summary()["cpu_seconds"] for record in records] == [record.cpu_seconds for record in records]


def test_records_of_earlier_versions_are_read_and_do_not_tell(toy, tmp_path):
    result = run_calibrator(SETTINGS, make_uvdata(toy, 2))
    product = tmp_path / "product"
    product.mkdir()
    result.gains.write_calh5(product / GAINS)
    for name, uvd in ((MODEL, result.model), (RESIDUAL, result.residual)):
        write_visibilities(uvd, product / name)
    write_json(product / SOLUTION, {"records": result.summary()["records"]})
    known = [record.cpu_seconds for record in result.solutions]
    found = read_result(product).solutions
    assert [record.cpu_seconds for record in found] == known
    for record, same in zip(result.solutions, found, strict=True):
        np.testing.assert_array_equal(same.loss_history, record.loss_history)

    content = json.loads((product / SOLUTION).read_text())
    for record in content["records"]:
        del record["cpu_seconds"], record["loss_history"]
    (product / SOLUTION).write_text(json.dumps(content))
    found = read_result(product).solutions
    assert [record.cpu_seconds for record in found] == [None, None]
    assert [record.seconds for record in found] == [record.seconds for record in result.solutions]
    assert [len(record.loss_history) for record in found] == [2, 2]


def record(cpu_seconds, status="converged", polarization=-5, n_integrations=1):
    return {
        "status": status,
        "polarization": polarization,
        "n_integrations": n_integrations,
        "cpu_seconds": cpu_seconds,
    }


def test_an_integration_costs_the_median_of_all_solves_times_the_polarizations():
    first, *others = [record(100.0), *(record(value) for value in (1.0, 2.0, 3.0))]
    assert cpu_seconds_per_integration([first, *others]) == 2.5
    assert cpu_seconds_per_integration([first, *others, record(0.0, "skipped")]) == 2.5
    # Two integrations together, two polarizations each by itself.
    both = [record(value, polarization=p, n_integrations=2) for p in (-5, -6) for value in (8.0, 8.0, 90.0)]
    assert cpu_seconds_per_integration(both) == 8.0
    assert cpu_seconds_per_integration([record(0.0, "skipped")]) is None
    assert cpu_seconds_per_integration([*others, record(None)]) is None
    old = {name: value for name, value in first.items() if name != "cpu_seconds"}
    assert cpu_seconds_per_integration([*others, old]) is None
