"""What steps and solves of one array take, measured in a process of its own: ``python -m calstudy.bench.step_times``.

Such a process has the number of threads that it was given, and its memory is that of this work alone.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from calstudy.base.errors import InputError
from calstudy.base.resources import Usage, resident_memory
from calstudy.bench.calibration import Clock, clock_of, use_device
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.paper_step import PaperStep
from calstudy.bench.process import run_module
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.settings import BasisSettings
from calstudy.calibrate.solvers.first_order import STEPS_PER_CALL, FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Channels, Layout

PROCESS = "calstudy.bench.step_times"
ROUNDS = 10
"""Into this many rounds the samples of every solver are divided, so that a busy spell of the machine meets all."""
FLOOR_TOLERANCE, FLOOR_STEPS = 1e-5, 200
SETTLED = 0.5
"""Seconds."""


@dataclass(frozen=True)
class Samples:
    """How much is timed.

    Attributes
    ----------
    steps
        Single steps of the paper's solver.
    calls
        Calls of our Adamax, of `STEPS_PER_CALL` steps each, whose mean is one sample.
    solves
        Whole cold solves of the default solver, each with noise of its own.
    """

    steps: int
    calls: int
    solves: int


@dataclass(frozen=True)
class StepTimes:
    """What the solvers take for one array.

    Attributes
    ----------
    antennas, baselines
        Their numbers.
    longest
        Longest baseline, m.
    vectors
        Foreground vectors of the longest baseline, to which the paper pads all others.
    coefficients
        Foreground vectors of all baselines together.
    seconds
        Samples by what was timed: ``paper-step``, ``paper-sum`` (the sum over the basis alone), ``adamax-step``,
        ``default-step``, ``default-solve``; processor seconds of one core, or elapsed seconds on a GPU.
    basis_bytes
        Size of the paper's padded basis.
    paper_memory
        Bytes by which the paper's steps raised the memory of the process.
    """

    antennas: int
    baselines: int
    longest: float
    vectors: int
    coefficients: int
    seconds: dict[str, list[float]]
    basis_bytes: int
    paper_memory: int


@dataclass(frozen=True)
class Descent:
    """How the paper's solver approaches the minimum of one problem.

    Attributes
    ----------
    antennas
        Of the array.
    floor
        Loss at the minimum.
    losses
        Loss before the first step and after each, (Nsteps + 1,), in the same unit.
    """

    antennas: int
    floor: float
    losses: np.ndarray

    def steps_to(self, excess: float) -> int | None:
        """Return after how many steps the loss is first within this fraction above the minimum, or None if never."""
        reached = np.flatnonzero(self.losses <= (1 + excess) * self.floor)
        return int(reached[0]) if reached.size else None


def time_steps_apart(array: Mapping[str, Any], samples: Samples, device: str) -> StepTimes:
    """Time the solvers side by side on one array.

    Parameters
    ----------
    array
        JSON-able sections `layout`, `channels` and `basis`; every baseline has a foreground model of its own.
    samples
        How much is timed.
    device
        ``cpu`` (one core) or ``gpu``.

    Raises
    ------
    InputError
        If the process fails, with the last line that it wrote.
    """
    return StepTimes(**run_module(PROCESS, {"array": dict(array), "samples": asdict(samples), "device": device}))


def descend_apart(array: Mapping[str, Any], max_steps: int) -> Descent:
    """Run the paper's solver, Adamax at a fixed rate of 0.01 from unity, for all of `max_steps` on one array."""
    answer = run_module(PROCESS, {"array": dict(array), "max_steps": max_steps})
    return Descent(**{**answer, "losses": np.array(answer["losses"])})


def make_simulation(layout: Layout, channels: Channels) -> Simulation:
    """Return an array under the bench's sky, with gains and noise, over the given channels."""
    positions = make_layout(layout).enu
    band = channels.count * channels.width
    case = Case(antennas=len(positions), channels=channels.count, first=channels.first, band=band)
    return Simulation(case, positions)


