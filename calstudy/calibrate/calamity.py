"""CALAMITY (Ewall-Wice et al. 2022) and its relatives: a least-squares fit of every integration and polarization."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calstudy.base.observation import Observation
from calstudy.base.resources import Usage
from calstudy.calibrate.degeneracy import sky_model_slope
from calstudy.calibrate.interface import Assumed, Calibration, Progress
from calstudy.calibrate.preparation import PreparedFit, make_problem, prepare
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, repeat_structure, weight_change
from calstudy.calibrate.records import Solve
from calstudy.calibrate.settings import (
    RUNAWAY,
    GainFit,
    GainWeights,
    GaussNewtonSettings,
    unsettled_message,
)
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solution, Solver, WarmStart, solve_warm


def make_solver(settings: GainFit) -> Solver:
    """Return the solver of the `calibration.solver` section."""
    solver = settings.solver
    if isinstance(solver, GaussNewtonSettings):
        return GaussNewton(solver.tolerance, solver.max_steps, solver.precision)
    return Adamax(**solver.model_dump(exclude={"name", "warm_start"}))


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
    for times, p, solution in _solve_all(settings, prepared, progress):
        outcomes.append(solution.record)
        if not solution.record.usable:
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


def _solve_all(
    settings: GainFit, prepared: PreparedFit, progress: Progress | None
) -> Iterator[tuple[slice, int, Solution]]:
    """Yield the integrations, the polarization and the solution of every solve, in the order of `Calibration`."""
    solver = make_solver(settings)
    groups = settings.solves(prepared.data.n_times)
    n_polarizations = prepared.data.n_polarizations
    for p in range(n_polarizations):
        warm: WarmStart | None = None
        anew = True
        for index, times in enumerate(groups):
            with Usage() as usage:
                problem = make_problem(prepared, settings, times, p)
                if isinstance(problem, str):
                    solution = _skipped(repeat_structure(prepared.structure, times.stop - times.start), problem)
                else:
                    start = warm if settings.solver.warm_start else None
                    if isinstance(settings.weights, GainWeights):
                        solution, warm = _solve_in_passes(problem, solver, start, settings.weights)
                    else:
                        solution, warm, anew = _solve(problem, solver, start, anew)
                    solution = _noted(solution, **_scale(solution, problem))
            yield times, p, solution._replace(record=replace(solution.record, peak_memory=usage.peak_memory))
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
    first = solution.record
    stuck = first.status == "failed" or (first.status == "stalled" and anew)
    if warm is None or not stuck:
        return solution, next_warm, anew
    again, again_warm = solve_warm(problem, solver)
    anew = again.record.status != "stalled"
    if not again.record.usable or (first.usable and again.record.loss_history[-1] > first.loss_history[-1]):
        return solution, next_warm, anew
    return again, again_warm, anew


def _solve_in_passes(
    problem: CalibrationProblem, solver: Solver, warm: WarmStart | None, settings: GainWeights
) -> tuple[Solution, WarmStart | None]:
    """Solve with the weights of the gains of the previous pass, until the weights settle.

    The problem has the weights of unity gains. The first weights are from the gains of the warm start, or of the
    problem if it is None. Returns the last solution, whose record has the times of all passes, their number and the
    last relative change of the weights, and the warm start of the next solve.
    """
    weighted = problem.weighted_by(problem.initial_gains if warm is None else warm.gains)
    solutions: list[Solution] = []
    starts: list[WarmStart | None] = []
    change, anew = 0.0, True
    while len(solutions) < settings.passes:
        solution, warm, anew = _solve(weighted, solver, warm, anew)
        if solutions and not solution.record.usable:
            break
        solutions.append(solution)
        starts.append(warm)
        if not solution.record.usable:
            break
        before, weighted = weighted.weights, problem.weighted_by(solution.gains)
        change = weight_change(weighted.weights, before)
        # Weights of gains that are far from the solution lead away from it.
        if change < settings.tolerance or solution.record.status == "max-steps":
            break
    kept = 0 if settings.passes > 1 and change > RUNAWAY else -1
    record = _together([solution.record for solution in solutions])
    if settings.unsettled(change) and record.status == "converged":
        record = replace(record, status="max-steps", message=unsettled_message(change, len(solutions)))
    found = solutions[kept]._replace(record=record)
    return _noted(found, passes=len(solutions), weight_change=change), starts[kept]


def _together(records: Sequence[Solve]) -> Solve:
    """Return the last record of consecutive solves, with the steps and times of all of them."""
    first, *others = [record.loss_history for record in records]
    return replace(
        records[-1],
        loss_history=np.concatenate([first, *(history[1:] for history in others)]),
        steps=sum(record.steps or 0 for record in records),
        seconds=sum(record.seconds or 0 for record in records),
        cpu_seconds=sum(record.cpu_seconds or 0 for record in records),
    )


def _skipped(structure: FitStructure, message: str) -> Solution:
    gains = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    model = np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    return Solution(gains, model, Solve("skipped", message, steps=0, seconds=0.0, cpu_seconds=0.0))


def _noted(solution: Solution, **diagnostics: float) -> Solution:
    """Return a solution with further diagnostics in its record."""
    record = solution.record
    return solution._replace(record=replace(record, diagnostics={**record.diagnostics, **diagnostics}))


def _scale(solution: Solution, problem: CalibrationProblem) -> dict[str, float]:
    """Return the scale and the rms band shape of g_a g_b* relative to the sky model, if there is one."""
    if problem.sky_model is None or not solution.record.usable:
        return {}
    slope, shape = sky_model_slope(solution.gains, problem)
    if slope == 0:
        return {}
    return {"sky_model_slope": slope, "band_shape_rms": float(np.sqrt(np.nanmean((shape - 1) ** 2)))}


def _has_data(structure: FitStructure, used: np.ndarray) -> np.ndarray:
    """Return the antennas and channels, (Nants, Nfreqs), with any baseline in use; `used` is (Nbls, Nfreqs)."""
    found = np.zeros((structure.n_antennas, structure.n_frequencies), bool)
    for column in structure.antennas.T:
        np.logical_or.at(found, column, used)
    return found
