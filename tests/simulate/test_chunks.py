"""Nodes, horizon crossers and chunks together give what a direct simulation gives."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from simulation_cases import healpix_sky, observe, random_sky, relative_error

from calstudy.base.visibilities import subset_template
from calstudy.experiment.files import validate
from calstudy.products import simulation
from calstudy.products.graph import Graph
from calstudy.simulate.chunks import (
    Component,
    assemble,
    check_interpolation,
    plan_chunks,
    simulate_chunk,
    simulate_visibilities,
)
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import PyuvsimEngine
from calstudy.simulate.nodes import EXACT, Accuracy, frequency_axis, integration_times, time_axis
from calstudy.simulate.sources import SourceTracks, split_by_horizon

ENGINE = DenseEngine()


@pytest.fixture(scope="module")
def template():
    """36 tiles to 176 m for 112 s, 70 channels over 8 MHz."""
    return observe(count=36, channels=70, width="115 kHz", times=28, integration="4 s", polarizations=("xx",))


@pytest.fixture(scope="module")
def sky(template):
    return random_sky(template, count=90)


@pytest.fixture(scope="module")
def direct(template, sky, dipole_beam):
    return ENGINE.simulate(sky, dipole_beam, template)


def accuracy(tolerance=1e-9, smooth_sky=True):
    return Accuracy(tolerance, beam_extent=20.0, smooth_sky=smooth_sky)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-7, 1e-10])
@pytest.mark.parametrize("count", [1, 3])
def test_all_samples_are_within_the_tolerance(tolerance, count, template, sky, dipole_beam, direct):
    chunks = plan_chunks(template, accuracy(tolerance), count)
    assert len(time_axis(template, accuracy(tolerance)).nodes) < 0.65 * template.Ntimes
    assert len(chunks[0].axis.nodes) < 0.6 * template.Nfreqs
    cubes = [simulate_chunk(ENGINE, sky, dipole_beam, template, chunk) for chunk in chunks]
    assert len(cubes) == count
    assert relative_error(assemble(chunks, cubes), direct) < tolerance


def test_the_sources_that_rise_or_set_are_what_makes_it_exact(template, sky, dipole_beam, direct):
    axis = time_axis(template, accuracy())
    naive = ENGINE.simulate(sky, dipole_beam, subset_template(template, axis.nodes, template.freq_array))
    assert relative_error(axis.interpolate(naive), direct) > 1e-6


@pytest.mark.parametrize("smooth_sky", [True, False])
def test_chunking_changes_nothing(smooth_sky, template, sky, dipole_beam):
    once, often = (
        simulate_visibilities(ENGINE, sky, dipole_beam, template, accuracy(1e-10, smooth_sky), count)
        for count in (1, 8)
    )
    # Parts of the sky have patches of their own; blocks of channels have not.
    assert relative_error(often, once) < (1e-10 if smooth_sky else 1e-12)


def test_chunks_of_channels_partition_them(template):
    chunks = plan_chunks(template, accuracy(smooth_sky=False), 7)
    np.testing.assert_array_equal(np.concatenate([chunk.frequencies for chunk in chunks]), template.freq_array)
    sizes = [len(chunk.frequencies) for chunk in chunks]
    assert max(sizes) - min(sizes) <= 1


def test_chunks_of_a_smooth_sky_partition_its_sources(template, sky):
    chunks = plan_chunks(template, accuracy(), 7)
    names = [chunk.select(sky).name for chunk in chunks]
    assert sorted(np.concatenate(names)) == sorted(sky.name)
    assert all(chunk.frequencies is not None and len(chunk.frequencies) == len(chunk.axis.nodes) for chunk in chunks)


def test_large_chunks_of_a_smooth_sky_are_split_by_frequency_first(template, monkeypatch):
    monkeypatch.setattr("calstudy.simulate.nodes.CHUNK_BYTES", 4e6)
    chunks = plan_chunks(template, accuracy(), 8)
    nodes, times = len(chunks[0].axis.nodes), template.Ntimes
    assert max(len(chunk.frequencies) for chunk in chunks) * times * template.Nbls * 16 < 1.1 * 4e6
    covered = [(chunk.part, node) for chunk in chunks for node in range(nodes)[chunk.nodes]]
    parts = chunks[0].part[1]
    assert sorted(covered) == [((part, parts), node) for part in range(parts) for node in range(nodes)]
    assert len(chunks) <= 8


@pytest.mark.parametrize("chunks", [1, 4, 64])
def test_plans_have_a_task_for_every_chunk(chunks, tmp_path):
    data = {
        "name": "many",
        "instrument": {"layout": {"kind": "hex", "side": 2}, "beam": "gaussian", "channels": {"count": 8}},
        "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 50}, "eor": {"nside": 16}},
        "simulation": {"chunks": chunks},
    }
    experiment = validate(data, tmp_path)
    graph = Graph(experiment)
    for task, sky in ((simulation.foregrounds(graph), "foregrounds"), (simulation.eor(graph), "eor")):
        settings = getattr(experiment.sky, sky)
        component = Component(experiment.instrument, experiment.simulation, settings, "Planck15")
        assert len(task.pieces) >= len(component.chunks)


def test_a_sky_given_channel_by_channel_needs_only_the_chunks_channels(dipole_beam):
    template = observe(count=36, channels=8, width="80 kHz", times=28, integration="4 s", polarizations=("xx",))
    sky = healpix_sky(template.freq_array)
    direct = ENGINE.simulate(sky, dipole_beam, template)
    chunks = plan_chunks(template, accuracy(smooth_sky=False), 4)
    cubes = []
    for chunk in chunks:
        part = healpix_sky(template.freq_array)
        part.stokes, part.freq_array = sky.stokes[:, chunk.nodes], sky.freq_array[chunk.nodes]
        part.Nfreqs = len(part.freq_array)
        cubes.append(simulate_chunk(ENGINE, part, dipole_beam, template, chunk))
    cube = assemble(chunks, cubes)
    assert relative_error(cube, direct) < 1e-9
    simulate = partial(ENGINE.simulate, part, dipole_beam)
    check = check_interpolation(simulate, template, cube, chunks[0], channels=chunks[-1].nodes)
    assert set(check["frequencies"]) <= set(chunks[-1].frequencies)
    assert check["max_error"] < 1e-9


def test_what_more_nodes_do_not_lower_are_the_knots_of_a_tabulated_beam(embedded_beam, tile_beam):
    template = observe(count=12, channels=1, times=28, integration="4 s", polarizations=("xx",))
    sky = healpix_sky(template.freq_array, nside=16)
    times = integration_times(template)
    tracks = SourceTracks.of(sky, template.telescope.location, times)
    sky.select(component_inds=split_by_horizon(tracks, times)[0], run_check=False)
    errors = {}
    for name, beam in (("table", embedded_beam), ("formula", tile_beam)):
        direct = ENGINE.simulate(sky, beam, template)
        for tolerance in (1e-9, 1e-13):
            axis = time_axis(template, accuracy(tolerance))
            nodes = ENGINE.simulate(sky, beam, subset_template(template, axis.nodes, template.freq_array))
            errors[name, tolerance] = relative_error(axis.interpolate(nodes), direct)
    assert errors["formula", 1e-9] < 1e-10
    assert errors["table", 1e-13] > 0.2 * errors["table", 1e-9] > 2 * errors["formula", 1e-9]
    assert errors["table", 1e-9] < 1e-8


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_the_check_finds_the_error_that_is_there(tolerance, template, sky, dipole_beam, direct):
    chunks = plan_chunks(template, accuracy(tolerance), 1)
    cube = assemble(chunks, [simulate_chunk(ENGINE, sky, dipole_beam, template, chunks[0])])
    check = check_interpolation(partial(ENGINE.simulate, sky, dipole_beam), template, cube, chunks[0])
    worst = relative_error(cube, direct)
    assert 0.1 * worst < check["max_error"] <= 1.5 * worst
    assert check["rms_error"] <= check["max_error"]
    assert set(check["times_jd"]) <= set(integration_times(template))


def test_sources_that_are_not_up_when_it_is_checked_have_an_error(template, dipole_beam):
    chunks = plan_chunks(template, accuracy(1e-6), 1)
    cube = np.ones((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), complex)
    check = check_interpolation(lambda part: np.zeros(_shape(part)), template, cube, chunks[0])
    assert (check["max_error"], check["rms_error"]) == (1, 1)


def _shape(part):
    return part.Ntimes, part.Nbls, part.Nfreqs, part.Npols


def test_nodes_serve_any_engine(dipole_beam):
    template = observe(count=3, channels=14, width="140 kHz", times=14, integration="8 s", polarizations=("xx",))
    sky = random_sky(template, count=12)
    direct = PyuvsimEngine().simulate(sky, dipole_beam, template)
    assert not time_axis(template, accuracy(1e-8)).at_samples
    assert not frequency_axis(template, accuracy(1e-8)).at_samples
    nodes = simulate_visibilities(PyuvsimEngine(), sky, dipole_beam, template, accuracy(1e-8), count=2)
    assert relative_error(nodes, direct) < 1e-8
    exact = simulate_visibilities(PyuvsimEngine(), sky, dipole_beam, template, EXACT)
    assert relative_error(exact, direct) < 1e-14
