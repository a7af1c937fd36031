"""How much memory and time one solve takes as arrays grow, held against what the plan says.

Each solve runs in a process of its own, ``python -m calstudy.bench.solve_memory REQUEST``.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from calstudy.base.errors import InputError
from calstudy.base.resources import Usage
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.process import run_module
from calstudy.calibrate.calibrators.calamity import Calamity
from calstudy.calibrate.cost import Dimensions, fit_models_at_once, solve_memory
from calstudy.calibrate.settings import GainFit
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve

HEADINGS = ("antennas", "baselines", "at a time", "planned", "measured", "CPU s", "steps")


@dataclass(frozen=True)
class SolveSize:
    """One cold solve of the default solver.

    Attributes
    ----------
    antennas, baselines
        Their numbers.
    models_at_once
        Baselines that were worked on at a time.
    planned, measured
        Peak memory of the process, libraries included, bytes.
    cpu_seconds
        Of the solve, compilation included.
    n_steps, status
        Gauss-Newton steps, and how it ended.
    """

    antennas: int
    baselines: int
    models_at_once: int
    planned: float
    measured: float
    cpu_seconds: float
    n_steps: int
    status: str


def plan_solve(antennas: int, channels: int, budget: float) -> tuple[GainFit, float]:
    """Return settings that fit a solve into the memory, and the memory that it is planned to take.

    Parameters
    ----------
    antennas, channels
        Of the bench's array (`calstudy.bench.calibration_case.Case`).
    budget
        Bytes.

    Raises
    ------
    InputError
        If it does not fit, however few baselines are worked on at a time.
    """
    dimensions = Dimensions.of(Simulation(Case(antennas=antennas, channels=channels)).structure())
    settings = fit_models_at_once(dimensions, Calamity(), budget)
    planned = solve_memory(dimensions, settings)
    if planned > budget:
        raise InputError(
            f"--antennas {antennas}: a solve of {dimensions.baselines} baselines x {channels} channels needs about "
            f"{planned / 1e9:.1f} GB, and there are {budget / 1e9:.1f} GB"
        )
    return settings, planned


def measure_solve(antennas: int, channels: int, budget: float, max_steps: int) -> SolveSize:
    """Solve one integration in a process of its own; parameters and errors as for `plan_solve`."""
    settings, planned = plan_solve(antennas, channels, budget)
    request = {
        "antennas": antennas,
        "channels": channels,
        "models_at_once": settings.models_at_once,
        "max_steps": max_steps,
    }
    measured = run_module("calstudy.bench.solve_memory", request)
    return SolveSize(antennas=antennas, models_at_once=settings.models_at_once, planned=planned, **measured)


def run_solve(request: Mapping[str, Any]) -> dict[str, Any]:
    """Solve one integration of the bench's array, and return what it took."""
    simulation = Simulation(Case(antennas=request["antennas"], channels=request["channels"]))
    structure = replace(simulation.structure(), models_at_once=request["models_at_once"])
    problem = simulation.problem(0, structure)
    with Usage() as usage:
        solution = solve(problem, GaussNewton(max_steps=request["max_steps"]))
    return {
        "baselines": structure.n_baselines,
        "measured": usage.peak_memory,
        "cpu_seconds": usage.cpu_seconds,
        "n_steps": solution.n_steps,
        "status": solution.status,
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(run_solve(json.loads(sys.argv[1]))))
