"""What the default solver takes on arrays of every kind, each in a process of its own.

``python -m calstudy.bench.arrays REQUEST`` is such a process.
"""

from __future__ import annotations

import json
import statistics
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from calstudy.base.errors import InputError, nearest
from calstudy.base.resources import Usage
from calstudy.bench.calibration import clock_of, use_device
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.process import run_module
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve, solve_warm
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Layout

HEADINGS = ("array", "baselines", "channels", "first, with compilation", "cold", "warm", "steps", "peak memory")


@dataclass(frozen=True)
class Array:
    """An array that is measured.

    Attributes
    ----------
    case
        Size and band.
    layout
        A layout as in an experiment; None for antennas at random within `case.extent`.
    """

    case: Case
    layout: Mapping[str, Any] | None = None

    def positions(self) -> np.ndarray | None:
        """Return east, north, up in m, (Nants, 3), or None."""
        if self.layout is None:
            return None
        return make_layout(TypeAdapter(Layout).validate_python(dict(self.layout))).enu


ARRAYS: dict[str, Array] = {
    "paper": Array(Case(), {"kind": "mwa-compact-minredundant"}),
    "golomb-15": Array(
        Case(antennas=15, channels=200, first=150e6, band=40e6), {"kind": "golomb", "count": 15, "spacing": "3 m"}
    ),
    "hexagon-19": Array(Case(antennas=19), {"kind": "hex", "side": 3, "spacing": "14 m"}),
    "hexagon-37": Array(Case(antennas=37), {"kind": "hex", "side": 4, "spacing": "14 m"}),
    "tiles-128": Array(Case(antennas=128), {"kind": "mwa-compact"}),
    "random-350": Array(Case(antennas=350)),
}
"""The paper's band unless it says otherwise, gain errors of 0.1 per channel, noise of 1e-3 of the foregrounds."""


@dataclass(frozen=True)
class Timing:
    """What solves of one array took.

    Attributes
    ----------
    baselines, channels
        Their numbers.
    first, cold, warm
        Seconds of the first solve, with compilation, of another from unity gains, and of one from the solution of the
        integration before, the median of all such.
    cold_steps, warm_steps
        Gauss-Newton steps, of warm solves the median.
    converged
        Whether all solves converged.
    memory
        Peak of the process, bytes.
    """

    baselines: int
    channels: int
    first: float
    cold: float
    warm: float
    cold_steps: int
    warm_steps: float
    converged: bool
    memory: int


def require_arrays(names: list[str]) -> None:
    """Raise InputError for a name that is not an array's."""
    for name in names:
        if name not in ARRAYS:
            hint = nearest(name, list(ARRAYS))
            raise InputError(f"--arrays {name}: not an array{hint} (allowed: {', '.join(ARRAYS)})")


def time_array(name: str, integrations: int, device: str = "cpu") -> Timing:
    """Measure an array in a process of its own.

    Parameters
    ----------
    name
        Of `ARRAYS`.
    integrations
        Solved one from the other, at least two.
    device
        ``cpu`` or ``gpu``.

    Raises
    ------
    InputError
        If the process fails, as where there is no such device.
    """
    request = {"name": name, "integrations": integrations, "device": device}
    return Timing(**run_module("calstudy.bench.arrays", request))


def run_array(request: Mapping[str, Any]) -> dict[str, Any]:
    """Solve consecutive integrations of an array, and return the fields of a `Timing`."""
    array, clock = ARRAYS[request["name"]], clock_of(request["device"])
    simulation = Simulation(array.case, array.positions())
    structure, solver = simulation.structure(), GaussNewton()
    seconds, steps, converged = [], [], True
    with use_device(request["device"]), Usage() as usage:
        problem = simulation.problem(0, structure)
        start = clock()
        solve(problem, solver)
        first, warm = clock() - start, None
        for index in range(request["integrations"]):
            problem = simulation.problem(index, structure)
            start = clock()
            solution, warm = solve_warm(problem, solver, warm)
            seconds.append(clock() - start)
            steps.append(solution.n_steps)
            converged &= solution.status == "converged"
    return {
        "baselines": structure.n_baselines,
        "channels": array.case.channels,
        "first": first,
        "cold": seconds[0],
        "warm": statistics.median(seconds[1:]),
        "cold_steps": steps[0],
        "warm_steps": statistics.median(steps[1:]),
        "converged": converged,
        "memory": usage.peak_memory,
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(run_array(json.loads(sys.argv[1]))))
