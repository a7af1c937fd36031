"""The 21 cm field: absolute variance, angular spectra, correlations between channels, independence of chunking."""

from __future__ import annotations

import healpy
import numpy as np
import pytest
from astropy import units
from astropy.cosmology import Planck15
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.power.cosmology import input_power
from calstudy.sky.eor import HYDROGEN_LINE, EorField, comoving_geometry
from calstudy.sky.settings import Eor
from calstudy.studies.preflight import APERTURE, note_of_maps, require_fine_maps

CHANNELS = 167.075e6 + 80e3 * np.arange(384)
FEW = CHANNELS[:24]


def covariance(field: EorField, ell: int) -> np.ndarray:
    factor = field.covariance_factor(ell)
    return factor @ factor.T


def test_amplitude_of_the_paper_is_nine_square_kelvin_in_the_last_channel():
    """The paper's P is 9 K² times the voxel of nside 256 and 80 kHz at 197.715 MHz (Planck15, Mpc³ without h)."""
    field = EorField(Eor(), CHANNELS)
    # 0.04 %: the paper's voxel reaches from the channel's centre to the next, one channel's worth of evolution.
    assert field.settings.amplitude / field.voxel_volume[-1] == pytest.approx(9.0, rel=6e-4)


def test_voxel_is_the_difference_of_two_spheres():
    field = EorField(Eor(nside=64), CHANNELS)
    for channel in (0, 200, 383):
        edges = HYDROGEN_LINE / (CHANNELS[channel] + np.array([-40e3, 40e3])) - 1
        shell = -np.diff(Planck15.comoving_volume(edges).to_value("Mpc3"))[0]
        assert field.voxel_volume[channel] == pytest.approx(shell / (12 * 64**2), rel=1e-6)


def test_flat_field_has_variance_power_over_voxel_in_every_channel():
    field = EorField(Eor(nside=64), CHANNELS)
    chosen = np.array([0, 100, 383])
    maps = field.maps(chosen)
    ratio = maps.var(axis=1) * field.voxel_volume[chosen] / field.settings.amplitude
    # 4 standard errors of a variance of 49,152 normal numbers.
    assert np.abs(ratio - 1).max() < 4 * np.sqrt(2 / maps.shape[1])
    assert np.abs(maps.mean(axis=1) / maps.std(axis=1)).max() < 4 / np.sqrt(maps.shape[1])
    assert np.abs(np.corrcoef(maps) - np.eye(3)).max() < 4 / np.sqrt(maps.shape[1])


def test_flat_field_has_white_angular_spectrum():
    field = EorField(Eor(nside=64), FEW)
    spectrum = healpy.anafast(field.maps(slice(0, 8)), pol=False, lmax=100)[:8, 20:].mean()
    expected = (field.settings.amplitude / (field.distance**2 * field.depth))[:8].mean()
    modes = 8 * (2 * np.arange(20, 101) + 1).sum()
    assert spectrum / expected == pytest.approx(1, abs=4 * np.sqrt(2 / modes) + 0.01)


@pytest.mark.parametrize("spectrum", [{"spectrum": "flat"}, {"spectrum": "power-law", "index": -1.0}])
@given(st.lists(st.integers(0, 23), min_size=1, max_size=5, unique=True))
@settings(max_examples=10, deadline=None)
def test_chunks_do_not_matter(spectrum, chosen):
    field = EorField(Eor(nside=16, **spectrum), FEW)
    together = EorField(Eor(nside=16, **spectrum), FEW).maps(slice(None))
    np.testing.assert_array_equal(field.maps(np.array(chosen)), together[chosen])


def test_seed_decides():
    first, again, other = (EorField(Eor(nside=16, seed=seed), FEW).maps(slice(0, 1)) for seed in (2, 2, 3))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_sky_model(recwarn):
    field = EorField(Eor(nside=16), FEW)
    sky = field.sky(slice(4, 7))
    assert not recwarn
    assert (sky.component_type, sky.spectral_type, sky.nside, sky.hpx_order) == ("healpix", "full", 16, "ring")
    np.testing.assert_array_equal(sky.freq_array.to_value("Hz"), FEW[4:7])
    assert sky.stokes.unit == units.K
    np.testing.assert_array_equal(sky.stokes[0].value, field.maps(slice(4, 7)))
    assert (sky.stokes[1:].value == 0).all()
    assert sky.frame == "icrs"


def test_flat_power_law_is_the_flat_spectrum():
    field = EorField(Eor(spectrum="power-law", index=0.0), FEW)
    expected = np.diag(field.settings.amplitude / (field.distance**2 * field.depth))
    for ell in (0, 5, 700):
        np.testing.assert_allclose(covariance(field, ell), expected, atol=1e-7 * expected.max())


