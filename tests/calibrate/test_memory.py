"""What a solve is planned to take: against what it takes, and how it is made to fit."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.bench.calibration_case import Case, Simulation
from calstudy.bench.solve_memory import measure_solve, plan_solve
from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.calibrators.calamity import Calamity
from calstudy.calibrate.cost import (
    LEAST_MODELS,
    TENSORFLOW_MEMORY,
    Dimensions,
    dimensions_of,
    fit_models_at_once,
    solve_memory,
)
from calstudy.cli.bench import bench_app
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.size import Size, baseline_lengths

DEFAULT = Calamity()
LARGE = Dimensions(antennas=350, baselines=61_075, models=61_075, channels=384, widest=53, coefficients=1.95e6)


def test_less_memory_means_fewer_models_at_a_time():
    whole = solve_memory(LARGE, DEFAULT)
    assert fit_models_at_once(LARGE, DEFAULT, whole) == DEFAULT
    fewer = fit_models_at_once(LARGE, DEFAULT, whole - 1e8)
    assert LEAST_MODELS <= fewer.models_at_once < DEFAULT.models_at_once
    assert solve_memory(LARGE, fewer) <= whole - 1e8
    least = fit_models_at_once(LARGE, DEFAULT, 1e9)
    assert least.models_at_once == LEAST_MODELS
    assert 1e9 < solve_memory(LARGE, least) < solve_memory(LARGE, fewer)


def test_350_antennas_are_planned_within_16_gb():
    assert solve_memory(LARGE, DEFAULT) < 16e9


@pytest.mark.parametrize("solver", ["gauss-newton", "lbfgs", "adamax"])
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
    size = Size.of(instrument)
    guessed = dimensions_of(size, DEFAULT)
    exact = Dimensions(len(enu), len(lengths), len(lengths), channels.count, widest, basis.n_coefficients)
    assert baseline_lengths(instrument.layout)[0] == pytest.approx(lengths.max(), rel=0.6)
    assert guessed.coefficients == pytest.approx(exact.coefficients, rel=0.3)
    planned = DEFAULT.cost(size).memory - TENSORFLOW_MEMORY
    assert planned == pytest.approx(solve_memory(exact, DEFAULT) - TENSORFLOW_MEMORY, rel=0.5)


def test_every_solver_has_its_own_time():
    size = Size.of(InstrumentSettings())

    def seconds(solver) -> float:
        return Calamity.model_validate({"solver": solver}).cost(size).seconds

    found = {name: seconds(name) for name in ("gauss-newton", "lbfgs", "adamax")}
    assert found["gauss-newton"] < found["lbfgs"] < found["adamax"]
    cold = {"name": "gauss-newton", "warm_start": False, "max_steps": 100}
    assert seconds(cold) > 3 * found["gauss-newton"]


def test_what_cannot_fit_is_refused_before_it_starts():
    with pytest.raises(
        InputError, match=r"--antennas 60: a solve of 1770 baselines x 64 channels needs about 1\.\d GB"
    ):
        plan_solve(60, 64, 1e9)
    for text in ("36;128", "2,36", "", "36,"):
        result = CliRunner().invoke(bench_app, ["memory", "--antennas", text])
        assert isinstance(result.exception, InputError)


def test_the_bench_measures_one_solve():
    found = measure_solve(5, 64, 16e9, 2)
    assert (found.antennas, found.baselines, found.models_at_once) == (5, 10, 1024)
    assert (found.n_steps, found.status) == (2, "max-steps")
    assert 0.5e9 < found.measured < 1.5 * found.planned


@pytest.mark.slow
@pytest.mark.parametrize("antennas", [36, 96])
def test_what_is_planned_is_what_it_takes(antennas):
    found = measure_solve(antennas, 384, 16e9, 100)
    assert found.planned / 1.5 < found.measured < 1.5 * found.planned


def test_dimensions_are_those_of_the_structure():
    structure = Simulation(Case(antennas=6, channels=96, extent=40.0)).structure()
    found = Dimensions.of(structure)
    assert (found.antennas, found.baselines, found.models, found.channels) == (6, 15, 15, 96)
    assert found.widest <= found.coefficients <= 15 * found.widest
