"""Diffuse emission: where the Haslam map has what, units, spectra, and the sum with point sources."""

from __future__ import annotations

import healpy
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from pyradiosky import SkyModel
from pyradiosky.utils import jy_to_ksr

from calstudy.base import package_files
from calstudy.base.errors import InputError
from calstudy.sky import foregrounds
from calstudy.sky import settings as section
from calstudy.sky.foregrounds import make_foregrounds

FREQUENCIES = 167.075e6 + 80e3 * np.arange(8)
FINEST = section.HaslamMap(kind="haslam")


@pytest.fixture(scope="module")
def haslam():
    return foregrounds.brightness_temperature(FINEST)


def around(direction: SkyCoord, radius: float) -> np.ndarray:
    """Pixels of the finest map within some degrees of a direction."""
    centre = healpy.ang2vec(direction.icrs.ra.deg, direction.icrs.dec.deg, lonlat=True)
    return healpy.query_disc(256, centre, np.deg2rad(radius))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Cygnus A", "19h59m28.4s +40d44m02s"),
        ("Cassiopeia A", "23h23m24s +58d48m54s"),
        ("Centaurus A", "13h25m27.6s -43d01m09s"),
        ("Virgo A", "12h30m49.4s +12d23m28s"),
        ("Galactic centre", "17h45m40s -29d00m28s"),
    ],
)
def test_bright_sources_are_where_they_are(haslam, name, place):
    """To 0.25 degrees, about one pixel; a mirrored map, or B1950 taken for J2000 (0.6 degrees), would miss them."""
    del name
    found = around(SkyCoord(place), 2.0)
    longitude, latitude = healpy.pix2ang(256, found[haslam[found].argmax()], lonlat=True)
    assert SkyCoord(longitude, latitude, unit="deg").separation(SkyCoord(place)).deg < 0.25


def test_temperatures_are_absolute(haslam):
    """Virgo A has 569 Jy at 408 MHz (Perley & Butler 2017); the survey's scale is good to 10 % (Haslam et al. 1982)."""
    virgo = SkyCoord("12h30m49.4s +12d23m28s")
    inside, around_it = around(virgo, 1.5), np.setdiff1d(around(virgo, 3.0), around(virgo, 1.5))
    excess = (haslam[inside] - np.median(haslam[around_it])).sum() * healpy.nside2pixarea(256)
    assert excess / jy_to_ksr(408 * units.MHz).value == pytest.approx(569, rel=0.15)
    # The coldest sky has about 11 K at 408 MHz with the background of 2.7 K, and all of it is above zero.
    assert 7 < haslam.min() < 10


def test_coarser_maps_are_means_of_the_finest(haslam):
    coarse = foregrounds.brightness_temperature(section.HaslamMap(kind="haslam", nside=16))
    assert coarse.size == 12 * 16**2
    assert coarse.mean() == pytest.approx(haslam.mean(), rel=1e-12)


@pytest.mark.parametrize("frequency", [120e6, 408e6])
def test_pixels_have_the_flux_of_a_power_law_in_temperature(frequency):
    """pyradiosky's conversion of kelvin, at the frequency itself."""
    settings = section.HaslamMap(kind="haslam", nside=16, spectral_index=-2.6)
    sky = foregrounds.make_diffuse(settings)
    temperature = foregrounds.brightness_temperature(settings) * (frequency / 408e6) ** -2.6
    expected = temperature * healpy.nside2pixarea(16) / jy_to_ksr(frequency * units.Hz).value
    found = sky.at_frequencies(np.array([frequency]) * units.Hz, inplace=False).stokes[0, 0].to_value("Jy")
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_the_synthetic_map_has_its_spectrum_and_temperatures():
    """Band powers of 8 octaves of l within five standard deviations of their chance, 1/sqrt(modes) each."""
    settings = section.SyntheticDiffuse(kind="synthetic", nside=128, rms="10 K", mean="100 K", angular_index=1.0)
    field = foregrounds.brightness_temperature(settings)
    assert field.mean() == pytest.approx(100, abs=1e-4)
    lmax = 300
    found = healpy.anafast(field, lmax=lmax, iter=5)[1:]
    degree = np.arange(1, 768)
    expected = 100 * degree**-1.0 * 4 * np.pi / np.sum((2 * degree + 1) / degree)
    for low in 2 ** np.arange(8):
        band = slice(low - 1, 2 * low - 1)
        modes = np.sum(2 * degree[band] + 1)
        ratio = np.sum((2 * degree[band] + 1) * found[band] / expected[band]) / modes
        assert abs(ratio - 1) < 5 * np.sqrt(2 / modes), low


