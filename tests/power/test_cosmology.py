from __future__ import annotations

import numpy as np
import pytest
from astropy import constants
from astropy import units as u
from hypothesis import given
from hypothesis import strategies as st

from calstudy.power import cosmology as c

NAMES = ["Planck15", "Planck18", "WMAP9"]


@pytest.mark.parametrize("name", NAMES)
def test_scales_are_derivatives_of_the_comoving_position(name):
    cosmo = c.make_cosmology(name)
    frequency, step = 182e6, 1e4
    distances = [cosmo.comoving_distance(c.redshift(frequency + sign * step)).to_value(u.Mpc) for sign in (-1, 1)]
    z = c.redshift(frequency)
    assert c.radial_scale(cosmo, z) == pytest.approx((distances[0] - distances[1]) / (2 * step), rel=1e-6)
    assert c.transverse_scale(cosmo, z) == pytest.approx(cosmo.comoving_distance(z).to_value(u.Mpc), rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("band", [(167.075e6, 197.715e6), (100e6, 110e6)])
def test_hera_conversions_have_the_volume_of_astropy_over_the_band(name, band):
    cosmo = c.make_cosmology(name)
    conversions = c.hera_conversions(cosmo, float(c.redshift(np.mean(band))))
    for frequency in np.linspace(*band, 5):
        z = c.redshift(frequency)
        volume = c.transverse_scale(cosmo, z) ** 2 * c.radial_scale(cosmo, z)
        assert conversions.X2Y(z, little_h=False) == pytest.approx(volume, rel=3e-4)
        assert conversions.X2Y(z, little_h=True) == pytest.approx(volume * cosmo.h**3, rel=3e-4)


def test_hera_conversions_would_be_wrong_with_the_densities_of_today():
    from hera_pspec.conversions import Cosmo_Conversions

    cosmo = c.make_cosmology("Planck15")
    plain = Cosmo_Conversions(Om_L=cosmo.Ode0, Om_b=cosmo.Ob0, Om_c=cosmo.Odm0, H0=cosmo.H0.value)
    z = c.redshift(182e6)
    volume = c.transverse_scale(cosmo, z) ** 2 * c.radial_scale(cosmo, z)
    assert plain.X2Y(z, little_h=False) / volume - 1 > 5e-3


def test_wavenumbers_agree_with_hera_pspec():
    cosmo, frequency = c.make_cosmology("Planck15"), 182.4e6
    z = c.redshift(frequency)
    conversions = c.hera_conversions(cosmo, z)
    assert c.k_perpendicular(cosmo, 30.0, frequency) == pytest.approx(30 * conversions.bl_to_kperp(z), rel=1e-6)
    assert c.k_parallel(cosmo, 1e-6, frequency) == pytest.approx(1e-6 * conversions.tau_to_kpara(z), rel=1e-6)


@given(st.floats(1.0, 3000.0), st.floats(50e6, 250e6))
def test_a_fringe_has_the_wavelength_of_its_k_perpendicular(length, frequency):
    cosmo = c.make_cosmology("Planck15")
    fringe = constants.c.value / frequency / length * c.transverse_scale(cosmo, c.redshift(frequency)) * cosmo.h
    assert c.k_perpendicular(cosmo, length, frequency) * fringe == pytest.approx(2 * np.pi, rel=1e-12)


def test_an_unknown_cosmology_is_refused():
    with pytest.raises(ValueError, match=r"Planck14.*allowed.*Planck15"):
        c.make_cosmology("Planck14")
