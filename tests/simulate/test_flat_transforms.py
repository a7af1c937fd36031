"""Fourier transforms of flat arrays give what matrix products and pyuvsim give."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import healpix_sky, random_sky

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.visibilities import subset_template
from calstudy.instrument import settings as instrument
from calstudy.instrument.array_layouts.csv import CsvLayout
from calstudy.instrument.array_layouts.geometric import HexLayout
from calstudy.instrument.array_layouts.observatories import HeraLayout
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.telescope import make_template
from calstudy.simulate import patches
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import PyuvsimEngine
from calstudy.simulate.interface import SimulationSize
from calstudy.simulate.nodes import EXACT, Accuracy, integration_times, time_axis
from calstudy.simulate.patterns import power_pattern
from calstudy.simulate.source_sums import FlatSums, PairSums, flat_array, lattice_basis

FREQUENCIES = np.array([170e6, 190e6])
EOR = Accuracy(1e-4, beam_extent=20.0, smooth_sky=False)


def scattered(count=12, extent=150.0, seed=2):
    """Return antennas at random in a plane, (count, 3) in m."""
    plane = np.random.default_rng(seed).uniform(-extent, extent, (count, 2))
    return np.column_stack([plane, np.zeros(count)])


def thirds():
    """Return the antennas of a hexagon and some that are a third of its steps off its lattice."""
    hexagon = make_layout(HexLayout(kind="hex", side=3, spacing="14.6 m")).enu
    return np.concatenate([hexagon, hexagon[:4] + np.array([60 + 14.6 / 3, 0.0, 0.0])])


def line():
    return np.column_stack([14.0 * np.array([0, 1, 4, 9]), np.zeros((4, 2))])


def all_pairs(count):
    return np.triu_indices(count, 1)


def baselines(enu):
    first, second = all_pairs(len(enu))
    return (enu[second] - enu[first])[:, :2]


def observe_flat(layout, times=2, channels=2):
    """Return an observation of a flat array at the MWA's site, both polarizations."""
    template = make_template(
        instrument.InstrumentSettings(
            layout=layout,
            location={"kind": "mwa"},
            channels=instrument.Channels(first="170 MHz", width="4 MHz", count=8),
            times=instrument.Times(count=times, integration="8 s"),
            polarizations=("xx", "yy"),
        )
    )
    return subset_template(template, integration_times(template), template.freq_array[:channels])


@pytest.mark.parametrize("layout", [thirds, scattered, line])
def test_transforms_equal_products(layout, dipole_beam):
    enu = layout()
    delays, pairs = enu / SPEED_OF_LIGHT, all_pairs(len(enu))
    array = flat_array(delays, pairs)
    assert (array.lattice is None) == (layout is not thirds)
    pattern = power_pattern(dipole_beam.at(FREQUENCIES), FREQUENCIES, ["x", "y"])
    rng = np.random.default_rng(8)
    # The whole sky, down to the horizon.
    vectors = rng.normal(size=(3, 2000))
    vectors[2] = np.abs(vectors[2])
    vectors /= np.linalg.norm(vectors, axis=0)
    centre, flux = vectors.mean(axis=1), rng.normal(size=(2, 2000))
    index = np.zeros(len(enu), dtype=int)
    exact = PairSums(delays, pairs, FREQUENCIES, [pattern], index, np.float64).at(vectors, centre, flux)
    found = FlatSums(array, FREQUENCIES, pattern).at(vectors, centre, flux)
    error = np.abs(found - exact) / np.sqrt(np.mean(np.abs(exact) ** 2))
    assert np.sqrt(np.mean(error**2)) < 1e-6
    assert error.max() < 5e-6
    assert not FlatSums(array, FREQUENCIES, pattern).at(vectors[:, :0], centre, flux[:, :0]).any()


def test_an_array_with_heights_is_not_flat():
    enu = scattered()
    enu[3, 2] = 1e-3
    assert flat_array(enu / SPEED_OF_LIGHT, all_pairs(len(enu))) is None