@pytest.mark.parametrize("index", [-2.5, -1.0, 0.7])
@pytest.mark.parametrize("ell", [2, 60, 500])
def test_covariance_is_the_line_of_sight_integral(index, ell):
    """Neighbouring and distant channels against adaptive quadrature over k of P(k), taken at the pair's middle."""
    field = EorField(Eor(spectrum="power-law", index=index, amplitude="100 K2 Mpc3", pivot_k=0.2), FEW)
    found = covariance(field, ell)
    for first, second in ((7, 7), (7, 8), (0, 23)):
        distance, depth = (np.sqrt(values[first] * values[second]) for values in (field.distance, field.depth))
        across = (ell + 0.5) / distance

        def integrand(log_k, across=across, lag=(second - first) * depth):
            along = np.exp(log_k)
            return 100 * (np.hypot(along, across) / 0.2) ** index * np.cos(along * lag) * along

        limits = np.log([1e-9, np.pi / depth])
        expected = quad(integrand, *limits, limit=2000, epsabs=0, epsrel=1e-9)[0] / np.pi / distance**2
        scale = found[first, first]
        assert found[first, second] == pytest.approx(expected, abs=1e-3 * scale)


@pytest.mark.parametrize("index", [-3.5, -1.0, 1.0])
def test_interpolated_roots_reproduce_the_covariance(index):
    field = EorField(Eor(spectrum="power-law", index=index), CHANNELS[::8])
    roots = field.covariance_roots(767)
    for ell in (0, 1, 2, 7, 100, 555, 767):
        root, expected = roots(np.log(ell + 0.5)), covariance(field, ell)
        np.testing.assert_allclose(root @ root.T, expected, atol=5e-5 * expected.max())


def test_power_law_maps_have_the_covariance_at_all_lags():
    """Cross spectra of maps, summed over many modes, against the covariance."""
    field = EorField(Eor(spectrum="power-law", index=-1.5, nside=32), FEW)
    alm = [healpy.map2alm(map_, lmax=40, iter=3) for map_ in field.maps(np.array([0, 1, 12]))]
    degrees = np.arange(10, 41)
    weight = 2 * degrees + 1
    expected = np.array([covariance(field, ell)[np.ix_([0, 1, 12], [0, 1, 12])] for ell in degrees])
    for i, j in ((0, 0), (1, 1), (0, 1), (0, 2)):
        # Each ℓ in units of its own expected auto spectrum, or the largest scales would drown the others.
        found = healpy.alm2cl(alm[i], alm[j])[10:] / expected[:, 0, 0]
        mean = expected[:, i, j] / expected[:, 0, 0]
        assert (found * weight).sum() / weight.sum() == pytest.approx(
            (mean * weight).sum() / weight.sum(), abs=4 * np.sqrt(2 / weight.sum())
        )


def test_steepest_spectrum_can_be_drawn():
    field = EorField(Eor(spectrum="power-law", index=-3.5, nside=16), CHANNELS[::4])
    maps = field.maps(slice(0, 2))
    assert np.isfinite(maps).all()
    assert np.corrcoef(maps)[0, 1] > 0.99


def test_channel_depth_is_the_derivative_of_distance():
    distance, depth = comoving_geometry(np.array([180e6]), 1e3)
    near, _ = comoving_geometry(np.array([180.0005e6, 179.9995e6]), 1e3)
    assert depth[0] == pytest.approx(near[1] - near[0], rel=1e-4)
    assert distance[0] == pytest.approx(Planck15.comoving_distance(HYDROGEN_LINE / 180e6 - 1).value)


def test_channels_must_be_equally_spaced():
    with pytest.raises(ValueError, match="equally spaced"):
        EorField(Eor(), np.array([170e6, 171e6, 173e6]))
    assert EorField(Eor(), np.round(140e6 + 122_070.3125 * np.arange(64))).n_pixels


@pytest.mark.slow
def test_paper_scale_power_law_stays_below_three_gigabytes():
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    EorField(Eor(spectrum="power-law", index=-2.0), CHANNELS).sky(slice(0, 8))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 3e6


@pytest.fixture
def table(tmp_path):
    """P = 1e4 (k / 0.2)^-1.5 mK^2 h^-3 Mpc^3, coarsely sampled: a power law between two k is exact."""
    k = np.geomspace(1e-6, 20, 9)
    path = tmp_path / "power.txt"
    np.savetxt(path, np.column_stack([k, 1e4 * (k / 0.2) ** -1.5]), header="k [h/Mpc]  P [mK^2 h^-3 Mpc^3]")
    return path


def test_a_table_of_a_power_law_is_the_power_law(table):
    h = Planck15.h
    amplitude = 1e-6 * 1e4 / h**3
    law = EorField(Eor(spectrum="power-law", index=-1.5, amplitude=f"{amplitude} K2 Mpc3", pivot_k=0.2 * h), FEW)
    field = EorField(Eor(spectrum="table", path=table, nside=16), FEW)
    for ell in (3, 60, 500):
        np.testing.assert_allclose(covariance(field, ell), covariance(law, ell), rtol=1e-6)
    assert np.isfinite(field.maps(slice(0, 2))).all()


