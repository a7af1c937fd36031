"""The planned memory of a solve: against the measured one, and how it is made to fit."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.cost import (
    LEAST_MODELS,
    TENSORFLOW_MEMORY,
    Dimensions,
    dimensions_of,
    solve_memory,
)
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.layouts import make_layout, size_of_instrument
from calstudy.instrument.settings import InstrumentSettings

DEFAULT = Calamity()
LARGE = Dimensions(antennas=350, baselines=61_075, models=61_075, channels=384, widest=53, coefficients=1.95e6)


def test_fewer_models_at_a_time_take_less_memory():
    sizes, fit = [], DEFAULT
    while fit is not None:
        sizes.append((fit.models_at_once, solve_memory(LARGE, fit)))
        fit = fit.with_less_memory()
    assert [count for count, _ in sizes] == [1024, 512, 256, 128, 64, LEAST_MODELS]
    memory = [size for _, size in sizes]
    assert memory == sorted(memory, reverse=True)
    assert 1e9 < memory[-1] < memory[0] - 1e8


def test_350_antennas_are_planned_within_16_gb():
    assert solve_memory(LARGE, DEFAULT) < 16e9


@pytest.mark.parametrize("solver", ["gauss-newton", "adamax"])
def test_memory_grows_with_the_number_of_visibilities(solver):
    settings = Calamity.model_validate({"solver": solver})
    sizes = [Dimensions(n, n * (n - 1) // 2, n * (n - 1) // 2, 384, 53, 16 * n * (n - 1)) for n in (100, 200, 400)]
    small, middle, large = (solve_memory(size, settings) for size in sizes)
    # Baselines grow as the square of the antennas, blocks of antennas as their number.
    assert 3.3 < (large - middle) / (middle - small) < 4.2


LAYOUTS = [
    {"kind": "mwa-compact-minredundant"},
    {"kind": "mwa-compact-hex-east"},
    {"kind": "hex", "side": 5, "spacing": "14 m"},
    {"kind": "linear", "count": 20, "spacing": "10 m"},
    {"kind": "rectangular", "count": 40},
    {"kind": "golomb", "count": 9, "spacing": "4 m"},
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout["kind"])
def test_plans_without_a_layout_are_those_with_it(layout):
    instrument = InstrumentSettings.model_validate({"layout": layout})
    enu = make_layout(instrument.layout).enu
    first, second = np.triu_indices(len(enu), 1)
    lengths = np.linalg.norm(enu[first] - enu[second], axis=1)
    channels = instrument.channels
    frequencies = channels.first + channels.width * np.arange(channels.count)
    basis = make_basis(lengths, frequencies, DEFAULT.basis)
    widest = max(bucket.vectors.shape[1] for bucket in basis.buckets)
    size = size_of_instrument(instrument)
    guessed = dimensions_of(size, DEFAULT)
    exact = Dimensions(len(enu), len(lengths), len(lengths), channels.count, widest, basis.n_coefficients)
    assert guessed.coefficients == pytest.approx(exact.coefficients, rel=0.3)
    planned = DEFAULT.cost(size).memory - TENSORFLOW_MEMORY
    assert planned == pytest.approx(solve_memory(exact, DEFAULT) - TENSORFLOW_MEMORY, rel=0.5)


def test_every_solver_has_its_own_time():
    size = size_of_instrument(InstrumentSettings())

    def seconds(solver) -> float:
        return Calamity.model_validate({"solver": solver}).cost(size).seconds

    found = {name: seconds(name) for name in ("gauss-newton", "adamax")}
    assert found["gauss-newton"] < found["adamax"]
    cold = {"name": "gauss-newton", "warm_start": False, "max_steps": 100}
    assert seconds(cold) > 3 * found["gauss-newton"]


MEASURE = """
import sys
from calstudy.base.resources import Usage
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.synthetic import Case, Simulation
simulation = Simulation(Case(antennas=int(sys.argv[1])))
problem = simulation.problem(0, simulation.structure())
with Usage() as usage:
    solve(problem, GaussNewton())
print(usage.peak_memory)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("antennas", "above"), [(36, 1.7), (96, 1.5)])
def test_what_is_planned_is_what_it_takes(antennas, above):
    """In a process of its own, whose memory is that of one cold solve.

    Plans are for workers, which keep what earlier work left: 1.4 to 2.0 GB in studies of 36 antennas, where 1.5 GB are
    planned and a process that does nothing else takes 0.95 GB.
    """
    command = [sys.executable, "-c", MEASURE, str(antennas)]
    measured = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
    planned = solve_memory(Dimensions.of(Simulation(Case(antennas=antennas)).structure()), DEFAULT)
    assert planned / above < measured < 1.5 * planned


def test_dimensions_are_those_of_the_structure():
    structure = Simulation(Case(antennas=6, channels=96, extent=40.0)).structure()
    found = Dimensions.of(structure)
    assert (found.antennas, found.baselines, found.models, found.channels) == (6, 15, 15, 96)
    assert found.widest <= found.coefficients <= 15 * found.widest
