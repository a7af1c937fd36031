"""Visibilities of diffuse emission, against pyuvsim on the map in kelvin, and against closed forms."""

from __future__ import annotations

import healpy
import numpy as np
import pytest
from astropy import constants, units
from pyradiosky import SkyModel
from simulation_cases import observe, random_sky, relative_error

from calstudy.base.visibilities import baseline_vectors
from calstudy.instrument.array_layouts.csv import CsvLayout
from calstudy.instrument.beam_models.formulas import GaussianBeam
from calstudy.instrument.settings import Channels, InstrumentSettings, Site, Times
from calstudy.simulate.chunks import Component, simulate_visibilities
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import PyuvsimEngine
from calstudy.simulate.nodes import Accuracy
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky import foregrounds
from calstudy.sky import settings as section

HASLAM = section.HaslamMap(kind="haslam", nside=16)


def kelvin_map(settings, frequencies) -> SkyModel:
    """Return the map as HEALPix brightness temperatures channel by channel: pyradiosky's units and geometry."""
    temperature = foregrounds.brightness_temperature(settings)
    scale = (np.asarray(frequencies) / foregrounds.HASLAM_FREQUENCY) ** settings.spectral_index
    stokes = np.zeros((4, len(frequencies), temperature.size))
    stokes[0] = scale[:, None] * temperature
    return SkyModel(
        component_type="healpix",
        nside=settings.nside,
        hpx_order="ring",
        hpx_inds=np.arange(temperature.size),
        frame="icrs",
        stokes=stokes * units.K,
        spectral_type="full",
        freq_array=frequencies * units.Hz,
    )


@pytest.mark.parametrize("beam", ["dipole_beam", "tile_beam"])
def test_a_diffuse_map_agrees_with_pyuvsim(beam, request):
    template, beam = observe(count=4, channels=2, times=2), request.getfixturevalue(beam)
    expected = PyuvsimEngine().simulate(kelvin_map(HASLAM, template.freq_array), beam, template)
    assert relative_error(DenseEngine().simulate(foregrounds.make_diffuse(HASLAM), beam, template), expected) < 1e-9


def test_map_and_sources_add_up(dipole_beam):
    """Through nodes in time and frequency, with pixels that rise and set."""
    template = observe(channels=8, width="1 MHz", times=12, integration="9 s")
    points, pixels = random_sky(template), foregrounds.make_diffuse(HASLAM)
    both = foregrounds.add_skies(points, pixels, template.freq_array)
    cube = simulate_visibilities(DenseEngine(), both, dipole_beam, template, Accuracy(1e-9, beam_extent=20.0))
    parts = [DenseEngine().simulate(sky, dipole_beam, template) for sky in (points, pixels)]
    assert relative_error(cube, sum(parts)) < 1e-7


def test_a_uniform_sky_gives_its_temperature_over_the_beam(tmp_path):
    """On a baseline of 1 mm, V_xx = k T / lambda^2 times the integral of the beam: half of 2 k T / lambda^2 over it."""
    (tmp_path / "pair.csv").write_text("east_m,north_m,up_m\n0,0,0\n0.001,0,0\n")
    uniform = section.SyntheticDiffuse(kind="synthetic", nside=64, mean="200 K", rms="0 K", spectral_index=-2.5)
    instrument = InstrumentSettings(
        layout=CsvLayout(kind="csv", path=tmp_path / "pair.csv"),
        location=Site(kind="mwa"),
        beam=GaussianBeam(kind="gaussian"),
        channels=Channels(first="170 MHz", width="2 MHz", count=8),
        times=Times(count=1),
    )
    component = Component(instrument, SimulationSettings(), section.NoSources(kind="none"), "Planck15", diffuse=uniform)
    cube = component.engine.simulate(component.sky(slice(None)), component.beam, component.template)[0, 0, :, 0]
    nu = component.template.freq_array
    temperature = 200 * (nu / 180e6) ** -2.5
    per_steradian = (constants.k_B * units.K * (nu * units.Hz / constants.c) ** 2).to_value("Jy")
    beam = component.beam.solid_angles(nu, "xx")[0]
    np.testing.assert_allclose(cube, temperature * per_steradian * beam, rtol=1e-3)


def test_fine_pixels_stand_for_the_map(dipole_beam):
    """On baselines whose fringes are wide against the pixels, another nside gives the same to a few per cent."""
    template = observe(count=3, times=1, channels=1, polarizations=("xx",))
    lengths = np.linalg.norm(baseline_vectors(template), axis=1)
    assert lengths.max() < 62
    coarse, fine = (
        DenseEngine().simulate(
            foregrounds.make_diffuse(section.HaslamMap(kind="haslam", nside=nside)), dipole_beam, template
        )
        for nside in (128, 256)
    )
    assert relative_error(coarse, fine) < 0.1


def test_pixels_cover_the_sky():
    sky = foregrounds.make_diffuse(section.SyntheticDiffuse(kind="synthetic", nside=16, mean="1 K", rms="0 K"))
    vectors = healpy.pix2vec(16, np.arange(3072))
    np.testing.assert_allclose(sky.skycoord.cartesian.xyz.value, np.array(vectors), atol=1e-12)
