"""CALAMITY (Ewall-Wice et al. 2022): visibilities in, gains, foreground model and calibrated residual out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.joint import JointGroup
from calstudy.calibrate.measured import Measured, make_problem, measure
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, gain_products
from calstudy.calibrate.products import make_gains, make_visibilities
from calstudy.calibrate.records import CalibrationResult, SolveRecord
from calstudy.calibrate.settings import CalibrationSettings, GaussNewtonSettings, LbfgsSettings
from calstudy.calibrate.solution import Solution
from calstudy.calibrate.solvers.first_order import FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solver, WarmStart, solve_warm
from calstudy.calibrate.solvers.lbfgs import Lbfgs
from calstudy.calibrate.structure import repeat_structure
from calstudy.errors import InputError
from calstudy.resources import Usage

Progress = Callable[[int, int], None]


def make_solver(settings: CalibrationSettings) -> Solver:
    """Return the solver of the `calibration.solver` section."""
    solver = settings.solver
    if isinstance(solver, GaussNewtonSettings):
        return GaussNewton(solver.tolerance, solver.max_steps)
    if isinstance(solver, LbfgsSettings):
        return Lbfgs(solver.tolerance, solver.max_steps, solver.memory)
    optimizer = Optimizer(solver.name, solver.learning_rate, solver.schedule, solver.final_rate, solver.max_steps)
    return FirstOrder(optimizer, solver.tolerance, solver.precision)


class Solve(NamedTuple):
    """One solve: its integrations, first and one past the last, its polarization, and how it went."""

    first: int
    last: int
    polarization: int
    solution: Solution
    peak_memory: int


def calibrate(
    data: UVData,
    settings: CalibrationSettings,
    sky_model: UVData | None = None,
    gains: UVCal | None = None,
    progress: Progress | None = None,
    joint: Sequence[JointGroup] = (),
) -> CalibrationResult:
    """Solve for gains and foregrounds, independently for every polarization and every integration or group of them.

    Parameters
    ----------
    data
        Visibilities, rectangular and time-major, with parallel-hand polarizations only; not changed. Flagged samples
        have no influence. Autocorrelations are left out, also of the results, unless `settings.autos` is set.
    settings
        Calibrator, foreground basis, weights, solver and prior.
    sky_model
        Visibilities whose weighted sum fixes the overall scale, with the baselines, times, channels and polarizations
        of `data`; the data themselves if none is given, which makes gains of about unity. The sky-based calibrator
        takes them for the truth.
    gains
        Where to start, before what `settings.initial_gains` says.
    progress
        Called after each solve with the number done and the total.
    joint
        Groups of baselines with common coefficients, before what `settings.joint_basis` says.

    Raises
    ------
    InputError
        If weights, gains or joint groups do not fit the data, or the sky-based calibrator has no sky model.
    ValueError
        If the data are not rectangular, not finite where unflagged, of cross-hand polarizations, without any baseline
        to fit, or differ from the sky model in shape; or if the basis does not fit into the channels.
    """
    if settings.code is not None:
        raise InputError("calibration.calibrator: 'code' stands for another calibrator; it is run in studies only")
    measured = measure(data, settings, sky_model, gains, joint)
    return _collect(measured, _solve_all(settings, measured, progress))


def _collect(measured: Measured, solves: Iterator[Solve]) -> CalibrationResult:
    """Put the solutions together."""
    data, structure = measured.data, measured.structure
    visibilities, used = measured.visibilities, measured.weights > 0
    gains, gain_flags = np.ones(measured.start.shape, complex), np.ones(measured.start.shape, bool)
    model, residual, flags = np.zeros_like(visibilities), np.zeros_like(visibilities), ~used
    records = []
    for first, last, p, solution, peak_memory in solves:
        records.append(_record(data, Solve(first, last, p, solution, peak_memory)))
        if not solution.usable:
            flags[first:last, :, :, p] = True
            continue
        fitted = solution.model.reshape(last - first, *visibilities.shape[1:3])
        for t in range(first, last):
            present = used[t, :, :, p]
            gain_flags[:, :, t, p] = ~_has_data(structure, present)
            gains[:, :, t, p] = np.where(gain_flags[:, :, t, p], 1, solution.gains)
            model[t, :, :, p] = fitted[t - first]
            products = gain_products(gains[:, :, t, p], structure.antennas)
            calibrated = np.where(present, visibilities[t, :, :, p], 0) / products
            residual[t, :, :, p] = np.where(present, calibrated - fitted[t - first], 0)
    return CalibrationResult(
        make_gains(data, measured.numbers, gains, gain_flags),
        make_visibilities(data, model, flags),
        make_visibilities(data, residual, flags),
        tuple(records),
    )


def _solve_all(settings: CalibrationSettings, measured: Measured, progress: Progress | None) -> Iterator[Solve]:
    """Yield every solve, polarization by polarization, each in the order of time."""
    solver = make_solver(settings)
    n_times, _, _, n_polarizations = measured.visibilities.shape
    step = settings.integrations_per_solve
    groups = [(first, min(first + step, n_times)) for first in range(0, n_times, step)]
    for p in range(n_polarizations):
        warm: WarmStart | None = None
        for index, (first, last) in enumerate(groups):
            with Usage() as usage:
                problem = make_problem(measured, settings, slice(first, last), p)
                if isinstance(problem, str):
                    solution = _skipped(repeat_structure(measured.structure, last - first), problem)
                else:
                    solution, warm = _solve(problem, solver, warm if settings.solver.warm_start else None)
            yield Solve(first, last, p, solution, usage.peak_memory)
            if progress is not None:
                progress(p * len(groups) + index + 1, len(groups) * n_polarizations)


def _solve(problem: CalibrationProblem, solver: Solver, warm: WarmStart | None) -> tuple[Solution, WarmStart | None]:
    """Solve from the warm start, and anew from the problem's own gains if that got stuck; the lower loss counts."""
    solution, next_warm = solve_warm(problem, solver, warm)
    if warm is None or solution.status not in ("stalled", "failed"):
        return solution, next_warm
    again, again_warm = solve_warm(problem, solver)
    if not again.usable or (solution.usable and again.loss_history[-1] > solution.loss_history[-1]):
        return solution, next_warm
    return again, again_warm


def _skipped(structure: FitStructure, message: str) -> Solution:
    gains = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    model = np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    return Solution(gains, model, np.empty(0), "skipped", message, 0, 0.0)


def _record(data: UVData, solve: Solve) -> SolveRecord:
    solution = solve.solution
    return SolveRecord(
        integration=solve.first,
        n_integrations=solve.last - solve.first,
        time=float(data.time_array[solve.first * data.Nbls]),
        polarization=int(data.polarization_array[solve.polarization]),
        status=solution.status,
        message=solution.message,
        n_steps=solution.n_steps,
        loss_history=solution.loss_history,
        seconds=solution.seconds,
        remaining=solution.remaining,
        remaining_rms=solution.remaining_rms,
        peak_memory=solve.peak_memory,
    )


def _has_data(structure: FitStructure, used: np.ndarray) -> np.ndarray:
    """Return which antennas and channels, (Nants, Nfreqs), have any baseline that is used, (Nbls, Nfreqs)."""
    found = np.zeros((structure.n_antennas, structure.n_frequencies), bool)
    for column in structure.antennas.T:
        np.logical_or.at(found, column, used)
    return found
