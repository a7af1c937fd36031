"""How much memory and time one solve takes as arrays grow, held against what the plan says."""

from __future__ import annotations

from dataclasses import dataclass

from calstudy.bench.apart import ask
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.calibrate.memory import Dimensions, fit_models_at_once, solve_memory
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.errors import InputError

PROCESS = "calstudy.bench.solve_process"
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


def plan_solve(antennas: int, channels: int, budget: float) -> tuple[CalibrationSettings, float]:
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
    settings = fit_models_at_once(dimensions, CalibrationSettings(), budget)
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
    known = {"antennas": antennas, "models_at_once": settings.models_at_once, "planned": planned}
    return SolveSize(**known, **ask(PROCESS, request))
