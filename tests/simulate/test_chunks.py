"""Nodes, horizon crossers and chunks together give what a direct simulation gives."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from simulation_cases import healpix_sky, observe, random_sky, relative_error

from calstudy.instrument.telescope import subset_template
from calstudy.simulate.chunks import assemble, check_interpolation, plan_chunks, simulate_chunk, simulate_visibilities
from calstudy.simulate.directions import split_by_horizon
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.pyuvsim import PyuvsimEngine
from calstudy.simulate.nodes import integration_times, node_grid
from calstudy.simulate.settings import Nodes, SimulationSettings


@pytest.fixture(scope="module")
def template():
    """36 tiles to 176 m for 112 s, 100 channels over 8 MHz."""
    return observe(count=36, channels=100, width="80 kHz", times=28, integration="4 s", polarizations=("xx",))


@pytest.fixture(scope="module")
def sky(template):
    return random_sky(template, count=90)


@pytest.fixture(scope="module")
def direct(template, sky, dipole_beam):
    return DenseEngine().simulate(sky, dipole_beam, template)


def settings(tolerance=1e-9, chunks=3):
    return SimulationSettings(nodes=Nodes(tolerance=tolerance), chunks=chunks)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-7, 1e-10])
def test_all_samples_are_within_the_tolerance(tolerance, template, sky, dipole_beam, direct):
    chunks = plan_chunks(template, settings(tolerance), smooth_in_frequency=True)
    grid = chunks[0].grid
    assert len(grid.times_jd) * len(grid.frequencies) < 0.4 * template.Ntimes * template.Nfreqs
    cubes = [simulate_chunk(DenseEngine(), sky, dipole_beam, template, chunk) for chunk in chunks]
    assert relative_error(assemble(chunks, cubes), direct) < tolerance


def test_the_sources_that_rise_or_set_are_what_makes_it_exact(template, sky, dipole_beam, direct):
    grid = node_grid(template, Nodes(), smooth_in_frequency=False)
    naive = DenseEngine().simulate(sky, dipole_beam, subset_template(template, grid.times_jd, grid.frequencies))
    assert relative_error(grid.interpolate(naive), direct) > 1e-6


@pytest.mark.parametrize("chunks", [1, 8])
def test_chunking_changes_nothing(chunks, template, sky, dipole_beam):
    whole = simulate_visibilities(DenseEngine(), sky, dipole_beam, template, settings(chunks=3), True)
    pieces = simulate_visibilities(DenseEngine(), sky, dipole_beam, template, settings(chunks=chunks), True)
    assert relative_error(pieces, whole) < 1e-12


def test_chunks_partition_the_nodes(template):
    chunks = plan_chunks(template, settings(chunks=7), smooth_in_frequency=True)
    np.testing.assert_array_equal(np.concatenate([chunk.frequencies for chunk in chunks]), chunks[0].grid.frequencies)
    sizes = [len(chunk.frequencies) for chunk in chunks]
    assert max(sizes) - min(sizes) <= 1
    with pytest.raises(ValueError, match="not channels"):
        _ = chunks[0].channels


def test_a_sky_given_channel_by_channel_needs_only_the_chunks_channels(dipole_beam):
    template = observe(count=36, channels=8, width="80 kHz", times=28, integration="4 s", polarizations=("xx",))
    sky = healpix_sky(template.freq_array)
    direct = DenseEngine().simulate(sky, dipole_beam, template)
    chunks = plan_chunks(template, settings(chunks=4), smooth_in_frequency=False)
    cubes = []
    for chunk in chunks:
        part = healpix_sky(template.freq_array)
        part.stokes, part.freq_array = sky.stokes[:, chunk.channels], sky.freq_array[chunk.channels]
        part.Nfreqs = len(part.freq_array)
        cubes.append(simulate_chunk(DenseEngine(), part, dipole_beam, template, chunk))
    assert len(chunks[0].grid.times_jd) < template.Ntimes
    cube = assemble(chunks, cubes)
    assert relative_error(cube, direct) < 1e-9
    simulate = partial(DenseEngine().simulate, part, dipole_beam)
    check = check_interpolation(simulate, template, cube, chunks[0].grid, channels=chunks[-1].channels)
    assert set(check.frequencies) <= set(chunks[-1].frequencies)
    assert check.max_error < 1e-9


def test_what_more_nodes_do_not_lower_are_the_knots_of_a_tabulated_beam(embedded_beam, tile_beam):
    template = observe(count=12, channels=1, times=28, integration="4 s", polarizations=("xx",))
    sky = healpix_sky(template.freq_array, nside=16)
    always_up, _ = split_by_horizon(sky, template.telescope.location, integration_times(template))
    sky.select(component_inds=always_up, run_check=False)
    errors = {}
    for name, beam in (("table", embedded_beam), ("formula", tile_beam)):
        direct = DenseEngine().simulate(sky, beam, template)
        for tolerance in (1e-9, 1e-13):
            grid = node_grid(template, Nodes(tolerance=tolerance), smooth_in_frequency=False)
            nodes = DenseEngine().simulate(sky, beam, subset_template(template, grid.times_jd, grid.frequencies))
            errors[name, tolerance] = relative_error(grid.interpolate(nodes), direct)
    assert errors["formula", 1e-9] < 1e-10
    assert errors["table", 1e-13] > 0.2 * errors["table", 1e-9] > 2 * errors["formula", 1e-9]
    assert errors["table", 1e-9] < 1e-8


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_the_check_finds_the_error_that_is_there(tolerance, template, sky, dipole_beam, direct):
    loose = settings(tolerance)
    cube = simulate_visibilities(DenseEngine(), sky, dipole_beam, template, loose, True)
    grid = plan_chunks(template, loose, True)[0].grid
    check = check_interpolation(partial(DenseEngine().simulate, sky, dipole_beam), template, cube, grid)
    worst = relative_error(cube, direct)
    assert 0.1 * worst < check.max_error <= 1.5 * worst
    assert check.rms_error <= check.max_error
    assert set(check.times_jd) <= set(integration_times(template))


def test_nodes_serve_any_engine(dipole_beam):
    template = observe(count=3, channels=24, width="80 kHz", times=14, integration="8 s", polarizations=("xx",))
    sky = random_sky(template, count=12)
    direct = PyuvsimEngine().simulate(sky, dipole_beam, template)
    nodes = simulate_visibilities(PyuvsimEngine(), sky, dipole_beam, template, settings(1e-8, chunks=2), True)
    assert relative_error(nodes, direct) < 1e-8