def test_the_three_sectors_of_hera_have_one_lattice():
    vectors = baselines(make_layout(HeraLayout(kind="hera-350")).enu)
    basis = lattice_basis(vectors)
    assert np.linalg.norm(basis, axis=1) == pytest.approx(14.6 / np.sqrt(3))
    steps = vectors @ np.linalg.inv(basis)
    assert np.abs(steps - np.round(steps)).max() < 1e-7


def test_a_lattice_is_found_whatever_generates_it():
    basis = np.array([[3.0, 0.4], [-0.7, 2.5]])
    steps = np.random.default_rng(4).integers(-40, 40, (50, 2))
    found = lattice_basis(steps @ basis)
    assert abs(np.linalg.det(found)) == pytest.approx(abs(np.linalg.det(basis)))


def test_vectors_on_no_lattice_have_none():
    assert lattice_basis(baselines(scattered())) is None
    assert lattice_basis(baselines(line())) is None
    moved = baselines(thirds())
    moved[5] += 1e-5
    assert lattice_basis(moved) is None


@pytest.mark.parametrize("antennas", [thirds()[::4], scattered(5)], ids=["lattice", "scattered"])
def test_a_flat_array_agrees_with_pyuvsim(antennas, embedded_beam, monkeypatch, tmp_path):
    table = tmp_path / "antennas.csv"
    np.savetxt(table, antennas, delimiter=",", header="east_m,north_m,up_m", comments="")
    layout = CsvLayout(kind="csv", path=table)
    monkeypatch.setattr(patches, "product_seconds", lambda antennas, sources: np.inf)
    monkeypatch.setattr(PairSums, "at", None)
    template = observe_flat(layout)
    sky = random_sky(template)
    reference = PyuvsimEngine().simulate(sky, embedded_beam, template)
    found = DenseEngine(precision="single").simulate(sky, embedded_beam, template)
    assert np.abs(found - reference).max() < 3e-6 * np.sqrt(np.mean(np.abs(reference) ** 2))


@pytest.fixture(scope="module")
def many():
    """128 antennas of HERA for 112 s."""
    return observe_flat(HeraLayout(kind="hera-128"), times=15, channels=1)


def kind_of_sums(template, beam, dtype=np.float32, accuracy=EOR):
    """Return the grid that is chosen for a sky of nside 256, and what sums its patches."""
    array = patches.PatchedArray(beam, template, accuracy)
    sources, times = 12 * 256**2, time_axis(template, accuracy).nodes
    nside = array.choose_nside(sources, times, dtype)
    return nside, type(array.sums(template.freq_array, dtype, sources / (12 * nside**2), 0.7 / nside))


def test_many_antennas_in_a_plane_take_transforms(many, embedded_beam):
    nside, kind = kind_of_sums(many, embedded_beam)
    assert nside < 8
    assert kind is FlatSums
    assert kind_of_sums(many, embedded_beam, np.float64) == (8, PairSums)
    few = observe_flat(HexLayout(kind="hex", side=3))
    assert kind_of_sums(few, embedded_beam) == (8, PairSums)


def test_an_eor_is_exact_to_single_precision(many, embedded_beam):
    sky = healpix_sky(many.freq_array, nside=64)
    found = DenseEngine().interpolate(sky, embedded_beam, many, EOR)
    times = integration_times(many)[[3, 10]]
    exact = DenseEngine().interpolate(sky, embedded_beam, subset_template(many, times, many.freq_array), EXACT)
    error = np.abs(found[[3, 10]] - exact) / np.sqrt(np.mean(np.abs(exact) ** 2))
    assert np.sqrt(np.mean(error**2)) < 1e-6
    assert np.sqrt(np.mean(error**2, axis=(0, 2, 3))).max() < 3e-6


def test_plans_know_that_many_regular_antennas_take_less(many):
    def seconds(antennas, regular):
        return DenseEngine().cost(SimulationSize(8e5, 400.0, 100.0, antennas, 1, 1e-4, regular)).seconds

    assert seconds(350, regular=True) < 0.3 * seconds(350, regular=False)
    assert seconds(19, regular=True) == seconds(19, regular=False)