def time_steps(layout: Layout, channels: Channels, basis: BasisSettings, samples: Samples, device: str) -> StepTimes:
    """Time all solvers on one array.

    Parameters
    ----------
    layout, channels, basis
        The array, its channels and the foreground model of every baseline by itself.
    samples
        How much.
    device
        ``cpu`` or ``gpu``.

    Raises
    ------
    InputError
        If there is no such device.
    """
    with use_device(device):
        simulation = make_simulation(layout, channels)
        structure = simulation.structure(basis)
        problem = simulation.problem(0, structure)
        clock = clock_of(device)
        before = resident_memory()
        with Usage() as usage:
            paper = PaperStep(problem)
            _settle(paper.step)
        seconds: dict[str, list[float]] = {}
        for name, sample in _all_samples(simulation, structure, paper, samples, clock):
            seconds.setdefault(name, []).append(sample)
    first, second = structure.antennas.T
    lengths = np.linalg.norm(simulation.positions[second] - simulation.positions[first], axis=1)
    return StepTimes(
        antennas=structure.n_antennas,
        baselines=structure.n_baselines,
        longest=float(lengths.max()),
        vectors=max(bucket.vectors.shape[1] for bucket in structure.basis.buckets),
        coefficients=structure.basis.n_coefficients,
        seconds=seconds,
        basis_bytes=paper.basis_bytes,
        paper_memory=usage.peak_memory - before,
    )


def _settle(call: Callable[[], object]) -> None:
    """Compile a step and run it for long enough that the sampling of memory meets its peak."""
    call()
    end = time.perf_counter() + SETTLED
    call()
    while time.perf_counter() < end:
        call()


def _all_samples(
    simulation: Simulation, structure: FitStructure, paper: PaperStep, samples: Samples, clock: Clock
) -> Iterator[tuple[str, float]]:
    """Yield samples by name, in rounds that each hold some of every kind; what is compiled first is not counted."""
    problem = simulation.problem(0, structure)
    solver = GaussNewton()
    adamax = FirstOrder(Optimizer(max_steps=10**6), tolerance=0.0)
    state = adamax.init(problem)
    for call in (paper.model_sum, lambda: adamax.step(state), lambda: solve(problem, solver)):
        call()
    for number in range(ROUNDS):
        for _ in range(_share(samples.steps, number)):
            yield "paper-step", _seconds(lambda: float(paper.step()), clock)
            yield "paper-sum", _seconds(lambda: [part.numpy() for part in paper.model_sum()], clock)
        for _ in range(_share(samples.calls, number)):
            # Its history, and so this state, is as short at every call.
            yield "adamax-step", _seconds(lambda: adamax.step(state), clock) / STEPS_PER_CALL
        for index in range(_share(samples.solves, number)):
            realization = 1 + number * samples.solves + index
            yield from _solve_in_steps(simulation.problem(0, structure, realization), solver, clock)


def _share(total: int, number: int) -> int:
    """Return how many of `total` samples belong to one of the rounds."""
    return total * (number + 1) // ROUNDS - total * number // ROUNDS


def _seconds(call: Callable[[], object], clock: Clock) -> float:
    start = clock()
    call()
    return clock() - start


def _solve_in_steps(problem: CalibrationProblem, solver: GaussNewton, clock: Clock) -> Iterator[tuple[str, float]]:
    start = clock()
    state = solver.init(problem)
    while solver.terminate(state) is None:
        began = clock()
        state = solver.step(state)
        yield "default-step", clock() - began
    solver.estimate(state)
    yield "default-solve", clock() - start


def descend(layout: Layout, channels: Channels, basis: BasisSettings, max_steps: int) -> Descent:
    """Run the paper's solver, Adamax at a fixed rate of 0.01 from unity, for all of `max_steps`; see `time_steps`.

    Parameters
    ----------
    layout, channels, basis
        Of the simulated array and of the fit.
    max_steps
        Steps that are taken.
    """
    simulation = make_simulation(layout, channels)
    structure = simulation.structure(basis)
    problem = simulation.problem(0, structure)
    floor = min(solve(problem, GaussNewton(FLOOR_TOLERANCE, FLOOR_STEPS)).loss_history)
    history = solve(problem, FirstOrder(Optimizer(max_steps=max_steps), tolerance=0.0)).loss_history
    return Descent(structure.n_antennas, float(floor), history)


def _answer(request: Mapping[str, Any]) -> dict[str, Any]:
    array = request["array"]
    layout = TypeAdapter(Layout).validate_python(array["layout"])
    channels = Channels.model_validate(array["channels"])
    basis = BasisSettings.model_validate(array["basis"])
    if "max_steps" in request:
        found = asdict(descend(layout, channels, basis, request["max_steps"]))
        return {**found, "losses": found["losses"].tolist()}
    return asdict(time_steps(layout, channels, basis, Samples(**request["samples"]), request["device"]))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    try:
        print(json.dumps(_answer(json.loads(sys.argv[1]))))
    except InputError as error:
        sys.exit(str(error))