def test_large_scales_of_the_synthetic_map_do_not_depend_on_nside():
    coarse, fine = (
        healpy.map2alm(
            foregrounds.brightness_temperature(section.SyntheticDiffuse(kind="synthetic", nside=nside)), lmax=20, iter=5
        )
        for nside in (32, 128)
    )
    # The quadrature of the coarse map lets some of its small scales in.
    assert np.abs(coarse - fine).max() < 1e-3 * np.abs(fine[1:]).max()
    other = foregrounds.brightness_temperature(section.SyntheticDiffuse(kind="synthetic", nside=32, seed=22))
    assert np.abs(healpy.map2alm(other, lmax=20) - coarse)[1:].max() > 0.1 * np.abs(fine[1:]).max()


def points_and_map(**fields) -> tuple[SkyModel, SkyModel, SkyModel]:
    sources = section.SyntheticSources(flux_limit="10 Jy", **fields)
    mapped = section.SyntheticDiffuse(kind="synthetic", nside=16)
    both = make_foregrounds(sources, FREQUENCIES, mapped)
    assert "synthetic sources" in both.stand_in
    assert "diffuse emission: a synthetic map at nside 16" in both.stand_in
    return both.sky, make_foregrounds(sources, FREQUENCIES).sky, foregrounds.make_diffuse(mapped)


@pytest.mark.parametrize("spectrum", ["flat", "catalogue"])
def test_sources_keep_their_spectra_beside_a_map(spectrum):
    both, points, pixels = points_and_map(spectrum=spectrum)
    assert both.spectral_type == "spectral_index"
    nu = np.array([150e6, 190e6]) * units.Hz
    found = both.at_frequencies(nu, inplace=False, run_check=False).stokes[0]
    expected = [sky.at_frequencies(nu, inplace=False, run_check=False).stokes[0] for sky in (points, pixels)]
    expected[0] = np.broadcast_to(expected[0], (2, points.Ncomponents), subok=True)
    np.testing.assert_allclose(found.value, np.concatenate(expected, axis=1).value, rtol=1e-13)
    both.check()


def test_a_catalogue_channel_by_channel_makes_the_map_so(tmp_path):
    points = make_foregrounds(section.SyntheticSources(flux_limit="20 Jy", spectrum="catalogue"), FREQUENCIES).sky
    full = points.at_frequencies(FREQUENCIES * units.Hz, inplace=False)
    full.write_skyh5(tmp_path / "full.skyh5")
    file = section.FileSources(kind="file", path=tmp_path / "full.skyh5", spectrum="catalogue", flux_limit="20 Jy")
    mapped = section.SyntheticDiffuse(kind="synthetic", nside=16)
    both = make_foregrounds(file, FREQUENCIES, mapped).sky
    assert both.spectral_type == "full"
    pixels = foregrounds.make_diffuse(mapped).at_frequencies(FREQUENCIES * units.Hz, inplace=False, run_check=False)
    np.testing.assert_allclose(both.stokes[0][:, -3072:].value, pixels.stokes[0].value)


def test_a_map_alone():
    found = make_foregrounds(section.NoSources(kind="none"), FREQUENCIES, section.HaslamMap(kind="haslam", nside=16))
    assert found.sky.Ncomponents == 3072
    assert found.stand_in == "diffuse emission: the Haslam map at nside 16, T proportional to nu^-2.55"


def test_a_missing_map_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(package_files, "find_spec", lambda name: None)
    monkeypatch.setattr(package_files, "default_directory", lambda: tmp_path)
    with pytest.raises(InputError, match=r"data fetch haslam'.*use sky.diffuse: synthetic"):
        foregrounds.make_diffuse(FINEST)