def test_the_input_power_of_a_table_is_the_table_in_its_own_units(table):
    k, power = np.loadtxt(table, unpack=True)
    settings = Eor(spectrum="table", path=table)
    np.testing.assert_allclose(input_power(settings, k, "Planck15"), power, rtol=1e-9)
    # Constant beyond its ends.
    np.testing.assert_allclose(input_power(settings, [1e-8, 100.0], "Planck15"), power[[0, -1]], rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0.1 1 2\n0.2 1 2\n", "line 1: .* is not two numbers"),
        ("0.1, 1\n", "needs two rows of .* has 1"),
        ("k, P\n0.1, 1\n", "line 1: 'k, P' is not two numbers"),
        ("# k P\n\n0.1 1\n0.1 2\n", "line 4: .* k must increase"),
        ("0.1 1\n0.2 -2\n", "must be positive"),
        ("0.1 1\n0.2 nan\n", "must be positive"),
    ],
)
def test_a_table_that_is_no_power_spectrum_is_refused(text, problem, tmp_path):
    path = tmp_path / "power.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=problem):
        EorField(Eor(spectrum="table", path=path, nside=16), FEW).maps(slice(0, 1))


@pytest.mark.parametrize(
    "fields", [{"spectrum": "table"}, {"path": "p.txt"}, {"spectrum": "power-law", "path": "p.txt"}]
)
def test_a_table_and_its_path_belong_together(fields):
    with pytest.raises(ValueError, match="is needed with spectrum: table"):
        Eor.model_validate(fields)


def power_of_baselines(eor: Eor, length: float) -> float:
    """Return the power of the visibilities of baselines of a length, m, over that of the input.

    The beam is a Gaussian of the width of an MWA tile's; baselines have ten directions, and maps 24 channels.
    """
    field = EorField(eor, FEW)
    directions = np.array(healpy.pix2vec(eor.nside, np.arange(field.n_pixels)))
    up = directions[2] > 0
    beam = np.exp(-(np.arccos(directions[2, up]) ** 2) / (2 * 0.17**2))
    angles = np.pi * np.arange(10) / 10
    turns = length * FEW.mean() / SPEED_OF_LIGHT * np.stack([np.cos(angles), np.sin(angles)], 1) @ directions[:2, up]
    pixel = 4 * np.pi / field.n_pixels
    visibilities = (np.exp(2j * np.pi * turns) * beam * pixel) @ field.maps(slice(None))[:, up].T
    density = eor.amplitude / (field.distance**2 * field.depth) * np.sum(beam**2) * pixel
    return float(np.mean(np.abs(visibilities) ** 2 / density))


def test_baselines_that_the_finest_maps_do_not_resolve_are_named():
    """At 180 MHz maps of nside 256 have what baselines of 767 c / 2 pi nu - 5 m = 198 m see."""
    law, band = Eor(spectrum="power-law", index=-1.0, nside=256), (150e6, 180e6)
    require_fine_maps(law, np.array([14.0, 876.0]), band, "sky.eor")
    assert note_of_maps(law, np.array([14.0, 198.0]), band, "sky.eor") == ""
    assert "baselines of more than 198 m see others" in note_of_maps(law, np.array([14.0, 876.0]), band, "sky.eor")
    assert note_of_maps(Eor(nside=256), np.array([876.0]), band, "sky.eor") == ""
    with pytest.raises(InputError, match="give at least 256"):
        require_fine_maps(law.model_copy(update={"nside": 128}), np.array([876.0]), band, "sky.eor")


def test_maps_that_are_fine_enough_have_the_power_of_the_input_and_others_have_not():
    """A P(k) of index 0 is as flat as the flat one, whose pixels are white, but its maps end at l = 3 nside - 1."""
    law = [Eor(spectrum="power-law", index=0.0, nside=16, seed=seed) for seed in range(6)]
    limit = 47 * SPEED_OF_LIGHT / (2 * np.pi * FEW.max()) - APERTURE
    require_fine_maps(law[0], np.array([0.99 * limit]), (FEW.min(), FEW.max()), "sky.eor")
    with pytest.raises(InputError, match=r"sky.eor.nside = 16: .* see those up to 48; give at least 32"):
        require_fine_maps(law[0], np.array([1.02 * limit]), (FEW.min(), FEW.max()), "sky.eor")
    require_fine_maps(Eor(nside=16), np.array([1e3]), (FEW.min(), FEW.max()), "sky.eor")
    # 144 maps, of which a baseline sees one mode each; its ten directions are nearly independent.
    allowed = 4 / np.sqrt(144)
    assert np.mean([power_of_baselines(eor, 0.99 * limit) for eor in law]) == pytest.approx(1, abs=allowed)
    assert np.mean([power_of_baselines(eor, 2.2 * limit) for eor in law]) < 0.6
