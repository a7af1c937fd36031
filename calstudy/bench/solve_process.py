"""Measure one cold solve: ``python -m calstudy.bench.solve_process REQUEST``; see `solve_size`."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from calstudy.bench.calibration_case import Case, Simulation
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.resources import Usage


def answer(request: Mapping[str, Any]) -> dict[str, Any]:
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
    print(json.dumps(answer(json.loads(sys.argv[1]))))
