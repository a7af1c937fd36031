"""What steps and solves of one array take, measured in a process of its own.

Such a process has the number of threads that it was given, and its memory is that of this work alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calstudy.bench.apart import ask

PROCESS = "calstudy.bench.step_process"


@dataclass(frozen=True)
class Samples:
    """How much is timed.

    Attributes
    ----------
    steps
        Single steps of the paper's solver.
    calls
        Calls of our Adamax, of `STEPS_PER_CALL` steps each, whose mean is one sample.
    solves
        Whole cold solves of the default solver, each with noise of its own.
    """

    steps: int
    calls: int
    solves: int


@dataclass(frozen=True)
class StepTimes:
    """What the solvers take for one array.

    Attributes
    ----------
    antennas, baselines
        Their numbers.
    longest
        Longest baseline, m.
    vectors
        Foreground vectors of the longest baseline, to which the paper pads all others.
    coefficients
        Foreground vectors of all baselines together.
    seconds
        Samples by what was timed: ``paper-step``, ``paper-sum`` (the sum over the basis alone), ``adamax-step``,
        ``default-step``, ``default-solve``; processor seconds of one core, or elapsed seconds on a GPU.
    basis_bytes
        Size of the paper's padded basis.
    paper_memory
        Bytes by which the paper's steps raised the memory of the process.
    """

    antennas: int
    baselines: int
    longest: float
    vectors: int
    coefficients: int
    seconds: dict[str, list[float]]
    basis_bytes: int
    paper_memory: int


@dataclass(frozen=True)
class Descent:
    """How the paper's solver approaches the minimum of one problem.

    Attributes
    ----------
    antennas
        Of the array.
    floor
        Loss at the minimum.
    losses
        Loss before the first step and after each, (Nsteps + 1,), in the same unit.
    """

    antennas: int
    floor: float
    losses: np.ndarray

    def steps_to(self, excess: float) -> int | None:
        """Return after how many steps the loss is first within this fraction above the minimum, or None if never."""
        reached = np.flatnonzero(self.losses <= (1 + excess) * self.floor)
        return int(reached[0]) if reached.size else None


def time_steps_apart(array: Mapping[str, Any], samples: Samples, device: str) -> StepTimes:
    """Time the solvers side by side on one array.

    Parameters
    ----------
    array
        JSON-able sections `layout`, `channels` and `basis`; every baseline has a foreground model of its own.
    samples
        How much is timed.
    device
        ``cpu`` (one core) or ``gpu``.

    Raises
    ------
    InputError
        If the process fails, with the last line that it wrote.
    """
    return StepTimes(**ask(PROCESS, {"array": dict(array), "samples": asdict(samples), "device": device}))


def descend_apart(array: Mapping[str, Any], max_steps: int) -> Descent:
    """Run the paper's solver, Adamax at a fixed rate of 0.01 from unity, for all of `max_steps` on one array."""
    answer = ask(PROCESS, {"array": dict(array), "max_steps": max_steps})
    return Descent(**{**answer, "losses": np.array(answer["losses"])})
