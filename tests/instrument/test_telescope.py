"""The observation's metadata: sidereal time, order, polarization convention, geometry."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import AltAz, SkyCoord
from astropy.time import Time
from astropy.utils import iers

from calstudy.base.errors import InputError
from calstudy.base.visibilities import (
    antenna_pairs,
    baseline_vectors,
    require_earth_orientation,
    require_rectangular,
    subset_template,
)
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Channels, InstrumentSettings, Times
from calstudy.instrument.telescope import REFERENCE_JD, make_template, time_of_lst


def small(**changes):
    fields = {
        "layout": MwaLayout(count=5),
        "channels": Channels(count=8),
        "times": Times(count=3),
        "polarizations": ("xx", "yy"),
    }
    return InstrumentSettings(**(fields | changes))


@pytest.fixture(scope="module")
def template():
    return make_template(small())


@pytest.mark.parametrize("lst", [0.0, 1.8, 12.0, 23.42, 23.43, 23.999])
def test_first_integration_is_at_the_sidereal_time_asked_for(lst):
    settings = small(times=Times(start_lst=f"{lst} h", count=1))
    uvd = make_template(settings)
    error = (uvd.lst_array[0] - lst * np.pi / 12 + np.pi) % (2 * np.pi) - np.pi
    assert abs(error) < 1e-7
    assert REFERENCE_JD <= uvd.time_array[0] < REFERENCE_JD + 0.9973


def test_sidereal_time_agrees_with_astropy():
    """The meridian at LST 1.8 h, found by astropy's own transformation, which knows nothing of pyuvdata's LST."""
    location = make_layout(MwaLayout(count=2)).location
    time = Time(time_of_lst(1.8, location), format="jd", location=location)
    assert time.sidereal_time("apparent").hour == pytest.approx(1.8, abs=1e-6)
    zenith = SkyCoord(alt=90, az=0, unit="deg", frame=AltAz(obstime=time, location=location)).icrs
    # Precession since J2000 is 17 years of 50 arcsec.
    assert zenith.ra.hour == pytest.approx(1.8, abs=0.02)
    assert zenith.dec.deg == pytest.approx(location.lat.deg, abs=0.12)


def test_template_has_the_axes_asked_for(template):
    assert (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols) == (3, 10, 8, 2)
    assert template.data_array is None
    np.testing.assert_allclose(template.freq_array, 167.075e6 + 80e3 * np.arange(8))
    np.testing.assert_allclose(np.diff(np.unique(template.time_array)) * 86400, 2.0, atol=1e-4)
    assert template.polarization_array.tolist() == [-5, -6]
    assert (template.channel_width == 80e3).all()
    assert (template.integration_time == 2.0).all()


def test_paper_setup_by_default():
    settings = InstrumentSettings(times=Times(count=2))
    uvd = make_template(settings)
    assert (uvd.Nbls, uvd.Nfreqs, uvd.Npols) == (630, 384, 1)
    assert uvd.freq_array[-1] == pytest.approx(197.715e6)


def test_baselines_are_time_major_and_ordered_by_antenna(template):
    require_rectangular(template)
    pairs = antenna_pairs(template)
    assert pairs.tolist() == [[a, b] for a in range(5) for b in range(a + 1, 5)]


def test_autos_on_request():
    assert make_template(small(), autos=True).Nbls == 15


def test_antennas_are_where_the_layout_has_them(template):
    layout = make_layout(MwaLayout(count=5))
    first, second = np.triu_indices(5, 1)
    np.testing.assert_allclose(baseline_vectors(template), layout.enu[second] - layout.enu[first], atol=1e-7)
    np.testing.assert_allclose(template.uvw_array[:10], layout.enu[second] - layout.enu[first], atol=1e-7)


def test_conventions(template):
    assert template.telescope.get_x_orientation_from_feeds() == "east"
    assert set(template.telescope.mount_type) == {"fixed"}
    assert template.vis_units == "Jy"
    assert template.pol_convention == "sum"
    assert [entry["cat_type"] for entry in template.phase_center_catalog.values()] == ["unprojected"]


def test_templates_of_equal_settings_are_equal(template):
    assert make_template(small()) == template


def test_subset_observes_the_same_baselines_at_other_times_and_frequencies(template):
    times, frequencies = template.time_array[0] + np.array([0.1, 0.7, 3.0]) / 86400, np.array([167.2e6, 167.31e6])
    nodes = subset_template(template, times, frequencies)
    require_rectangular(nodes)
    np.testing.assert_array_equal(antenna_pairs(nodes), antenna_pairs(template))
    np.testing.assert_array_equal(np.unique(nodes.time_array), times)
    np.testing.assert_array_equal(nodes.freq_array, frequencies)
    np.testing.assert_array_equal(nodes.polarization_array, template.polarization_array)
    sidereal_rate = 2 * np.pi / 86164.0905
    np.testing.assert_allclose(
        nodes.lst_array[::10] - template.lst_array[0], np.array([0.1, 0.7, 3.0]) * sidereal_rate, atol=1e-8
    )


def test_writes_and_reads_back(tmp_path, template):
    uvd = template.copy()
    uvd.data_array = np.zeros((uvd.Nblts, uvd.Nfreqs, uvd.Npols), dtype=complex)
    uvd.flag_array = np.zeros(uvd.data_array.shape, dtype=bool)
    uvd.nsample_array = np.ones(uvd.data_array.shape, dtype=np.float32)
    uvd.write_uvh5(tmp_path / "template.uvh5")
    back = type(uvd).from_file(tmp_path / "template.uvh5")
    assert back.telescope == template.telescope
    assert back.pol_convention == "sum"


def test_times_are_known_up_to_the_end_of_the_installed_tables():
    """Predictions are used, however old; a download is never tried."""
    end = Time(iers.earth_orientation_table.get()["MJD"][-1], format="mjd").mjd
    last, future = (Time(end + days, format="mjd") for days in (-1, 1))
    require_earth_orientation(np.array([2457458.0, last.jd]), "data")
    # Astropy raises an error for predictions that are older than it allows.
    assert np.isfinite(last.get_delta_ut1_utc())
    with pytest.raises(InputError, match=r"data: is of \d{4}-.* up to \d{4}-.*: update the package astropy-iers-data"):
        require_earth_orientation(np.array([future.jd]), "data")
