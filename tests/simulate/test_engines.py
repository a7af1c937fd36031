"""Engines against each other and against closed forms."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import AltAz, SkyCoord
from astropy.time import Time
from pydantic import ValidationError
from pyradiosky import SkyModel
from pyuvdata.analytic_beam import UniformBeam
from scipy.constants import speed_of_light
from simulation_cases import (
    ALL_ENGINES,
    FAST_ENGINES,
    healpix_sky,
    local_coordinates,
    needs_engines,
    observe,
    point_sky,
    random_sky,
    relative_error,
)

from calstudy.base.errors import InputError
from calstudy.base.visibilities import baseline_vectors, subset_template
from calstudy.instrument.beams import ExactBeam
from calstudy.simulate.engines.dense import DenseEngine, FastestEngine
from calstudy.simulate.engines.other_packages import FftvisEngine, MatvisEngine, PyuvsimEngine
from calstudy.simulate.interface import simulate_with
from calstudy.simulate.settings import SimulationSettings


@pytest.fixture(scope="module")
def template():
    return observe()


@pytest.fixture(scope="module")
def sky(template):
    return random_sky(template)


def pyuvsim_visibilities(name, request, sky, template):
    """Return a beam and pyuvsim's visibilities of it."""
    beam = request.getfixturevalue(name)
    return beam, PyuvsimEngine().simulate(sky, beam, template)


def test_the_test_sky_is_hard(template, sky):
    heights = template.telescope.get_enu_antpos()[:, 2]
    assert np.ptp(heights) > 0.05
    assert sky.spectral_index.std() > 0.1


@pytest.mark.parametrize("name", ["tile_beam", "embedded_beam", "gaussian_beam", "dipole_beam"])
def test_dense_agrees_with_pyuvsim_to_rounding(name, request, sky, template):
    beam, expected = pyuvsim_visibilities(name, request, sky, template)
    assert relative_error(DenseEngine().simulate(sky, beam, template), expected) < 1e-12


@needs_engines
@pytest.mark.parametrize("name", ["embedded_beam", "dipole_beam"])
def test_fftvis_agrees_with_pyuvsim(name, request, sky):
    # It takes a quarter of a second for each integration, channel and pair of feeds.
    template = observe(channels=2, times=2)
    beam, expected = pyuvsim_visibilities(name, request, sky, template)
    assert relative_error(FftvisEngine().simulate(sky, beam, template), expected) < 1e-10


@needs_engines
@pytest.mark.parametrize("name", ["embedded_beam", "dipole_beam"])
def test_matvis_agrees_with_pyuvsim(name, request, sky, template):
    beam, expected = pyuvsim_visibilities(name, request, sky, template)
    assert relative_error(MatvisEngine().simulate(sky, beam, template), expected) < 1e-11
    assert 1e-7 < relative_error(MatvisEngine(precision="single").simulate(sky, beam, template), expected) < 1e-3


def test_single_precision_is_single(sky, template, tile_beam):
    double = DenseEngine().simulate(sky, tile_beam, template)
    error = relative_error(DenseEngine(precision="single").simulate(sky, tile_beam, template), double)
    assert 1e-9 < error < 1e-5


@pytest.mark.parametrize("engine", FAST_ENGINES)
def test_channel_by_channel_healpix_sky_in_kelvin(engine, tile_beam):
    template = observe(channels=2, times=1)
    sky = healpix_sky(template.freq_array)
    expected = PyuvsimEngine().simulate(sky, tile_beam, template)
    limits = {"dense": 1e-12, "matvis": 1e-11, "fftvis": 1e-10}
    assert relative_error(engine.simulate(sky, tile_beam, template), expected) < limits[engine.label]


@pytest.mark.parametrize("engine", [DenseEngine(), PyuvsimEngine()], ids=lambda engine: engine.label)
def test_a_sky_by_channel_has_its_channels_in_every_part_of_the_band(engine, tile_beam):
    """A simulation in pieces gives an engine a part of the channels, and the whole sky."""
    whole = observe(channels=3, times=1)
    sky = random_sky(whole, count=20)
    sky.at_frequencies(whole.freq_array * units.Hz)
    expected = engine.simulate(sky, tile_beam, whole)
    for channel in range(3):
        part = subset_template(whole, np.unique(whole.time_array), whole.freq_array[channel : channel + 1])
        found = engine.simulate(sky, tile_beam, part)
        assert relative_error(found[:, :, 0], expected[:, :, channel]) < 1e-12


