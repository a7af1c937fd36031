from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, SkyCoord
from astropy.time import Time

from calstudy.base.visibilities import baseline_vectors, flag_cube, to_cube
from calstudy.instrument.array_layouts.geometric import GolombLayout
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.settings import BEAMS, Channels
from calstudy.power.average import fringe_stop_and_average
from calstudy.power.binned import noise_level
from calstudy.power.settings import PowerSettings
from calstudy.products.files import AVERAGE, write_visibilities
from calstudy.products.spectra import Power, excess_noise, read_delay_spectra


@pytest.fixture(scope="module")
def run(observe):
    return observe(GolombLayout(kind="golomb", count=5), n_channels=8, n_times=12)


def zenith(template):
    middle = Time((template.time_array.min() + template.time_array.max()) / 2, format="jd")
    location = template.telescope.location
    return SkyCoord(alt=90 * u.deg, az=0 * u.deg, frame=AltAz(obstime=middle, location=location)).icrs


def test_a_source_at_the_zenith_keeps_its_flux_and_has_no_phase(run, drifting_source):
    averaged = fringe_stop_and_average(drifting_source(run, zenith(run)))
    assert averaged.Ntimes == 1
    np.testing.assert_allclose(averaged.data_array, 1.0, atol=2e-3)


def test_a_long_drift_needs_the_fringe_stop(observe, drifting_source):
    template = observe(GolombLayout(kind="golomb", count=8, spacing="60 m"), n_channels=8, n_times=40)
    uvd = drifting_source(template, zenith(template))
    longest = np.argmax(np.linalg.norm(baseline_vectors(template), axis=1))
    assert np.abs(to_cube(uvd).mean(axis=0))[longest].max() < 0.9
    assert np.abs(to_cube(fringe_stop_and_average(uvd)))[0, longest].min() > 0.999


def test_noise_averages_down_and_the_input_is_untouched(run, white):
    uvd = white(run, np.random.default_rng(3))
    before = uvd.copy()
    averaged = fringe_stop_and_average(uvd)
    assert uvd == before
    assert averaged.data_array.std() == pytest.approx(1 / np.sqrt(12), rel=0.15)
    assert averaged.integration_time == pytest.approx(24.0)
    assert averaged.data_array.dtype == np.complex128


def test_flags_and_nsamples_weigh(run, white):
    uvd = white(run, np.random.default_rng(4))
    clean = fringe_stop_and_average(uvd)
    bad = uvd.copy()
    bad.data_array[: 3 * run.Nbls] = 1e6
    bad.flag_array[: 3 * run.Nbls] = True
    flagged = fringe_stop_and_average(bad)
    assert np.abs(flagged.data_array).max() < 5
    assert not flagged.flag_array.any()
    bad.flag_array[:] = True
    assert fringe_stop_and_average(bad).flag_array.all()
    weighted = uvd.copy()
    weighted.nsample_array[run.Nbls :] = 1e-6
    only_first = fringe_stop_and_average(weighted).data_array
    np.testing.assert_allclose(np.abs(only_first), np.abs(uvd.data_array[: run.Nbls]), rtol=1e-3)
    assert not np.allclose(np.abs(clean.data_array), np.abs(only_first), rtol=0.1)


@pytest.mark.parametrize("precision", [np.complex64, np.complex128])
def test_pyuvdata_has_the_same_average(run, white, precision):
    uvd, rng = white(run, np.random.default_rng(7)), np.random.default_rng(8)
    uvd.data_array = uvd.data_array.astype(precision)
    uvd.flag_array[:] = rng.random(uvd.flag_array.shape) < 0.4
    uvd.flag_array.reshape(12, run.Nbls, 8)[:, 2, 3] = True
    uvd.nsample_array[:] = rng.uniform(0.5, 2, uvd.nsample_array.shape)
    uvd.flag_array[[0, run.Nbls], 0, 0] = True, False
    uvd.data_array[0, 0, 0] = np.nan
    expected = uvd.copy()
    expected.phase_to_time(Time((uvd.time_array.min() + uvd.time_array.max()) / 2, format="jd"))
    expected.downsample_in_time(n_times_to_avg=12)
    averaged = fringe_stop_and_average(uvd)
    averaged.reorder_blts()
    assert averaged == expected


def test_baselines_keep_their_order(observe, white):
    template = observe(MwaLayout(kind="mwa-compact-hex-east", count=6), n_channels=8, n_times=3)
    averaged = fringe_stop_and_average(white(template, np.random.default_rng(5)))
    np.testing.assert_array_equal(averaged.baseline_array, template.baseline_array[: template.Nbls])


def test_one_integration_stays_one(observe, white):
    uvd = white(observe(GolombLayout(kind="golomb", count=4), n_channels=8), np.random.default_rng(6))
    averaged = fringe_stop_and_average(uvd)
    np.testing.assert_allclose(np.abs(averaged.data_array), np.abs(uvd.data_array), rtol=1e-9)


def test_spectra_of_data_that_lack_integrations_have_the_noise_of_those_that_are_left(tmp_path, observe, white):
    """As of solves that failed: a third of the samples of the even data, half of those of the odd ones."""
    template, rng, power = observe(GolombLayout(kind="golomb", count=5), n_times=6), np.random.default_rng(5), {}
    settings, channels = PowerSettings(pairs="same-baseline"), Channels(first="180 MHz", width="80 kHz", count=32)
    beam = BEAMS.make("gaussian")
    for name, lacking in (("all", (0, 0)), ("some", (2, 3))):
        for parity, count in zip(("even", "odd"), lacking, strict=True):
            data = white(template, rng)
            flag_cube(data)[:count] = True
            (tmp_path / name / parity).mkdir(parents=True)
            write_visibilities(fringe_stop_and_average(data), tmp_path / name / parity / AVERAGE)
        made = Power(
            name, beam=beam, channels=channels, power=settings, **{p: tmp_path / name / p for p in ("even", "odd")}
        )
        (tmp_path / name / "power").mkdir()
        made.make(tmp_path / name / "power")
        power[name] = tmp_path / name / "power"
    expected = {name: noise_level(read_delay_spectra(folder)) for name, folder in power.items()}
    assert excess_noise(power["all"], power["all"]) == 1
    ratio = excess_noise(power["some"], power["all"])
    assert ratio == pytest.approx(np.sqrt(6 / 4 * 6 / 3))
    # 10 baselines and 32 delays, neighbouring ones correlated by the taper.
    assert expected["some"] / expected["all"] == pytest.approx(ratio, rel=0.2)
