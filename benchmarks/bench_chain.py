"""Processor time of the parts of a study, at fixed sizes; README.md says how to run and compare them.

A benchmark whose work changes gets another name, so that results of one name can always be compared.
"""

from __future__ import annotations

import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter
from pytest_benchmark.fixture import BenchmarkFixture

from calstudy.base.resources import cpu_time
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solution, WarmStart, solve_warm
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Layout
from calstudy.studies.load import load_study

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
SOLVER = GaussNewton()

# Processor time, of subprocesses as well. Elapsed time would contain other work on the machine.
pytestmark = pytest.mark.benchmark(timer=cpu_time)


def problems(layout: str, antennas: int, integrations: int) -> list[CalibrationProblem]:
    """Return consecutive integrations of one of the paper's arrays: 384 channels, gain errors of 0.1, noise of 1e-3."""
    positions = make_layout(TypeAdapter(Layout).validate_python({"kind": layout})).enu
    simulation = Simulation(Case(antennas=antennas), positions)
    structure = simulation.structure()
    return [simulation.problem(index, structure) for index in range(integrations)]


def solve_all(series: list[CalibrationProblem]) -> list[Solution]:
    """Solve the first integration from unity gains, and every other from the one before."""
    start: WarmStart | None = None
    solutions = []
    for problem in series:
        solution, start = solve_warm(problem, SOLVER, start)
        solutions.append(solution)
    return solutions


def note(benchmark: BenchmarkFixture, solutions: list[Solution]) -> None:
    """Save steps and statuses with the times: a solver may be slower by more steps, or by longer ones."""
    benchmark.extra_info["steps"] = [solution.record.steps for solution in solutions]
    benchmark.extra_info["status"] = [solution.record.status for solution in solutions]


def measure_chunk(benchmark: BenchmarkFixture, label: str, folder: Path) -> None:
    """Make one piece of a simulated component of the paper's main study, twice."""
    study = load_study(EXPERIMENTS / "minredundant.yaml")
    task = next(task for task in study.tasks if task.label == label)
    numbers = count()

    def new_folder() -> tuple[tuple[Path], dict[str, Any]]:
        output = folder / str(next(numbers))
        output.mkdir()
        return (output,), {}

    benchmark.pedantic(task.make, setup=new_folder, rounds=2)


def bench_foreground_part(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """One of four parts of F: a quarter of the default sky above 50 mJy, at all 94 frequency nodes."""
    measure_chunk(benchmark, "foregrounds 1/4", tmp_path)


def bench_eor_chunk(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """One of 16 pieces of S: 24 of 384 channels, nside 256."""
    measure_chunk(benchmark, "eor 1/16", tmp_path)


def bench_cold_solve(benchmark: BenchmarkFixture) -> None:
    """One integration of the paper's array from unity gains, without compilation."""
    series = problems("mwa-compact-minredundant", 36, 1)
    note(benchmark, benchmark.pedantic(solve_all, (series,), rounds=5, warmup_rounds=1))


def bench_warm_solve(benchmark: BenchmarkFixture) -> None:
    """One integration of the paper's array from the solution of the one before, without compilation."""
    first, second = problems("mwa-compact-minredundant", 36, 2)
    start = solve_warm(first, SOLVER, None)[1]
    solution, _ = benchmark.pedantic(solve_warm, (second, SOLVER, start), rounds=20, warmup_rounds=1)
    note(benchmark, [solution])


def bench_128_tiles(benchmark: BenchmarkFixture) -> None:
    """Two integrations of the 128 tiles of the compact array, from unity and then warm, with compilation."""
    series = problems("mwa-compact", 128, 2)
    note(benchmark, benchmark.pedantic(solve_all, (series,), rounds=1))


def bench_quickstart(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """Run the quickstart as a command, from imports to the report, with an empty store and one worker."""
    command = [sys.executable, "-m", "calstudy", "run", str(EXPERIMENTS / "quickstart.yaml"), "--workers", "1"]
    places = ["--set", f"outputs.store={tmp_path / 'store'}", "--set", f"outputs.runs={tmp_path / 'runs'}"]
    options = {"check": True, "capture_output": True, "cwd": ROOT}
    benchmark.pedantic(subprocess.run, ([*command, *places],), options, rounds=1)