@pytest.mark.parametrize("engine", ALL_ENGINES)
def test_antenna_numbers_in_any_order_are_the_antennas_of_their_positions(engine, gaussian_beam):
    """One source: the phase is that of the positions of the two antennas."""
    template = observe(channels=1, times=1, polarizations=("xx",))
    numbers = np.array([7, 3, 5, 1, 9])
    before = template.telescope.antenna_numbers
    renumbered = template.copy()
    renumbered.telescope.antenna_numbers = numbers
    places = np.searchsorted(before, [renumbered.ant_1_array, renumbered.ant_2_array])
    renumbered.ant_1_array, renumbered.ant_2_array = numbers[places]
    renumbered.baseline_array = renumbered.antnums_to_baseline(renumbered.ant_1_array, renumbered.ant_2_array)
    sky = point_sky(local_coordinates(template, np.array([1.2]), np.array([0.5])), [3.0])
    expected, found = (engine.simulate(sky, gaussian_beam, uvd) for uvd in (template, renumbered))
    assert relative_error(found, expected) < 1e-9


def test_polarizations_keep_their_place(sky, tile_beam):
    both = observe(channels=1, times=1)
    for engine in (DenseEngine(), PyuvsimEngine()):
        cube = engine.simulate(sky, tile_beam, both)
        for column, polarization in enumerate(("xx", "yy")):
            alone = engine.simulate(sky, tile_beam, observe(channels=1, times=1, polarizations=(polarization,)))
            np.testing.assert_allclose(alone[..., 0], cube[..., column], rtol=1e-12)
        assert relative_error(cube[..., 0], cube[..., 1]) > 1e-2


def test_a_source_at_zenith_gives_half_its_flux_with_the_phase_of_the_heights(gaussian_beam):
    template = observe(times=1)
    zenith = local_coordinates(template, np.array([np.pi / 2]), np.array([0.0]))
    cube = DenseEngine().simulate(point_sky(zenith, [3.0]), gaussian_beam, template)
    turns = baseline_vectors(template)[:, 2, None] * template.freq_array / speed_of_light
    expected = np.broadcast_to(1.5 * np.exp(2j * np.pi * turns)[None, :, :, None], cube.shape)
    np.testing.assert_allclose(cube, expected, rtol=1e-7)


@pytest.mark.parametrize("engine", [DenseEngine(), PyuvsimEngine()], ids=lambda engine: engine.label)
def test_a_source_anywhere_gives_the_power_of_a_short_dipole_and_the_phase_of_its_direction(engine, dipole_beam):
    template = observe(times=1)
    altitude, azimuth = np.deg2rad(35.0), np.deg2rad(110.0)
    sky = point_sky(local_coordinates(template, np.array([altitude]), np.array([azimuth])), [3.0])
    # Azimuth of coordinates from north through east.
    direction = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    turns = (baseline_vectors(template) @ direction)[:, None] * template.freq_array / speed_of_light
    # A dipole does not see what comes along its axis: east for xx, north for yy.
    power = 1 - direction[:2] ** 2
    expected = 1.5 * np.exp(2j * np.pi * turns)[None, :, :, None] * power
    np.testing.assert_allclose(engine.simulate(sky, dipole_beam, template), expected, rtol=1e-7)


def test_a_uniform_hemisphere_gives_a_sinc():
    """The integral of exp(2 pi i u.s) over a hemisphere has the real part 2 pi sin(x) / x, x = 2 pi |u|."""
    template = observe(count=2, times=1, channels=2, polarizations=("xx",))
    beam = ExactBeam(UniformBeam(), "uniform", "for this test")
    nside = 128
    pixels = np.arange(12 * nside**2)
    stokes = np.zeros((4, 1, len(pixels)))
    stokes[0] = 2.0
    sky = SkyModel(
        component_type="healpix",
        nside=nside,
        hpx_order="ring",
        hpx_inds=pixels,
        frame="icrs",
        stokes=stokes * units.Jy / units.sr,
        spectral_type="flat",
    )
    cube = DenseEngine().simulate(sky, beam, template)[0, 0, :, 0]
    x = 2 * np.pi * template.freq_array / speed_of_light * np.linalg.norm(baseline_vectors(template)[0])
    # The pixels end raggedly at the horizon: their size bounds the error.
    assert np.abs(cube.real - 2 * np.pi * np.sinc(x / np.pi)).max() < 2 * np.pi / nside


def test_visibilities_add_up_and_ignore_the_order_of_sources(sky, template, tile_beam):
    engine = DenseEngine()
    whole = engine.simulate(sky, tile_beam, template)
    shuffled = np.random.default_rng(1).permutation(sky.Ncomponents)
    parts = [sky.select(component_inds=part, inplace=False) for part in np.array_split(shuffled, 3)]
    assert relative_error(sum(engine.simulate(part, tile_beam, template) for part in parts), whole) < 1e-13


def test_no_source_above_the_horizon_gives_zeros(template, tile_beam):
    nadir = local_coordinates(template, np.array([-1.5]), np.array([0.0]))
    assert not DenseEngine().simulate(point_sky(nadir, [1.0]), tile_beam, template).any()


@pytest.mark.parametrize("engine", ALL_ENGINES)
def test_arguments_are_not_changed(engine, sky, embedded_beam):
    template = observe(channels=1, times=1)
    sky_before, template_before = sky.copy(), template.copy()
    engine.simulate(sky, embedded_beam, template)
    assert sky == sky_before
    assert template == template_before


