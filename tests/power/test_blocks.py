"""Averages over blocks of a run: coherent within each, incoherent across them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, SkyCoord
from astropy.time import Time

from calstudy.base.constants import SIDEREAL_DAY
from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, from_cube, to_cube
from calstudy.instrument.array_layouts.geometric import GolombLayout, HexLayout
from calstudy.power.average import average_in_blocks, divide, fringe_stop_and_average
from calstudy.power.binned import independent_times, modes_in_bins, noise_level, sample_modes, spherical_average
from calstudy.power.interface import estimate_spectra
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra
from calstudy.power.tables import load_spectrum, save_spectrum
from calstudy.realdata.halves import Parts

SETTINGS = PowerSettings(pairs="same-baseline")
DAY = 86400.0


@pytest.fixture(scope="module")
def hour(observe):
    """One hour of 20 s integrations on five antennas."""
    return observe(GolombLayout(kind="golomb", count=5, spacing="20 m"), n_channels=16, n_times=180, integration=20.0)


def blocks_of(uvd, coherent_time, span=None):
    times, integration = np.unique(uvd.time_array), float(uvd.integration_time[0])
    first, last = span or (times[0], times[-1])
    count = PowerSettings(coherent_time=f"{coherent_time} s").n_blocks((last - first) * DAY + integration, integration)
    return divide(times, integration, count, span)


@pytest.mark.parametrize("coherent_time", [20.0, 25.0, 400.0, 600.0, 3599.0, 3600.0, 86400.0])
def test_blocks_hold_every_integration_once_and_are_no_longer_than_asked(hour, coherent_time):
    blocks = blocks_of(hour, coherent_time)
    np.testing.assert_array_equal(np.concatenate([block.times for block in blocks]), np.arange(180))
    assert max(block.times.size for block in blocks) * 20 <= coherent_time
    # No more blocks than that takes.
    assert len(blocks) == np.ceil(180 / (coherent_time // 20))


def test_a_gap_has_no_block():
    times = np.concatenate([np.arange(30), np.arange(120, 150)]) * 10 / DAY + 2459000.0
    blocks = divide(times, 10.0, 5)
    assert [block.times.size for block in blocks] == [30, 30]


def test_one_block_is_the_average_of_the_run(hour, white, rng):
    data = white(hour, rng)
    whole, block = fringe_stop_and_average(data), average_in_blocks(data, blocks_of(data, 3600.0))
    np.testing.assert_allclose(block.data_array, whole.data_array, rtol=0, atol=1e-6)


def test_a_source_away_from_the_zenith_is_lost_in_an_hour_and_kept_in_blocks(hour, drifting_source):
    middle = Time((hour.time_array.min() + hour.time_array.max()) / 2, format="jd")
    place = AltAz(obstime=middle, location=hour.telescope.location)
    data = drifting_source(hour, SkyCoord(alt=60 * u.deg, az=40 * u.deg, frame=place).icrs)
    longest = np.argmax(np.linalg.norm(baseline_vectors(hour), axis=1))
    assert np.abs(to_cube(fringe_stop_and_average(data)))[0, longest].max() < 0.5
    # 1 min on 220 m: the offset of the block's own phase centre is what is left.
    first = data.select(times=np.unique(data.time_array)[:30], inplace=False)
    kept = np.abs(to_cube(average_in_blocks(first, blocks_of(first, 60.0))))
    assert kept.shape[0] == 10
    assert kept[:, longest].min() > 0.99


def test_interleaved_halves_have_the_same_phase_centres(hour, drifting_source):
    times = np.unique(hour.time_array)[:36]
    data = drifting_source(hour.select(times=times, inplace=False), SkyCoord(ra=30 * u.deg, dec=-20 * u.deg))
    span = (times[0], times[-1])
    halves = [data.select(times=times[start::2], inplace=False) for start in (0, 1)]
    own, common = (
        [average_in_blocks(half, blocks_of(half, 120.0, chosen)).data_array for half in halves]
        for chosen in (None, span)
    )
    # Halves whose blocks are divided by their own times are phased to points that are one integration apart.
    assert np.abs(common[0] - common[1]).max() < 0.2 * np.abs(own[0] - own[1]).max()


def test_powers_of_blocks_are_averaged_and_their_noise_falls(observe, white, beam, rng, tmp_path):
    template = observe(GolombLayout(kind="golomb", count=8), n_channels=64, n_times=12, integration=600.0)
    even, odd = white(template, rng), white(template, rng)
    found = estimate_spectra(even, odd, beam, SETTINGS, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"block-{number}" for number in range(1, 13))
    rows = [np.arange(number * even.Nbls, (number + 1) * even.Nbls) for number in range(12)]
    single = [
        estimate_spectra(*(uvd.select(blt_inds=chosen, inplace=False) for uvd in (even, odd)), beam, SETTINGS)
        for chosen in rows
    ]
    np.testing.assert_allclose(found.power, np.mean([one.power for one in single], axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.share_power, np.mean([one.share_power for one in single], axis=0), rtol=1e-12)
    assert (found.n_times, single[0].n_times) == (12, 1)
    # sigma of a single product is the same; 28 x 64 samples, correlated by the taper, give it to 3 %.
    assert noise_level(found) == pytest.approx(np.mean([noise_level(one) for one in single]), rel=0.1)
    assert found.power.real.std() == pytest.approx(single[0].power.real.std() / np.sqrt(12), rel=0.1)
    spectra = [spherical_average(one, SETTINGS, exclude_wedge=False) for one in (found, single[0])]
    used = spectra[0].n_modes > 0
    np.testing.assert_allclose(spectra[0].noise_modes[used], 12 * spectra[1].noise_modes[used])
    np.testing.assert_allclose(spectra[0].cross_modes[used], 12 * spectra[1].cross_modes[used])
    bins = modes_in_bins(found, SETTINGS, exclude_wedge=False)
    ratio = sample_modes(found, bins, used.size)[used] / sample_modes(single[0], bins, used.size)[used]
    np.testing.assert_allclose(ratio, found.independent_times)
    assert 1 < found.independent_times < 12


def test_the_signal_of_a_drifting_beam_has_as_many_independent_samples_as_said(rng):
    # White sky in the direction of the drift, seen by a Gaussian beam at eight times 20 min apart; the power of a
    # baseline across the drift. The latitude is the equator's, where the zenith moves fastest.
    sigma, steps = 0.12, np.deg2rad(5.0) * np.arange(8)
    sky = np.linspace(-0.7, 1.4, 300)
    beams = np.exp(-((sky - steps[:, None]) ** 2) / (2 * sigma**2))
    draws = rng.normal(size=(20000, sky.size)) + 1j * rng.normal(size=(20000, sky.size))
    powers = np.abs(draws @ beams.T) ** 2
    found = powers.var(axis=0).mean() / powers.mean(axis=1).var()
    # A sample variance of 20,000 exponential variates is known to 2 %.
    assert independent_times(steps, 0.0, np.pi * sigma**2) == pytest.approx(found, rel=0.06)


def test_flagged_blocks_and_baselines_are_left_out(observe, white, beam, rng):
    template = observe(GolombLayout(kind="golomb", count=4), n_times=4, integration=600.0)
    even, odd = white(template, rng), white(template, rng)
    n = even.Nbls
    even.flag_array[:n] = True  # an integration
    odd.flag_array[2 * n + 1] = True  # a baseline in another
    found = estimate_spectra(even, odd, beam, SETTINGS)
    assert found.n_times == 3
    assert len(found.vectors) == n - 1
    with pytest.raises(InputError, match=r"power\.coherent_time: even and odd data have 4 and 3 blocks"):
        estimate_spectra(even, odd.select(blt_inds=np.arange(3 * n), inplace=False), beam, SETTINGS)


@pytest.mark.parametrize("pairs", ["same-baseline", "redundant-group"])
def test_pairs_that_a_block_lacks_are_left_out_of_all(pairs, observe, white, beam, rng):
    settings = PowerSettings(pairs=pairs)
    template = observe(HexLayout(kind="hex", side=2), n_channels=64, n_times=2, integration=600.0)
    even, odd = white(template, rng), white(template, rng)
    whole = estimate_spectra(even, odd, beam, settings)
    for antenna in (0, 6):
        rows = even.Nbls + np.flatnonzero((antenna_pairs(even) == antenna).any(axis=1))
        even.flag_array[rows, 26:] = odd.flag_array[rows, :26] = True
    part = estimate_spectra(even, odd, beam, settings)
    assert part.n_times == 2
    assert part.n_pairs.sum() < whole.n_pairs.sum()


def test_blocks_without_one_of_the_polarizations_are_left_out(observe, white, beam, rng):
    template = observe(GolombLayout(kind="golomb", count=4), n_times=3, integration=600.0, polarizations=("xx", "yy"))
    even, odd = white(template, rng), white(template, rng)
    n = even.Nbls
    even.flag_array[n : 2 * n, :, 1] = True
    assert estimate_spectra(even, odd, beam, SETTINGS).n_times == 2
    odd.flag_array[2 * n :, :, 0] = even.flag_array[:n, :, 0] = True
    with pytest.raises(InputError, match=r"power\.coherent_time: every block lacks one of the polarizations xx, yy"):
        estimate_spectra(even, odd, beam, SETTINGS)


def test_baselines_that_lack_a_polarization_in_turn_are_refused(observe, white, beam, rng):
    template = observe(GolombLayout(kind="golomb", count=3), n_times=3, integration=600.0, polarizations=("xx", "yy"))
    even = white(template, rng)
    for block in range(3):
        even.flag_array[block * even.Nbls + block, :, 1] = True
    with pytest.raises(InputError, match="every baseline is flagged altogether in one of the blocks, in one of the"):
        estimate_spectra(even, white(template, rng), beam, SETTINGS)


def test_spectra_that_were_stored_before_there_were_blocks_are_of_one(observe, white, beam, rng, tmp_path):
    import h5py

    template = observe(GolombLayout(kind="golomb", count=3))
    save_spectrum(tmp_path / "old.h5", estimate_spectra(white(template, rng), white(template, rng), beam, SETTINGS))
    with h5py.File(tmp_path / "old.h5", "a") as file:
        del file["n_times"], file["independent_times"]
    assert load_spectrum(tmp_path / "old.h5", DelaySpectra).n_times == 1


def test_from_cube_of_blocks_keeps_their_order(hour, rng):
    cube = np.arange(180)[:, None, None, None] * np.ones((180, hour.Nbls, hour.Nfreqs, 1), complex)
    averaged = average_in_blocks(from_cube(hour, cube), blocks_of(hour, 600.0))
    assert (np.diff(averaged.time_array.reshape(6, -1)[:, 0]) > 0).all()


def averaging(times, coherent_time, odd=None, part="even"):
    """How halves are averaged, interleaved or two data sets, of integrations of 10 s with these numbers."""

    def facts(found):
        found = np.asarray(found) * 10 / DAY + 2459000.0
        sidereal = 2 * np.pi * (found - 2459000.0) / SIDEREAL_DAY % (2 * np.pi)
        return SimpleNamespace(
            times=found, sidereal_times=sidereal, integration=10.0, duration=np.ptp(found) * DAY + 10
        )

    even = facts(times)
    halves = Parts({"even": even, "odd": even if odd is None else facts(odd)})
    return halves.averaging(PowerSettings(coherent_time=coherent_time and f"{coherent_time} s"), part)


@pytest.mark.parametrize("coherent_time", [None, 60.0])
@pytest.mark.parametrize("late", [0.0, 0.4, -1.0, 3.7])
def test_two_nights_are_phased_to_the_same_point_of_the_sky(coherent_time, late):
    """The other night begins and ends at other sidereal times; its integrations are as long after the even ones."""
    nights = 3 * SIDEREAL_DAY
    odd = np.arange(24) + nights * DAY / 10 + late
    even, other = (averaging(np.arange(24), coherent_time, odd, part) for part in ("even", "odd"))
    name = "centre" if coherent_time is None else "span"
    # A millisecond is 0.015 arcsec.
    np.testing.assert_allclose(np.array(other[name]) - np.array(even[name]), nights, atol=1e-3 / DAY)
    same = averaging(np.arange(24), coherent_time, None, "odd")
    assert same[name] == even[name]


def test_halves_of_measured_data_have_the_blocks_that_both_have():
    whole = averaging(np.arange(24), 60.0)
    assert whole["blocks"] == 4
    assert "kept" not in whole
    # Of the block of integrations 6 to 11 only number 6 is there, which is in the even half.
    gap = averaging([*range(7), *range(12, 24)], 60.0)
    assert (gap["blocks"], gap["kept"]) == (4, [0, 2, 3])


@pytest.mark.parametrize(
    ("times", "coherent_time", "odd", "told"),
    [
        (np.arange(7), 15.0, None, "must hold two integrations, 20 s"),
        ([0, 20], 30.0, None, "gaps leave no block"),
    ],
)
def test_blocks_that_halves_cannot_share_are_refused_by_the_plan(times, coherent_time, odd, told):
    with pytest.raises(InputError, match=rf"power\.coherent_time.*{told}"):
        averaging(times, coherent_time, odd)


def test_baselines_that_are_flagged_in_turn_are_refused(observe, white, beam, rng):
    template = observe(GolombLayout(kind="golomb", count=3), n_times=3, integration=600.0)
    even = white(template, rng)
    for block in range(3):
        even.flag_array[block * even.Nbls + block] = True
    with pytest.raises(InputError, match="every baseline is flagged altogether in one of the blocks"):
        estimate_spectra(even, white(template, rng), beam, SETTINGS)
