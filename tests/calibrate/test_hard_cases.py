"""Long cables, gain errors of order one and faulty data on arrays that are not redundant: the minimum, or a status.

Every fit is compared with one of the same data that starts at the true gains: it must end at its loss. A fit that ends
higher must say that it has not converged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from toy import complex_normal, scattered

from calstudy.base.observation import Frame
from calstudy.calibrate.delay_start import delay_start
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.settings import BasisSettings, DelayStart
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.array_layouts.geometric import GOLOMB_MARKS

SOLVER = GaussNewton(tolerance=1e-4, max_steps=200)
AT_THE_MINIMUM = 1.03
"""In directions of little curvature fits from different starts stop up to 2 % of the loss apart at this tolerance."""
NEAR = 1.1
"""A fit that has not come to the end must be on the way to it."""
FAULTY = 3
"""The antenna that is without signal."""


def golomb() -> np.ndarray:
    marks = np.array(GOLOMB_MARKS[12])
    return 3.0 * np.column_stack([marks, 0 * marks, 0 * marks])


@dataclass(frozen=True)
class Hard:
    """An array, and what is wrong with its gains and data."""

    positions: np.ndarray
    channels: int = 96
    width: float = 240e3
    cables: float = 0.0
    gain_error: float = 0.1
    fault: str = ""
    delay_step: str = "100 ns"
    seed: int = 4

    def simulate(self) -> tuple[Simulation, CalibrationProblem]:
        """Return what is true, and the problem of the data."""
        case = Case(
            antennas=len(self.positions),
            channels=self.channels,
            first=150e6,
            band=self.channels * self.width,
            gain_scatter=self.gain_error,
        )
        simulation, rng = Simulation(case, self.positions), np.random.default_rng(self.seed)
        delays = rng.uniform(-self.cables, self.cables, case.antennas)
        turns = case.frequencies - case.frequencies.mean()
        simulation.gains = simulation.gains * np.exp(2j * np.pi * delays[:, None] * turns)
        # Baselines of like length share a basis, for a short compilation.
        structure = simulation.structure(BasisSettings(delay_step=self.delay_step))
        problem = simulation.problem(0, structure)
        visibilities, weights = problem.visibilities.copy(), problem.weights.copy()
        rows, scale = (simulation.antennas == FAULTY).any(axis=1), np.abs(visibilities).max()
        if self.fault == "interference":
            visibilities[:, self.channels // 3] += 1000 * scale * complex_normal(rng, (len(visibilities),))
        elif self.fault == "no signal":
            visibilities[rows] = 0
        elif self.fault == "noise alone":
            visibilities[rows] = 1e-3 * scale * complex_normal(rng, visibilities[rows].shape)
        elif self.fault == "flagged antenna":
            weights[rows] = 0
        elif self.fault == "flags":
            weights = weights * (rng.random(weights.shape) > 0.3)
        return simulation, replace(problem, visibilities=visibilities, weights=weights, prior="gains")


def fitted(simulation: Simulation, problem: CalibrationProblem, settings: DelayStart, sky: np.ndarray | None):
    """Solve from the gains that are found in the data."""
    data = Frame(
        np.arange(len(simulation.positions)), simulation.positions, simulation.antennas, simulation.case.frequencies
    )
    data.visibilities = problem.visibilities[None, :, :, None]
    weights = problem.weights[None, :, :, None]
    start = delay_start(data, weights, settings, None if sky is None else sky[None, :, :, None])[:, :, 0, 0]
    return solve(replace(problem, initial_gains=start), SOLVER)


RANDOM = 4 * scattered(12)
CASES = {
    "golomb, 60 ns": Hard(golomb(), cables=60e-9),
    "golomb, 300 ns": Hard(golomb(), cables=300e-9),
    "golomb, 500 ns": Hard(golomb(), cables=500e-9),
    "random, 60 ns": Hard(RANDOM, cables=60e-9),
    "random, 300 ns": Hard(RANDOM, cables=300e-9),
    "random, 500 ns": Hard(RANDOM, cables=500e-9),
    "gain error 0.5, 300 ns": Hard(RANDOM, cables=300e-9, gain_error=0.5),
    "no signal, 300 ns": Hard(RANDOM, cables=300e-9, fault="no signal"),
    "noise alone, 300 ns": Hard(RANDOM, cables=300e-9, fault="noise alone"),
    "flagged antenna, 300 ns": Hard(RANDOM, cables=300e-9, fault="flagged antenna"),
    "30 % flags, 300 ns": Hard(RANDOM, cables=300e-9, fault="flags"),
    "six antennas, 300 ns": Hard(RANDOM[:6], cables=300e-9),
    "1536 channels, 300 ns": Hard(RANDOM, channels=1536, width=20e3, cables=300e-9),
    "3 km, 500 ns": Hard(150 * scattered(10), channels=192, width=20e3, cables=500e-9, delay_step="1 us"),
}

EASIER_OR_LARGER = {
    "golomb, 60 ns",
    "golomb, 300 ns",
    "random, 60 ns",
    "random, 300 ns",
    "1536 channels, 300 ns",
    "3 km, 500 ns",
}
"""With shorter cables than cases of the same array, or more data: left to ``pytest -m slow``."""
QUICK = {"six antennas, 300 ns"}
"""In the default suite; all others are left to ``pytest -m chain``."""


def marks(name):
    if name in EASIER_OR_LARGER:
        return [pytest.mark.slow]
    return [] if name in QUICK else [pytest.mark.chain]


@pytest.fixture(scope="module")
def floors():
    """The problems, and the losses that are reached from the true gains; each is solved once."""
    found: dict[str, tuple[Simulation, CalibrationProblem, float]] = {}

    def floor(name: str, hard: Hard):
        if name not in found:
            simulation, problem = hard.simulate()
            solution = solve(replace(problem, initial_gains=simulation.gains), SOLVER)
            found[name] = simulation, problem, float(solution.record.loss_history[-1])
        return found[name]

    return floor


@pytest.mark.chain
@pytest.mark.parametrize("with_sky", [True, False], ids=["sky model", "no sky model"])
@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in CASES])
def test_the_minimum_is_found_from_delays(name, with_sky, floors):
    simulation, problem, floor = floors(name, CASES[name])
    sky = simulation.foregrounds(0) if with_sky else None
    solution = fitted(simulation, problem, DelayStart(kind="delays"), sky)
    limit = AT_THE_MINIMUM if solution.record.status == "converged" else NEAR
    assert solution.record.loss_history[-1] < limit * floor


@pytest.mark.chain
def test_from_unity_cables_are_out_of_reach_and_the_status_says_so(floors):
    _, problem, floor = floors("random, 300 ns", CASES["random, 300 ns"])
    solution = solve(problem, SOLVER)
    assert solution.record.loss_history[-1] > NEAR * floor
    assert solution.record.status != "converged"


@pytest.mark.chain
def test_interference_that_is_not_flagged_is_not_said_to_have_converged():
    """A thousand times the signal in one channel, different on every baseline: no gains can stand for it."""
    simulation, problem = Hard(RANDOM, cables=300e-9, fault="interference").simulate()
    noise = simulation.case.noise * np.sqrt(np.mean(np.abs(simulation.foregrounds(0)) ** 2))
    for sky in (simulation.foregrounds(0), None):
        solution = fitted(simulation, problem, DelayStart(kind="delays"), sky)
        assert solution.record.loss_history[-1] > 100 * noise**2
        assert solution.record.status != "converged"
