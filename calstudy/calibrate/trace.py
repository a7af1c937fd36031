"""What a solver holds after so many steps, on the way to where it ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calstudy.calibrate.degeneracy import fix_degeneracies
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solvers.gauss_newton import remaining_at
from calstudy.calibrate.solvers.interface import Solver, remaining_rms


class Checkpoint(NamedTuple):
    """An estimate on the way.

    Attributes
    ----------
    n_steps
        Steps taken.
    gains, model
        Shapes (Nants, Nfreqs) and (Nbls, Nfreqs), complex128, degeneracies fixed.
    remaining, remaining_rms
        How far from the minimum, as in `calstudy.calibrate.solution.Solution`.
    """

    n_steps: int
    gains: np.ndarray
    model: np.ndarray
    remaining: float
    remaining_rms: float


def trace(problem: CalibrationProblem, solver: Solver, steps: Sequence[int]) -> list[Checkpoint]:
    """Run a solver to its end, and return what it held after certain numbers of steps, and at the end.

    A solver that takes several steps at once is looked at when it has taken as many or more; the checkpoint tells.
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
            remaining = min(max(remaining_at(problem, gains), 0.0), 1.0)
            rms = remaining_rms(gains, model, problem, remaining)
            found.append(Checkpoint(done, gains, model, remaining, rms))
        if ended:
            return found
        state = solver.step(state)
