"""What every solver offers, and the loop that drives it."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from calstudy.calibrate.degeneracy import fix_degeneracies
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solution import Solution, Status

logger = logging.getLogger(__name__)


class Estimate(NamedTuple):
    """Gains (Nants, Nfreqs) and intrinsic model (Nbls, Nfreqs), complex128, in the problem's order and unit."""

    gains: np.ndarray
    model: np.ndarray


class WarmStart(NamedTuple):
    """What a solve leaves for the next one with the same structure, such as the next integration.

    Attributes
    ----------
    gains
        The solution's gains, shape (Nants, Nfreqs).
    memory
        Whatever the solver can reuse; None if nothing.
    """

    gains: np.ndarray
    memory: Any


class Verdict(NamedTuple):
    """Why an iteration ends: the status and one sentence."""

    status: Status
    message: str


class Solver(Protocol):
    """An iteration over states of its own kind. Solvers hold settings only; all that changes is in the state."""

    def init(self, problem: CalibrationProblem, warm: WarmStart | None = None) -> Any:
        """Return the first state, at the warm start's gains if there is one and at the problem's otherwise."""

    def step(self, state: Any) -> Any:
        """Return the next state; some solvers take several of their steps at once."""

    def terminate(self, state: Any) -> Verdict | None:
        """Return why the iteration ends here, or None if it goes on."""

    def losses(self, state: Any) -> Sequence[float]:
        """Return the loss before the first step and after each, in the unit of the data squared."""

    def estimate(self, state: Any) -> Estimate:
        """Return the best gains and model so far."""

    def memory(self, state: Any) -> Any:
        """Return what the next solve can reuse, or None."""


def solve_warm(
    problem: CalibrationProblem, solver: Solver, warm: WarmStart | None = None
) -> tuple[Solution, WarmStart | None]:
    """Solve one problem from a warm start, and return the solution with the warm start for the next.

    The solution has its degeneracies fixed (see `calstudy.calibrate.degeneracy`). Not converging is a status, not an
    error; after a failed solve there is no warm start.
    """
    started = time.perf_counter()
    state = solver.init(problem, warm)
    while (verdict := solver.terminate(state)) is None:
        state = solver.step(state)
    losses = np.array(solver.losses(state), float)
    gains, model = solver.estimate(state)
    if verdict.status != "failed":
        try:
            gains, model = fix_degeneracies(gains, model, problem)
        except ValueError as error:
            verdict = Verdict("failed", str(error))
    seconds = time.perf_counter() - started
    solution = Solution(gains, model, losses, verdict.status, verdict.message, losses.size - 1, seconds)
    logger.debug("%s after %d steps, %.2f s: %s", solution.status, solution.n_steps, seconds, solution.message)
    return solution, WarmStart(gains, solver.memory(state)) if solution.usable else None


def solve(problem: CalibrationProblem, solver: Solver) -> Solution:
    """Solve one problem from its initial gains (see `solve_warm`)."""
    return solve_warm(problem, solver)[0]
