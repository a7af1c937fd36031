"""CALAMITY (Ewall-Wice et al. 2022) and its relatives: a least-squares fit of every integration and polarization."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.observation import Observation
from calstudy.base.resources import Usage
from calstudy.calibrate.degeneracy import sky_model_slope
from calstudy.calibrate.deviation import LEAST, PASSES, Estimate, estimate
from calstudy.calibrate.interface import Assumed, Calibration, Progress
from calstudy.calibrate.preparation import PreparedFit, make_problem, prepare
from calstudy.calibrate.problem import CalibrationProblem, weight_change
from calstudy.calibrate.records import Solve
from calstudy.calibrate.settings import (
    RUNAWAY,
    FlagWeights,
    GainFit,
    GainWeights,
    GaussNewtonSettings,
    unsettled_message,
)
from calstudy.calibrate.solvers.adamax import Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solution, Solver, WarmStart, solve_warm

SEARCH_TOLERANCE, NEAR = 1e-3, 0.1
"""Tolerance of the solves far from the most likely deviations, and the relative change of these that ends the search.

Solves to this tolerance move on slowly, and deviations with them, so that these do not settle."""
QUICK_PASSES = 3
"""Passes after which fits with a finite prior are in double precision: in single, rounding may change weights."""
NO_EQUAL_SOLVE = "weights from the gains run away, and the fit with equal weights failed"
NO_EXACT_SOLVE = "only solves with the tolerance of the search for the deviation gave gains"
UNSETTLED_DEVIATION = "the deviation of the foregrounds from the sky model still changed after"
UNRESOLVED_DEVIATION = (
    "the deviation of the foregrounds from the sky model is lost in rounding; "
    "give foreground_prior.deviation as a number"
)


def make_solver(settings: GainFit, tolerance: float | None = None) -> Solver:
    """Return the solver of the `calibration.solver` section, with another tolerance if one is given."""
    solver = settings.solver
    if tolerance is not None:
        solver = solver.model_copy(update={"tolerance": tolerance})
    kind: Callable[..., Solver] = GaussNewton if isinstance(solver, GaussNewtonSettings) else Adamax
    return kind(**solver.model_dump(exclude={"name", "warm_start"}))


def fit(observation: Observation, assumed: Assumed, settings: GainFit, progress: Progress | None = None) -> Calibration:
    """Solve for gains and foregrounds, independently for every polarization and every integration or group of them.

    Flagged samples have no influence. Autocorrelations are left out, also of the results, unless `settings.autos` is
    set. Raises InputError as for `calstudy.calibrate.preparation.prepare`.

    The weighted sum of the assumed sky model fixes the overall scale; it is the foreground model if foregrounds are not
    fitted. Without a sky model the data take its place, which makes gains of about unity. Assumed gains override
    `settings.initial_gains`.
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
            gain_flags[:, :, t, p] = ~prepared.data.antennas_of(prepared.weights[t, :, :, p] > 0)
            gains[:, :, t, p] = np.where(gain_flags[:, :, t, p], 1, solution.gains)
    # Baselines without weight are not part of the solves.
    known = model if settings.baselines is None else None
    return Calibration(
        gains=gains, gain_flags=gain_flags, model=known, flags=~used, baselines=prepared.fitted, outcomes=outcomes
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
        deviations: Fractions = None
        anew = True
        for index, times in enumerate(groups):
            with Usage() as usage:
                problem = make_problem(prepared, settings, times, p)
                if isinstance(problem, str):
                    skipped = Solve("skipped", problem, steps=0, seconds=0.0, cpu_seconds=0.0)
                    solution = Solution(np.empty(0), np.empty(0), skipped)
                else:
                    start = warm if settings.solver.warm_start else None
                    if settings.estimates_deviation or isinstance(settings.weights, GainWeights):
                        known = deviations if settings.solver.warm_start else None
                        seed = round(float(prepared.data.times[times.start]) * SECONDS_PER_DAY), p
                        solution, warm, deviations = _Passes(settings, solver, seed).solve(problem, start, known)
                    else:
                        solution, warm, anew = _solve(problem, solver, start, anew)
                    solution = _noted(solution, **_scale(solution, problem))
            yield times, p, solution._replace(record=replace(solution.record, peak_memory=usage.peak_memory))
            if progress is not None:
                progress(p * len(groups) + index + 1, len(groups) * n_polarizations)


def _solve(
    problem: CalibrationProblem,
    solver: Solver,
    warm: WarmStart | None,
    anew: bool,
    repeated: Callable[[np.ndarray], bool] | None = None,
) -> tuple[Solution, WarmStart | None, bool]:
    """Solve from the warm start and, if that got stuck, from the problem's own gains; the lower loss counts.

    `anew` allows the second solve after a stall. It is returned, false once the second solve has stalled too, because
    that will happen again for the next integration. For `repeated` see `solve_warm`.
    """
    solution, next_warm = solve_warm(problem, solver, warm, repeated)
    first = solution.record
    stuck = first.status == "failed" or (first.status == "stalled" and anew)
    if warm is None or not stuck:
        return solution, next_warm, anew
    again, again_warm = solve_warm(problem, solver)
    anew = again.record.status != "stalled"
    if not again.record.usable or (first.usable and again.record.loss_history[-1] > first.loss_history[-1]):
        return solution, next_warm, anew
    return again, again_warm, anew


Fractions = tuple[float, float] | None
"""Deviations of the foregrounds, (own, shared), over the rms of the sky model; None if they are fixed."""


class _Pass(NamedTuple):
    """A solve, and the deviations that it used."""

    solution: Solution
    warm: WarmStart | None
    deviations: Fractions


class _Passes:
    """Solves with weights from the gains, and deviations of the foregrounds, of the pass before, until both settle.

    Settings ask for one of the two, or both. `seed` is that of the estimates. A deviation has errors of some percent,
    and is searched for with solves to `SEARCH_TOLERANCE`, until it changes by less than `NEAR`; the passes after that
    have the tolerance of the solver.
    """

    def __init__(self, settings: GainFit, solver: Solver, seed: tuple[int, int]) -> None:
        self._settings = settings
        self._weights = settings.weights if isinstance(settings.weights, GainWeights) else None
        self._estimated, self._solver, self._seed = settings.estimates_deviation, solver, seed
        self._late = replace(solver, patience=0) if isinstance(solver, GaussNewton) else solver
        exact = not self._estimated or solver.tolerance >= SEARCH_TOLERANCE
        self._search = solver if exact else make_solver(settings, SEARCH_TOLERANCE)
        passes = 1 if self._weights is None else self._weights.passes
        self._most = max(passes, PASSES) if self._estimated else passes

    def solve(self, problem: CalibrationProblem, warm: WarmStart | None, deviations: Fractions) -> _Pass:
        """Solve a problem, whose weights are those of unity gains, and return the last pass.

        The first weights are from the gains of the warm start, or of the problem if it is None, and the first
        deviations are those given, or of the problem. The record has the times of all passes, their number, the last
        relative change of the weights, and the deviations with their errors.
        """
        gains = problem.initial_gains if warm is None else warm.gains
        current = self._for_pass(problem, gains, deviations)
        done: list[_Pass] = []
        found: Estimate | None = None
        start, change, anew, failed = warm, 0.0, True, False
        exact, searched = self._search is self._solver, False
        while len(done) < self._most:
            last = len(done) == self._most - 1
            exact = exact or last
            solver = self._search if not exact else self._solver if len(done) < QUICK_PASSES else self._late
            repeated = None if last else partial(self._repeated, problem, current.weights if exact else None)
            solution, warm, anew = _solve(current, solver, warm, anew, repeated)
            if failed := bool(done) and not solution.record.usable:
                break
            done.append(_Pass(solution, warm, current.fractions if self._estimated else None))
            if not solution.record.usable:
                break
            # Weights that settle further hardly change an estimate that has settled.
            if self._estimated and (found is None or searched or not found.settled):
                found = estimate(current, solution.gains, solution.model, self._seed)
            searched = not exact
            if found is not None and not exact:
                exact = found.settled or np.allclose(found.deviations, current.fractions, rtol=NEAR, atol=LEAST)
            before, current = current, self._for_pass(problem, solution.gains, found and found.deviations)
            change = 0.0 if self._weights is None else weight_change(current.weights, before.weights)
            settled = (self._weights is None or change < self._weights.tolerance) and (found is None or found.settled)
            # What follows from gains that are far from the solution leads away from it.
            far = solution.record.status == "max-steps" or not (found is None or found.resolved)
            if far or (settled and not searched):
                break
        if change > RUNAWAY and (failed or len(done) > 1):
            instead = self._with_equal_weights(problem, start, done[0].deviations)
            # The record of what is kept instead has its own deviations.
            return self._kept(done, change, None if instead else found, "" if instead else NO_EQUAL_SOLVE, instead)
        return self._kept(done, change, found, NO_EXACT_SOLVE if failed and searched else "")

    def _repeated(self, problem: CalibrationProblem, weights: np.ndarray | None, gains: np.ndarray) -> bool:
        """Whether another pass follows one that has found these gains, before deviations are estimated.

        `weights` are those of the pass, (Nbls, Nfreqs), or None while deviations are searched for.
        """
        if weights is None or self._weights is None:
            return weights is None
        # These gains still have their degeneracies, and weights differ by rounding from those that end the passes.
        return weight_change(problem.weighted_by(gains).weights, weights) > 1.001 * self._weights.tolerance

    def _with_equal_weights(
        self, problem: CalibrationProblem, warm: WarmStart | None, deviations: Fractions
    ) -> _Pass | None:
        """Solve with the weights of unity gains, and deviations that these solves estimate; None if the solve fails.

        The first pass is no fallback: its weights come from the gains of the integration before, which may be noise.
        """
        equal = self._for_pass(problem, np.ones_like(problem.initial_gains), None)
        settings = self._settings.model_copy(update={"weights": FlagWeights()})
        found = _Passes(settings, self._solver, self._seed).solve(equal, warm, deviations)
        return found if found.solution.record.usable else None

    def _for_pass(self, problem: CalibrationProblem, gains: np.ndarray, deviations: Fractions) -> CalibrationProblem:
        found = problem if self._weights is None else problem.weighted_by(gains)
        return found if deviations is None else found.with_fractions(deviations)

    def _kept(
        self,
        done: Sequence[_Pass],
        change: float,
        found: Estimate | None,
        fault: str = "",
        instead: _Pass | None = None,
    ) -> _Pass:
        """Return the last pass, or another `instead`, with what all passes say in its record.

        A `fault` makes a converged pass a stalled one.
        """
        kept = instead or done[0 if change > RUNAWAY else -1]
        record = _together([one.solution.record for one in (*done, *([instead] if instead else []))])
        if fault and record.status == "converged":
            record = replace(record, status="stalled", message=fault)
        if self._weights is not None and self._weights.unsettled(change) and record.status == "converged":
            record = replace(record, status="max-steps", message=unsettled_message(change, len(done)))
        notes: dict[str, Any] = {"passes": len(done)}
        if self._weights is not None:
            notes["weight_change"] = change
        if found is not None and kept.deviations is not None:
            notes |= {"deviation": list(kept.deviations), "deviation_error": list(found.error)}
            if not found.resolved:
                record = replace(record, status="stalled", message=UNRESOLVED_DEVIATION)
            elif not found.settled and record.status == "converged":
                record = replace(record, status="max-steps", message=f"{UNSETTLED_DEVIATION} {len(done)} passes")
        return kept._replace(solution=_noted(kept.solution._replace(record=record), **notes))


def _together(records: Sequence[Solve]) -> Solve:
    """Return the last record of consecutive solves, with the steps and times of all of them."""
    first, *others = [record.loss_history for record in records]
    losses = np.concatenate([first, *(history[1:] for history in others)])
    names = "steps", "seconds", "cpu_seconds"
    sums: dict[str, Any] = {name: sum(getattr(record, name) or 0 for record in records) for name in names}
    return replace(records[-1], loss_history=losses, **sums)


def _noted(solution: Solution, **diagnostics: Any) -> Solution:
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