def test_auto_takes_the_fastest_that_can(sky, template, tile_beam):
    auto = SimulationSettings().engine
    assert isinstance(auto, FastestEngine)
    assert auto.choose(sky, tile_beam, template).label == "dense"
    polarized = point_sky(sky.skycoord[:2], [1.0, 1.0], polarization=(0.3, 0, 0))
    assert auto.choose(polarized, tile_beam, template).label == "pyuvsim"
    expected = PyuvsimEngine().simulate(polarized, tile_beam, template)
    assert relative_error(auto.simulate(polarized, tile_beam, template), expected) < 1e-12
    with pytest.raises(InputError, match=r"simulation\.engine = 'dense': .*polarized sky"):
        simulate_with(DenseEngine(), polarized, tile_beam, template)


@pytest.mark.parametrize("azimuth", [0.3, 1.9, 3.5, 5.1])
@pytest.mark.parametrize("altitude", [1.5, 0.6])
@pytest.mark.parametrize("fractions", [(0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5), (0.2, -0.3, 0.4)])
def test_a_polarized_source_is_received_along_its_own_field(dipole_beam, altitude, azimuth, fractions):
    """<E_N E_N*> = (I + Q) / 2, <E_E E_E*> = (I - Q) / 2, <E_N E_E*> = (U + iV) / 2, on dipoles along x and y.

    Q and U are those of the IAU. The sign of V, that of pyuvsim, depends on the sign of phases in time.
    """
    template = observe(count=2, channels=1, times=1)
    template.polarization_array = np.array([-5, -7])  # xx and xy
    place = local_coordinates(template, np.array([altitude]), np.array([azimuth]))
    plain = PyuvsimEngine().simulate(point_sky(place, [2.0]), dipole_beam, template)
    found = PyuvsimEngine().simulate(point_sky(place, [2.0], polarization=fractions), dipole_beam, template)
    found = found[0, 0, 0] * (plain[0, 0, 0, 0] / abs(plain[0, 0, 0, 0])).conj()

    frame = AltAz(obstime=Time(template.time_array[0], format="jd"), location=template.telescope.location)
    # From north, east and up to east, north and up.
    pole, source = (at.transform_to(frame).cartesian.xyz.value[[1, 0, 2]] for at in (SkyCoord("0h +90d"), place[0]))
    east = np.cross(pole, source)
    east /= np.linalg.norm(east)
    north = np.cross(source, east)
    q, u, v = fractions
    fields = np.stack([north, east])[:, :2]
    received = fields.T @ np.array([[1 + q, u + 1j * v], [u - 1j * v, 1 - q]]) @ fields
    # Aberration turns directions by 1e-4.
    assert found == pytest.approx(received[0], abs=1e-3)


def test_engines_are_chosen_by_name():
    for name in ("dense", "matvis", "fftvis", "pyuvsim"):
        assert SimulationSettings(engine=name).engine.label == name
    with pytest.raises(ValidationError, match=r"precision\s+Extra inputs"):
        SimulationSettings.model_validate({"engine": "dense", "precision": "single"})
    assert SimulationSettings(engine={"precision": "single"}).engine == FastestEngine(precision="single")


@pytest.fixture(scope="module")
def crossed():
    """A template of the cross-hands xy, which only pyuvsim has."""
    template = observe(channels=1, times=1, polarizations=("xx",))
    template.polarization_array = np.array([-7])
    return template


@needs_engines
def test_cross_hands_go_to_an_engine_that_has_them(sky, tile_beam, crossed):
    assert SimulationSettings().engine.choose(sky, tile_beam, crossed).label == "pyuvsim"
    for engine in (DenseEngine(), MatvisEngine(), FftvisEngine()):
        assert "polarization number" in engine.refusal(sky, tile_beam, crossed)


def test_without_their_packages_engines_say_so_and_auto_goes_on(monkeypatch, sky, tile_beam, crossed):
    for name, engine in (("matvis", MatvisEngine()), ("fftvis", FftvisEngine())):
        monkeypatch.setitem(sys.modules, name, None)
        sentence = rf"'{name}': needs the package {name}, which is not installed: pip install 'calstudy\[engines\]'"
        with pytest.raises(InputError, match=sentence):
            simulate_with(engine, sky, tile_beam, crossed)
    assert SimulationSettings().engine.choose(sky, tile_beam, crossed).label == "pyuvsim"


def test_a_galactic_sky_is_where_it_should_be(template, tile_beam):
    icrs = SkyCoord([30, 60] * units.deg, [-30, -20] * units.deg)
    engine = DenseEngine()
    np.testing.assert_allclose(
        engine.simulate(point_sky(icrs.galactic, [1.0, 2.0]), tile_beam, template),
        engine.simulate(point_sky(icrs, [1.0, 2.0]), tile_beam, template),
        rtol=1e-11,
    )
