"""The estimates of a solver after given numbers of steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calstudy.calibrate.degeneracy import fix_degeneracies
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solvers.interface import Solver, decrement_rms
from calstudy.calibrate.solvers.reduced import newton_decrement_at


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
