"""How fast the calibrator is, against the paper's solver, all in one run on one machine."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple

import numpy as np
import tensorflow as tf

from calstudy.base.errors import InputError
from calstudy.base.resources import Usage, free_memory
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.paper_step import PaperStep, padded_memory
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solution import Solution
from calstudy.calibrate.solvers.first_order import STEPS_PER_CALL, FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solver, solve, solve_warm

ABOVE_FLOOR = 1.002
FLOOR_TOLERANCE = 1e-5
PAPER_STEPS, ADAMAX_CALLS = 30, 10
HEADINGS = ("what", "measured", "note")


class Row(NamedTuple):
    """One line of the table: what was measured, its value, and what it is held against."""

    name: str
    value: str
    note: str = ""


def use_device(device: str) -> AbstractContextManager:
    """Return the context in which TensorFlow works on a device, ``cpu`` or ``gpu``.

    Raises
    ------
    InputError
        If there is no GPU, or the device is neither.
    """
    if device not in ("cpu", "gpu"):
        raise InputError(f"--device {device}: not a device (allowed: cpu, gpu)")
    if device == "gpu" and not tf.config.list_physical_devices("GPU"):
        raise InputError("--device gpu: TensorFlow finds no GPU on this machine; use --device cpu")
    return tf.device("/GPU:0") if device == "gpu" else nullcontext()


Clock = Callable[[], float]


def clock_of(device: str) -> Clock:
    """Return processor time for the CPU, which other work on the machine does not stretch, elapsed time for a GPU."""
    return time.process_time if device == "cpu" else time.perf_counter


def program_clock_of(device: str) -> Clock:
    """Return the same without the operating system's share, which is known to a few milliseconds only.

    What it takes to hand out fresh pages for the large temporaries of the paper's step changes from day to day, from a
    fifth of their arithmetic to three times as much.
    """
    return (lambda: resource.getrusage(resource.RUSAGE_SELF).ru_utime) if device == "cpu" else time.perf_counter


def unit_of(device: str) -> str:
    """Return the unit of both clocks."""
    return "CPU s" if device == "cpu" else "s"


def mean_seconds(call: Callable[[], object], count: int, clock: Clock) -> float:
    """Return the mean time of a call after one that is not counted.

    Parameters
    ----------
    call
        Without arguments.
    count
        Calls that are averaged over.
    clock
        Returns seconds.
    """
    call()
    start = clock()
    for _ in range(count):
        call()
    return (clock() - start) / count


def adamax_step(problem: CalibrationProblem, clock: Clock) -> float:
    """Return the seconds of one step of our Adamax, single precision, mean over compiled calls."""
    solver = FirstOrder(Optimizer(max_steps=100 * STEPS_PER_CALL), tolerance=0.0)
    state = solver.init(problem)
    return mean_seconds(lambda: solver.step(state), ADAMAX_CALLS, clock) / STEPS_PER_CALL


def steps_to(problem: CalibrationProblem, loss: float, max_steps: int) -> int | None:
    """Return after how many steps the paper's Adamax, fixed rate and single precision, first has a loss this low.

    Parameters
    ----------
    problem
        What is solved.
    loss
        That is to be reached, in the unit of the solver's loss history.
    max_steps
        After which it gives up.

    Returns
    -------
    None if the loss is not reached.
    """
    history = solve(problem, FirstOrder(Optimizer(max_steps=max_steps), tolerance=0.0)).loss_history
    reached = np.flatnonzero(history <= loss)
    return int(reached[0]) if reached.size else None


def time_calibrator(case: Case, integrations: int, adamax_steps: int, device: str = "cpu") -> list[Row]:
    """Time steps and solves.

    Parameters
    ----------
    case
        The size of the problem.
    integrations
        Length of the series that is solved, each from the one before.
    adamax_steps
        How long the paper's Adamax is given to come within 0.2 % of the minimum; 0 leaves it out.
    device
        ``cpu`` or ``gpu``.

    Returns
    -------
    The table, row by row.

    Raises
    ------
    InputError
        If there is no such device.
    """
    with use_device(device):
        simulation = Simulation(case)
        structure = simulation.structure()
        problems = [simulation.problem(index, structure) for index in range(max(integrations, 1))]
        solver, clock = GaussNewton(), clock_of(device)
        start = clock()
        solve(problems[0], solver)
        compiling = clock() - start
        with Usage() as usage:
            cold, cold_seconds = _cold(problems[0], solver, clock)
        unit = unit_of(device)
        rows = [
            Row("problem", f"{case.antennas} antennas, {structure.n_baselines} baselines, {case.channels} channels"),
            Row("default solver, first solve with compilation", f"{compiling:.2f} {unit}"),
            Row("default solver, cold", f"{cold_seconds:.2f} {unit}", f"{cold.n_steps} steps, {cold.status}"),
            Row("peak memory of the process", f"{usage.peak_memory / 1e9:.1f} GB"),
        ]
        rows += _series(problems, solver, clock, unit)
        return rows + _against_paper(problems[0], cold, adamax_steps, device)


def _cold(problem: CalibrationProblem, solver: Solver, clock: Clock) -> tuple[Solution, float]:
    """Return a cold solve and the best of three times."""
    seconds = []
    for _ in range(3):
        start = clock()
        solution = solve(problem, solver)
        seconds.append(clock() - start)
    return solution, min(seconds)


def _close(problem: CalibrationProblem, loss: float, clock: Clock) -> tuple[float, int]:
    """Return the best of three times in which the default solver, cold, has a loss this low, and its steps."""
    solver, seconds = GaussNewton(FLOOR_TOLERANCE, 200), []
    for _ in range(3):
        start = clock()
        state = solver.init(problem)
        while solver.losses(state)[-1] > loss and solver.terminate(state) is None:
            state = solver.step(state)
        seconds.append(clock() - start)
    return min(seconds), len(solver.losses(state)) - 1


def _series(problems: list[CalibrationProblem], solver: Solver, clock: Clock, unit: str) -> list[Row]:
    """Solve consecutive integrations, each from the one before."""
    warm, seconds, converged = None, [], 0
    for problem in problems:
        start = clock()
        solution, warm = solve_warm(problem, solver, warm)
        seconds.append(clock() - start)
        converged += solution.status == "converged"
    rows = [Row(f"{len(problems)} integrations", f"{sum(seconds):.1f} {unit}", f"{converged} converged")]
    if len(seconds) > 1:
        rows.append(Row("default solver, warm, median", f"{statistics.median(seconds[1:]):.3f} {unit}"))
    return rows


def _against_paper(problem: CalibrationProblem, cold: Solution, adamax_steps: int, device: str) -> list[Row]:
    clock, unit = program_clock_of(device), unit_of(device)
    floor = min(solve(problem, GaussNewton(FLOOR_TOLERANCE, 200)).loss_history)
    above = cold.loss_history[-1] / floor - 1
    close_seconds, close_steps = _close(problem, ABOVE_FLOOR * floor, clock_of(device))
    rows = [
        Row("default solver, loss above the minimum", f"{100 * above:.3f} %"),
        Row("the same solver, to 0.2 % above the minimum", f"{close_seconds:.2f} {unit}", f"{close_steps} steps"),
    ]
    ours = adamax_step(problem, clock)
    rows.append(Row("Adamax step, ours", f"{1e3 * ours:.2f} ms"))
    if padded_memory(problem) > 0.8 * free_memory():
        needed = padded_memory(problem) / 1e9
        return [*rows, Row("Adamax step, paper-style", "not run", f"needs {needed:.0f} GB")]
    paper_step = PaperStep(problem)
    # The loss is looked at, for a GPU returns before it has finished.
    paper = mean_seconds(lambda: float(paper_step.step()), PAPER_STEPS, clock)
    rows.append(Row("Adamax step, paper-style graph", f"{1e3 * paper:.1f} ms", f"{paper / ours:.1f} x ours"))
    eager = mean_seconds(lambda: float(paper_step.eager_step()), PAPER_STEPS, clock)
    rows.append(Row("Adamax step, paper-style without a graph", f"{1e3 * eager:.1f} ms", f"{eager / ours:.1f} x ours"))
    if adamax_steps == 0:
        return rows
    steps = steps_to(problem, ABOVE_FLOOR * floor, adamax_steps)
    counted = steps or adamax_steps
    bound = "" if steps else "at least "
    rows.append(Row("Adamax 0.01, steps to 0.2 % above the minimum", f"{steps}" if steps else f"not in {adamax_steps}"))
    rows.append(Row("Adamax 0.01, paper-style, to 0.2 %", f"{bound}{counted * paper:.0f} {unit}"))
    rows.append(Row("that over the default solver, to 0.2 %", f"{bound}{counted * paper / close_seconds:.0f}"))
    return rows
