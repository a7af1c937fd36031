"""The interface of solvers, and the loop that drives them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from calstudy.calibrate.degeneracy import fix_degeneracies
from calstudy.calibrate.problem import CalibrationProblem, gain_products
from calstudy.calibrate.records import Solve
from calstudy.calibrate.solvers.reduced import newton_decrement_at

logger = logging.getLogger(__name__)

# A loss that stalls while it could fall by more than this fraction has not converged: fixed learning rates jitter.
STALL_LIMIT = 0.01
# Power of a baseline relative to the strongest one of either of its antennas, below which Gauss-Newton steps in single
# precision do not resolve it; and the relative power of its residual that is rounding.
HIDDEN_POWER, ROUNDING_POWER = 1e-8, 1e-10


class Solution(NamedTuple):
    """Gains and foreground model of one integration and polarization, and how the solve ended.

    Gains are dimensionless, (Nants, Nfreqs); the model is that of intrinsic visibilities F, (Nbls, Nfreqs), in the unit
    of the data; both are complex128. The loss of the record is in the unit of the data squared.
    """

    gains: np.ndarray
    model: np.ndarray
    record: Solve


class WarmStart(NamedTuple):
    """The start of the next solve with the same structure, such as the next integration, from a previous solution.

    Gains are the solution's, (Nants, Nfreqs). `memory` is anything that the solver can reuse; None if nothing.
    """

    gains: np.ndarray
    memory: Any


class Solver(Protocol):
    """An iteration over states of its own kind. Solvers hold settings only; everything that changes is in the state."""

    @property
    def tolerance(self) -> float:
        """Return the solver's threshold of convergence, by a measure of its own."""

    @property
    def unchecked(self) -> Solver:
        """Return the same iteration without a separate check of convergence at its end, or itself if it has none."""

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> Any:
        """Return the first state, at the warm start's gains if there is one and at the problem's otherwise."""

    def step(self, state: Any) -> Any:
        """Return the next state; some solvers take several of their steps at once."""

    def terminate(self, state: Any) -> Solve | None:
        """Return the status and the message if the iteration ends here, or None if it goes on."""

    def losses(self, state: Any) -> Sequence[float]:
        """Return the loss before the first step and after each, in the unit of the data squared."""

    def estimate(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the best gains and model so far, complex128, in the problem's order and unit."""

    def newton_decrement(self, state: Any, problem: CalibrationProblem) -> float:
        """Return the relative Newton decrement at the estimate (see `Solve`); NaN if unknown."""

    def memory(self, state: Any) -> Any:
        """Return data that the next solve can reuse, or None."""


def solve_warm(
    problem: CalibrationProblem,
    solver: Solver,
    warm: WarmStart | None = None,
    repeated: Callable[[np.ndarray], bool] | None = None,
) -> tuple[Solution, WarmStart | None]:
    """Solve one problem from a warm start, and return the solution with the warm start for the next.

    The solution has its degeneracies fixed (see `calstudy.calibrate.degeneracy`). A lack of convergence is a status,
    not an error; after a failed solve there is no warm start. By default the solve starts from the initial gains.
    `repeated` says of the gains at the end of the iteration, (Nants, Nfreqs), whether another solve starts from them;
    then their convergence is not checked separately.
    """
    started, cpu_started = time.perf_counter(), time.process_time()
    state = solver.init(problem, warm)
    if repeated is None:
        state, ended = _iterated(solver, state)
    else:
        state, ended = _iterated(solver.unchecked, state)
        if not repeated(solver.estimate(state)[0]):
            state, ended = _iterated(solver, state)
    losses = np.array(solver.losses(state), float)
    gains, model = solver.estimate(state)
    newton_decrement = rms = math.nan
    if ended.status != "failed":
        newton_decrement = float(np.clip(solver.newton_decrement(state, problem), 0, 1))
        if ended.status == "converged" and newton_decrement > max(STALL_LIMIT, solver.tolerance):
            message = f"{ended.message}, but a Gauss-Newton step would lower it by {newton_decrement:.1e} of itself"
            ended = Solve("stalled", message)
        if ended.status == "converged" and (hidden := _hidden(gains, model, problem)) is not None:
            ended, newton_decrement = Solve("stalled", hidden), math.nan
        try:
            gains, model = fix_degeneracies(gains, model, problem)
            rms = decrement_rms(gains, model, problem, newton_decrement)
        except ValueError as error:
            ended = Solve("failed", str(error))
    record = replace(
        ended,
        steps=losses.size - 1,
        loss_history=losses,
        seconds=time.perf_counter() - started,
        cpu_seconds=time.process_time() - cpu_started,
        newton_decrement=newton_decrement,
        decrement_rms=rms,
    )
    logger.debug("%s after %d steps, %.2f s: %s", record.status, record.steps, record.seconds, record.message)
    return Solution(gains, model, record), WarmStart(gains, solver.memory(state)) if record.usable else None


def _iterated(solver: Solver, state: Any) -> tuple[Any, Solve]:
    while (ended := solver.terminate(state)) is None:
        state = solver.step(state)
    return state, ended


def _hidden(gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem) -> str | None:
    """Report baselines whose residuals a solver does not resolve beside those of much stronger baselines."""
    antennas, weights = problem.structure.antennas, problem.weights
    count = np.maximum(np.count_nonzero(weights, axis=1), 1)
    residual = problem.visibilities - gain_products(gains, antennas) * model
    power, left = (np.sum(weights * np.abs(cube) ** 2, axis=1) / count for cube in (problem.visibilities, residual))
    strongest = np.zeros(problem.structure.n_antennas)
    for column in antennas.T:
        np.maximum.at(strongest, column, power)
    weak = (power > 0) & (power < HIDDEN_POWER * strongest[antennas].min(axis=1)) & (left > ROUNDING_POWER * power)
    if not weak.any():
        return None
    share = math.sqrt(np.max(left[weak] / power[weak]))
    return (
        f"converged for the strongest baselines alone: {weak.sum()} of {weak.size} are so much weaker that they are "
        f"not resolved, with residuals of up to {share:.1e} of their data (flag antennas of far larger amplitudes)"
    )


def decrement_rms(gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem, newton_decrement: float) -> float:
    """Return the rms of the part of the residual that is due to the end of the iteration, in the unit of the data.

    `newton_decrement` is the fraction of this part in the weighted power of V / (g_a g_b*) - F. The estimate is
    complex, (Nants, Nfreqs) and (Nbls, Nfreqs).
    """
    products = gain_products(gains, problem.structure.antennas)
    loss = np.sum(problem.weights * np.abs(problem.visibilities - products * model) ** 2)
    return float(np.sqrt(newton_decrement * loss / np.sum(problem.weights * np.abs(products) ** 2)))


def solve(problem: CalibrationProblem, solver: Solver) -> Solution:
    """Solve one problem from its initial gains (see `solve_warm`)."""
    return solve_warm(problem, solver)[0]


class Checkpoint(NamedTuple):
    """An intermediate estimate: gains (Nants, Nfreqs) and model (Nbls, Nfreqs), complex128, with degeneracies fixed.

    The decrements are as in `calstudy.calibrate.records.Solve`.
    """

    n_steps: int
    gains: np.ndarray
    model: np.ndarray
    newton_decrement: float
    decrement_rms: float


def trace(problem: CalibrationProblem, solver: Solver, steps: Sequence[int]) -> list[Checkpoint]:
    """Run a solver from the problem's initial gains, and return its estimates after given numbers of steps.

    The last estimate is that at the end of the solve. A solver that takes several steps at once gives its estimate
    after as many steps or more; `Checkpoint.n_steps` is their number. Raises ValueError if an estimate has no positive
    scale (see `calstudy.calibrate.degeneracy.model_scale`).
    """
    state = solver.init(problem)
    due = sorted(set(steps))
    found: list[Checkpoint] = []
    while True:
        done = len(solver.losses(state)) - 1
        ended = solver.terminate(state) is not None
        if ended or (due and done >= due[0]):
            due = [step for step in due if step > done]
            gains, model = fix_degeneracies(*solver.estimate(state), problem)
            newton_decrement = min(max(newton_decrement_at(problem, gains), 0.0), 1.0)
            rms = decrement_rms(gains, model, problem, newton_decrement)
            found.append(Checkpoint(done, gains, model, newton_decrement, rms))
        if ended:
            return found
        state = solver.step(state)
