"""Flux densities of every kind of sky model are those that pyradiosky gives pyuvsim."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from pyradiosky import SkyModel
from simulation_cases import healpix_sky, observe

from calstudy.simulate.interface import refusal_of_polarization
from calstudy.simulate.sources import stokes_i

FREQUENCIES = np.array([172e6, 180e6, 195e6])


def make_sky(unit, spectral_type, component_type):
    """Return two components in a unit."""
    spectra = {
        "flat": (1, {}),
        "flat at a frequency": (1, {"reference_frequency": [150e6, 200e6] * units.Hz}),
        "spectral_index": (1, {"reference_frequency": [150e6, 200e6] * units.Hz, "spectral_index": [-0.7, 0.2]}),
        "full": (3, {"freq_array": FREQUENCIES * units.Hz}),
        "subband": (5, {"freq_edge_array": np.array([np.arange(155, 200, 10), np.arange(165, 210, 10)]) * units.MHz}),
    }
    count, spectrum = spectra[spectral_type]
    stokes = np.zeros((4, count, 2))
    stokes[0] = np.random.default_rng(3).uniform(1, 2, (count, 2))
    place = {"name": ["a", "b"], "skycoord": SkyCoord([10, 20] * units.deg, [-30, -40] * units.deg)}
    if component_type == "healpix":
        place = {"nside": 4, "hpx_order": "ring", "hpx_inds": [3, 40], "frame": "icrs"}
    return SkyModel(
        component_type=component_type,
        spectral_type=spectral_type.split()[0],
        stokes=stokes * unit,
        **place,
        **spectrum,
    )


@pytest.mark.parametrize("spectral_type", ["flat", "flat at a frequency", "spectral_index", "full", "subband"])
@pytest.mark.parametrize(
    ("unit", "component_type"),
    [
        (units.Jy, "point"),
        (units.mJy, "point"),
        (units.K * units.sr, "point"),
        (units.K, "healpix"),
        (units.mK, "healpix"),
        (units.Jy / units.sr, "healpix"),
    ],
)
def test_flux_densities_are_pyradioskys(unit, spectral_type, component_type):
    sky = make_sky(unit, spectral_type, component_type)
    expected = sky.copy()
    if "frequency" in spectral_type or spectral_type == "spectral_index":
        # Converted where they are referred to, as pyuvsim does once they are points.
        if component_type == "healpix":
            expected.stokes = expected.stokes * (4 * np.pi * units.sr / (12 * 4**2))
            expected._set_component_type_params("point")
        expected.kelvin_to_jansky()
        ratio = FREQUENCIES[:, None] / sky.reference_frequency.to_value("Hz")
        flux = expected.stokes[0].to_value("Jy") * ratio ** (
            sky.spectral_index if sky.spectral_index is not None else 0
        )
    else:
        expected.at_frequencies(FREQUENCIES * units.Hz)
        if component_type == "healpix":
            expected.healpix_to_point(to_jy=False)
        expected.kelvin_to_jansky()
        flux = expected.stokes[0].to_value("Jy")
    np.testing.assert_allclose(stokes_i(sky, FREQUENCIES), flux, rtol=1e-12)


def test_one_kelvin_over_a_pixel_is_rayleigh_jeans():
    sky = healpix_sky(FREQUENCIES, nside=4)
    sky.stokes[0] = 1 * units.K
    boltzmann, light = 1.380649e-23, 299792458.0
    expected = 2 * boltzmann * FREQUENCIES**2 / light**2 * (4 * np.pi / 192) * 1e26
    np.testing.assert_allclose(stokes_i(sky, FREQUENCIES)[:, 7], expected, rtol=1e-12)


def test_a_missing_channel_and_a_missing_spectral_index_are_errors():
    with pytest.raises(ValueError, match="none at 173000000"):
        stokes_i(healpix_sky(FREQUENCIES), np.array([172e6, 173e6]))
    sky = make_sky(units.Jy, "spectral_index", "point")
    sky.spectral_index[1] = np.nan
    with pytest.raises(ValueError, match="not a number"):
        stokes_i(sky, FREQUENCIES)


def test_polarization_is_noticed():
    sky = make_sky(units.Jy, "flat", "point")
    template = observe(count=2, channels=1, times=1)
    assert refusal_of_polarization(sky, template) is None
    sky.stokes[3, 0, 1] = -0.1 * units.Jy
    assert "polarized" in refusal_of_polarization(sky, template)
