"""Patches of sources, simulated at few nodes, give what every source at every slot gives."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import healpix_sky, local_coordinates, observe, point_sky, relative_error

from calstudy.instrument.interface import AntennaBeams
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.nodes import Accuracy, integration_times, patch_nside, time_axis
from calstudy.simulate.patches import Patches
from calstudy.simulate.source_sums import PairSums
from calstudy.simulate.sources import SourceTracks

ENGINE = DenseEngine()
CHANNELS = Accuracy(1e-4, beam_extent=20.0, smooth_sky=False)
SMOOTH = Accuracy(1e-9, beam_extent=20.0)


@pytest.fixture(scope="module")
def template():
    """36 tiles at their heights, to 176 m, for 112 s: both polarizations."""
    return observe(count=36, channels=3, width="640 kHz", times=28, integration="4 s")


@pytest.fixture(scope="module")
def eor(template):
    return healpix_sky(template.freq_array, nside=64)


@pytest.fixture(scope="module")
def eor_direct(template, eor, embedded_beam):
    return ENGINE.simulate(eor, embedded_beam, template)


@pytest.fixture(scope="module")
def wide():
    """8 MHz in 40 channels."""
    return observe(count=20, channels=40, width="200 kHz", times=8, integration="15 s", polarizations=("xx",))


@pytest.fixture(scope="module")
def sources(wide):
    """Return as many sources as make many patches, over the whole sky, with spectral indices."""
    rng, count = np.random.default_rng(11), 40_000
    coordinates = local_coordinates(wide, np.arcsin(rng.uniform(-1, 1, count)), rng.uniform(0, 2 * np.pi, count))
    return point_sky(coordinates, rng.pareto(1.6, count), rng.normal(-0.8, 0.2, count))


def worst_baseline(cube, reference):
    """Return the largest rms difference on a baseline over the rms of the reference."""
    difference = np.sqrt(np.mean(np.abs(cube - reference) ** 2, axis=(0, 2, 3)))
    return difference.max() / np.sqrt(np.mean(np.abs(reference) ** 2))


def rms_error(cube, reference):
    return np.sqrt(np.mean(np.abs(cube - reference) ** 2) / np.mean(np.abs(reference) ** 2))


def test_an_eor_is_exact_to_a_hundredth_of_the_tolerance(template, eor, embedded_beam, eor_direct):
    cube = ENGINE.interpolate(eor, embedded_beam, template, CHANNELS)
    assert rms_error(cube, eor_direct) < 1e-2 * CHANNELS.tolerance
    assert worst_baseline(cube, eor_direct) < 5e-2 * CHANNELS.tolerance


def test_double_precision_is_exact_to_a_tight_tolerance(template, eor, embedded_beam, eor_direct):
    tight = Accuracy(1e-9, beam_extent=20.0, smooth_sky=False)
    assert relative_error(ENGINE.interpolate(eor, embedded_beam, template, tight), eor_direct) < 1e-8


def test_a_smooth_sky_is_exact_to_its_tolerance(wide, sources, embedded_beam):
    direct = ENGINE.simulate(sources, embedded_beam, wide)
    cube = ENGINE.interpolate(sources, embedded_beam, wide, SMOOTH)
    assert rms_error(cube, direct) < 2e-9
    assert relative_error(cube, direct) < 1e-8


@pytest.mark.chain
def test_several_beams_have_patches_too(embedded_beam, dipole_beam):
    template = observe(count=12, channels=3, width="640 kHz", times=14, integration="8 s")
    beams = AntennaBeams((embedded_beam, dipole_beam), np.arange(12) % 2)
    sky = healpix_sky(template.freq_array, nside=32)
    assert patch_nside(sky.Ncomponents) == 1
    direct = ENGINE.simulate(sky, beams, template)
    assert rms_error(ENGINE.interpolate(sky, beams, template, CHANNELS), direct) < 1e-2 * CHANNELS.tolerance


def test_patches_take_fewer_products(template, eor, embedded_beam, monkeypatch):
    done, exact = [], PairSums.at
    monkeypatch.setattr(
        PairSums, "at", lambda self, vectors, *rest: done.append(vectors.shape[1]) or exact(self, vectors, *rest)
    )
    ENGINE.interpolate(eor, embedded_beam, template, CHANNELS)
    up = eor.Ncomponents / 2
    assert sum(done) < 0.7 * len(time_axis(template, CHANNELS).nodes) * up


def test_the_tolerance_bounds_the_error_whatever_it_is(template, eor, embedded_beam, eor_direct):
    errors = [
        rms_error(
            DenseEngine(precision="double").interpolate(
                eor, embedded_beam, template, Accuracy(tolerance, 20.0, smooth_sky=False)
            ),
            eor_direct,
        )
        for tolerance in (1e-2, 1e-4, 1e-6)
    ]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert all(error < tolerance for error, tolerance in zip(errors, (1e-2, 1e-4, 1e-6), strict=True))


def test_patches_hold_each_source_once_and_are_small(template, eor):
    times = integration_times(template)
    tracks = SourceTracks.of(eor, template.telescope.location, times)
    chosen = np.arange(0, eor.Ncomponents, 3)
    patches = Patches(eor, tracks, chosen, nside=4)
    assert np.array_equal(np.sort(patches.components), chosen)
    assert [place for members in patches.members for place in range(members.start, members.stop)] == list(
        range(len(chosen))
    )
    for members, centre, radius in zip(patches.members, patches.centres.vectors[0].T, patches.radii, strict=True):
        distances = np.linalg.norm(patches.tracks.vectors[0][:, members] - centre[:, None], axis=0)
        assert distances.max() == pytest.approx(radius)
    # The largest cell of this grid: 0.26 rad from its centre to a corner.
    assert patches.radii.max() < 0.3
    # The centre of a patch moves as a source does.
    later = patches.tracks.at(times[-1])
    for place, members in enumerate(patches.members[:5]):
        np.testing.assert_allclose(patches.centres.at(times[-1])[:, place], later[:, members].mean(axis=1), atol=1e-12)


@pytest.mark.parametrize(("components", "nside"), [(100, 0), (8400, 1), (12 * 64**2, 2), (546_000, 8), (786_432, 8)])
def test_patches_have_about_as_many_sources_as_a_product(components, nside):
    assert patch_nside(components) == nside


def test_a_patch_below_the_noise_of_the_others_may_be_zero(template, dipole_beam):
    """Sources of 0 Jy are no reason to fail, whatever patch they are in."""
    sky = healpix_sky(template.freq_array, nside=32)
    sky.stokes[0, :, 5000:] = 0
    direct = ENGINE.simulate(sky, dipole_beam, template)
    assert relative_error(ENGINE.interpolate(sky, dipole_beam, template, CHANNELS), direct) < CHANNELS.tolerance
    sky.stokes[:] = 0
    assert not ENGINE.interpolate(sky, dipole_beam, template, CHANNELS).any()


@pytest.mark.parametrize("stretch", [1, 20])
def test_single_precision_serves_long_arrays_and_wide_bands(stretch, dipole_beam):
    """Over 30 MHz fringes of kilometres turn hundreds of times, where a sky of few sources is one patch."""
    template = observe(count=12, channels=16, width="2 MHz", times=6, integration="20 s", polarizations=("xx",))
    template.telescope.antenna_positions *= stretch
    rng, count = np.random.default_rng(3), 500
    coordinates = local_coordinates(template, np.arcsin(rng.uniform(-1, 1, count)), rng.uniform(0, 2 * np.pi, count))
    sky = point_sky(coordinates, rng.exponential(1, count))
    loose = Accuracy(1e-5, beam_extent=20.0)
    direct = ENGINE.simulate(sky, dipole_beam, template)
    assert relative_error(ENGINE.interpolate(sky, dipole_beam, template, loose), direct) < loose.tolerance


def test_a_map_may_have_its_pixels_in_any_order(template, dipole_beam):
    sky = healpix_sky(template.freq_array, nside=8)
    order = np.random.default_rng(8).permutation(sky.Ncomponents)
    shuffled = sky.copy()
    shuffled.hpx_inds, shuffled.stokes = sky.hpx_inds[order], sky.stokes[:, :, order]
    direct = ENGINE.simulate(sky, dipole_beam, template)
    assert relative_error(ENGINE.simulate(shuffled, dipole_beam, template), direct) < 1e-12
