"""CALAMITY (Ewall-Wice et al. 2022) and its relatives: a least-squares fit of every integration and polarization."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calstudy.base.observation import Observation
from calstudy.base.resources import Usage
from calstudy.calibrate.degeneracy import sky_model_slope
from calstudy.calibrate.interface import Assumed, Calibration, Outcome, Progress
from calstudy.calibrate.preparation import PreparedFit, make_problem, prepare
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, weight_change
from calstudy.calibrate.settings import (
    RUNAWAY,
    GainFit,
    GainWeights,
    GaussNewtonSettings,
    LbfgsSettings,
    unsettled_message,
)
from calstudy.calibrate.solution import Solution
from calstudy.calibrate.solvers.first_order import FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solver, WarmStart, solve_warm
from calstudy.calibrate.solvers.lbfgs import Lbfgs
from calstudy.calibrate.structure import repeat_structure


def make_solver(settings: GainFit) -> Solver:
    """Return the solver of the `calibration.solver` section."""
    solver = settings.solver
    if isinstance(solver, GaussNewtonSettings):
        return GaussNewton(solver.tolerance, solver.max_steps, solver.precision)
    if isinstance(solver, LbfgsSettings):
        return Lbfgs(solver.tolerance, solver.max_steps, solver.memory)
    optimizer = Optimizer(solver.name, solver.learning_rate, solver.schedule, solver.final_rate, solver.max_steps)
    return FirstOrder(optimizer, solver.tolerance, solver.precision, solver.stop, solver.keep)


class Solve(NamedTuple):
    """One solve: its integrations, its polarization, its solution and diagnostics.

    With a sky model, the diagnostics are the slope of the calibrated data on it and the rms of the band shape; with
    weights from the gains, the number of passes and the last change of the weights.
    """

    times: slice
    polarization: int
    solution: Solution
    peak_memory: int
    diagnostics: Mapping[str, float]


def fit(
    observation: Observation,
    assumed: Assumed,
    settings: GainFit,
    progress: Progress | None = None,
) -> Calibration:
    """Solve for gains and foregrounds, independently for every polarization and every integration or group of them.

    Flagged samples have no influence. Autocorrelations are left out, also of the results, unless `settings.autos` is
    set.

    Parameters
    ----------
    observation
        Visibilities with parallel-hand polarizations only.
    assumed
        A sky model, whose weighted sum fixes the overall scale, and which is the foreground model if foregrounds are
        not fitted. Without a sky model the data take its place, which makes gains of about unity. Gains to start from
        override `settings.initial_gains`.
    progress
        Called after each solve with the number done and the total.

    Raises
    ------
    InputError
        As for `calstudy.calibrate.preparation.prepare`.
    """
    prepared = prepare(observation, settings, assumed)
    shape, used = prepared.data.shape, prepared.used
    gains, gain_flags = np.ones(prepared.start.shape, complex), np.ones(prepared.start.shape, bool)
    model = np.zeros(shape, complex)
    outcomes = []
    for solve in _solve_all(settings, prepared, progress):
        times, p, solution = solve.times, solve.polarization, solve.solution
        outcomes.append(_outcome(solve))
        if not solution.usable:
            continue
        model[times, :, :, p] = solution.model.reshape(-1, *shape[1:3])
        for t in range(times.start, times.stop):
            gain_flags[:, :, t, p] = ~_has_data(prepared.structure, prepared.weights[t, :, :, p] > 0)
            gains[:, :, t, p] = np.where(gain_flags[:, :, t, p], 1, solution.gains)
    return Calibration(
        gains=gains,
        gain_flags=gain_flags,
        # Baselines without weight are not part of the solves.
        model=model if settings.baselines is None else None,
        flags=~used,
        baselines=prepared.fitted,
        outcomes=outcomes,
    )


def _solve_all(settings: GainFit, prepared: PreparedFit, progress: Progress | None) -> Iterator[Solve]:
    """Yield every solve, polarization by polarization, each in the order of time."""
    solver = make_solver(settings)
    groups = settings.solves(prepared.data.n_times)
    n_polarizations = prepared.data.n_polarizations
    for p in range(n_polarizations):
        warm: WarmStart | None = None
        anew = True
        for index, times in enumerate(groups):
            diagnostics: dict[str, float] = {}
            with Usage() as usage:
                problem = make_problem(prepared, settings, times, p)
                if isinstance(problem, str):
                    solution = _skipped(repeat_structure(prepared.structure, times.stop - times.start), problem)
                else:
                    start = warm if settings.solver.warm_start else None
                    if isinstance(settings.weights, GainWeights):
                        solution, warm, diagnostics = _solve_in_passes(problem, solver, start, settings.weights)
                    else:
                        solution, warm, anew = _solve(problem, solver, start, anew)
                    diagnostics |= _diagnostics(solution, problem)
            yield Solve(times, p, solution, usage.peak_memory, diagnostics)
            if progress is not None:
                progress(p * len(groups) + index + 1, len(groups) * n_polarizations)


def _solve(
    problem: CalibrationProblem, solver: Solver, warm: WarmStart | None, anew: bool
) -> tuple[Solution, WarmStart | None, bool]:
    """Solve from the warm start and, if that got stuck, from the problem's own gains; the lower loss counts.

    `anew` allows the second solve after a stall. It is returned, false once the second solve has stalled too, because
    that will happen again for the next integration.
    """
    solution, next_warm = solve_warm(problem, solver, warm)
    stuck = solution.status == "failed" or (solution.status == "stalled" and anew)
    if warm is None or not stuck:
        return solution, next_warm, anew
    again, again_warm = solve_warm(problem, solver)
    anew = again.status != "stalled"
    if not again.usable or (solution.usable and again.loss_history[-1] > solution.loss_history[-1]):
        return solution, next_warm, anew
    return again, again_warm, anew


def _solve_in_passes(
    problem: CalibrationProblem, solver: Solver, warm: WarmStart | None, settings: GainWeights
) -> tuple[Solution, WarmStart | None, dict[str, float]]:
    """Solve with the weights of the gains of the previous pass, until the weights settle.

    The problem has the weights of unity gains. The first weights are from the gains of the warm start, or of the
    problem if it is None. Returns the last solution with the times of all passes, the warm start of the next solve, and
    the number of passes and the last relative change of the weights by name.
    """
    weighted = problem.weighted_by(problem.initial_gains if warm is None else warm.gains)
    solutions: list[Solution] = []
    starts: list[WarmStart | None] = []
    change, anew = 0.0, True
    while len(solutions) < settings.passes:
        solution, warm, anew = _solve(weighted, solver, warm, anew)
        if solutions and not solution.usable:
            break
        solutions.append(solution)
        starts.append(warm)
        if not solution.usable:
            break
        before, weighted = weighted.weights, problem.weighted_by(solution.gains)
        change = weight_change(weighted.weights, before)
        # Weights of gains that are far from the solution lead away from it.
        if change < settings.tolerance or solution.status == "max-steps":
            break
    found, kept = _together(solutions), -1
    if settings.passes > 1 and change > RUNAWAY:
        found, kept = replace(found, gains=solutions[0].gains, model=solutions[0].model), 0
    if settings.unsettled(change) and found.status == "converged":
        found = replace(found, status="max-steps", message=unsettled_message(change, len(solutions)))
    return found, starts[kept], {"passes": len(solutions), "weight_change": change}


def _together(solutions: Sequence[Solution]) -> Solution:
    """Return the last of consecutive solutions, with the steps and times of all of them."""
    first, *others = [solution.loss_history for solution in solutions]
    return replace(
        solutions[-1],
        loss_history=np.concatenate([first, *(history[1:] for history in others)]),
        n_steps=sum(solution.n_steps for solution in solutions),
        seconds=sum(solution.seconds for solution in solutions),
        cpu_seconds=sum(solution.cpu_seconds for solution in solutions),
    )


def _skipped(structure: FitStructure, message: str) -> Solution:
    gains = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    model = np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    return Solution(gains, model, np.empty(0), "skipped", message, 0, 0.0, 0.0)


def _diagnostics(solution: Solution, problem: CalibrationProblem) -> dict[str, float]:
    """Return the scale and the rms band shape of g_a g_b* relative to the sky model, if there is one."""
    if problem.sky_model is None or not solution.usable:
        return {}
    slope, shape = sky_model_slope(solution.gains, problem)
    if slope == 0:
        return {}
    return {"sky_model_slope": slope, "band_shape_rms": float(np.sqrt(np.nanmean((shape - 1) ** 2)))}


def _outcome(solve: Solve) -> Outcome:
    solution = solve.solution
    return Outcome(
        status=solution.status,
        message=solution.message,
        steps=solution.n_steps,
        loss_history=solution.loss_history,
        seconds=solution.seconds,
        cpu_seconds=solution.cpu_seconds,
        newton_decrement=solution.newton_decrement,
        decrement_rms=solution.decrement_rms,
        peak_memory=solve.peak_memory,
        diagnostics=solve.diagnostics,
    )


def _has_data(structure: FitStructure, used: np.ndarray) -> np.ndarray:
    """Return the antennas and channels, (Nants, Nfreqs), with any baseline in use; `used` is (Nbls, Nfreqs)."""
    found = np.zeros((structure.n_antennas, structure.n_frequencies), bool)
    for column in structure.antennas.T:
        np.logical_or.at(found, column, used)
    return found
