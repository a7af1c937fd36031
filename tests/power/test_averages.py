from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy import constants
from hera_pspec import grouping
from hypothesis import given
from hypothesis import strategies as st

from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, from_cube, to_cube
from calstudy.instrument.array_layouts.geometric import HexLayout
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.layouts import redundant_groups
from calstudy.power import binned, delay
from calstudy.power import cosmology as c
from calstudy.power.binned import cylindrical_average, make_bin_edges, modes_in_bins, noise_error, spherical_average
from calstudy.power.clusters import clusters_in_k
from calstudy.power.estimate import estimate_power
from calstudy.power.settings import KBins, PowerSettings
from calstudy.power.spectra import (
    CylindricalSpectrum,
    DelaySpectra,
    SphericalSpectrum,
    delay_spectra,
    length_bins,
    of_common_units,
    outside_wedge,
)
from calstudy.power.tables import load_spectrum, save_spectrum, write_csv
from calstudy.power.transfer import Injection, bin_expected, cylindrical_transfer
from calstudy.products.files import spectrum_file
from calstudy.products.observed import WHAT
from calstudy.products.observed_results import ObservedSpectra
from calstudy.products.spectra import DELAY_SPECTRA
from calstudy.realdata.noise import half_difference, noise_of_average, noise_of_units

SETTINGS = PowerSettings(bins=KBins(max="2.0 h/Mpc", width="0.1 h/Mpc"))
FREQUENCY, WIDTH, OMEGA_PP = 182e6, 80e3, 0.07


def make_spectra(power, vectors, n_pairs=None, taper="blackman-harris", n_polarizations=1):
    cosmo, tau = c.make_cosmology("Planck15"), delay.delays(power.shape[1], WIDTH)
    return DelaySpectra(
        power=power,
        vectors=vectors,
        n_pairs=np.ones(len(vectors), dtype=int) if n_pairs is None else n_pairs,
        n_polarizations=n_polarizations,
        delay=tau,
        k_perp=c.k_perpendicular(cosmo, np.linalg.norm(vectors, axis=1), FREQUENCY),
        k_parallel=c.k_parallel(cosmo, tau, FREQUENCY),
        frequency=FREQUENCY,
        omega_pp=OMEGA_PP,
        taper=taper,
    )


def white_delay_spectra(rng, shape, taper):
    """Tapered delay spectra of unit-variance noise: mean power one at each delay."""
    noise = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
    window = delay.make_taper(taper, shape[-1])
    return np.fft.fftshift(np.fft.fft(noise * window, axis=-1), axes=-1) / np.sqrt(np.sum(window**2))


def cross_group(even, odd):
    """Mean over i != j of conj(even_i) odd_j; arrays of shape (..., n, Nd)."""
    n = even.shape[-2]
    total = even.conj().sum(axis=-2) * odd.sum(axis=-2) - (even.conj() * odd).sum(axis=-2)
    return total / (n * (n - 1))


def spherical_averages(power, spectra, settings, exclude_wedge):
    """The spherical average of each of many powers, (N, Nu, Nd), on the same baselines, and the powers in its bins.

    It is linear in the power, and its bins and numbers of modes are the same for all.
    """
    trials = [
        spherical_average(dataclasses.replace(spectra, power=one), settings, exclude_wedge) for one in power[[0, -1]]
    ]
    bins = modes_in_bins(spectra, settings, exclude_wedge)
    weights = (bins == np.arange(trials[0].k.size)[:, None, None]) * spectra.n_pairs[:, None]
    filled = trials[0].n_modes > 0
    values = np.einsum("nud,bud->nb", power, weights[filled]) / weights[filled].sum(axis=(1, 2))
    for trial, found in zip(trials, values[[0, -1]], strict=True):
        np.testing.assert_allclose(found, trial.power[filled], rtol=1e-9)
    return trials[0], values.real, filled


@pytest.fixture(
    scope="module", params=[MwaLayout(kind="mwa-compact-minredundant", count=7), HexLayout(kind="hex", side=2)]
)
def estimated(request, observe, white, beam):
    template, rng = observe(request.param, n_channels=24), np.random.default_rng(8)
    return estimate_power(white(template, rng), white(template, rng), beam, SETTINGS)


def test_spherical_average_equals_hera_pspec(estimated):
    mine = spherical_average(delay_spectra(estimated, SETTINGS), SETTINGS, exclude_wedge=False)
    theirs = grouping.spherical_average(estimated, mine.k, np.diff(mine.bin_edges))
    filled = mine.n_modes > 0
    assert filled.sum() > 3
    # Baselines of a group differ by centimetres, so that modes next to an edge may change bins.
    np.testing.assert_allclose(mine.power[filled], theirs.data_array[0][0, filled, 0], rtol=1e-9)


def test_units_are_baselines_or_groups(estimated):
    spectra = delay_spectra(estimated, SETTINGS)
    assert spectra.n_pairs.sum() == estimated.Nblpairs
    assert np.mean(spectra.power * spectra.n_pairs[:, None]) * len(spectra.n_pairs) / estimated.Nblpairs == (
        pytest.approx(estimated.data_array[0].mean(), rel=1e-9)
    )
    lengths = np.repeat(spectra.length, spectra.n_pairs)
    np.testing.assert_allclose(np.sort(lengths), np.sort(estimated.get_blpair_seps()), atol=1e-3)
    np.testing.assert_allclose(spectra.k_parallel, estimated.get_kparas(0), rtol=1e-6)


def test_gaps_in_frequency_leave_the_power_of_white_data_as_it_is(observe, white, beam):
    """The estimator weighs flagged channels zero, and divides by the weights that are left."""
    template = observe(MwaLayout(kind="mwa-compact-minredundant", count=24), n_channels=32)
    data = white(template, np.random.default_rng(10))
    whole = delay_spectra(estimate_power(data, data, beam, SETTINGS), SETTINGS)
    data.flag_array[:, [3, 11, 12, 20]] = True
    data.data_array[:, [3, 11, 12, 20]] = 1e6
    gaps = delay_spectra(estimate_power(data, data, beam, SETTINGS), SETTINGS)
    # 276 baselines of about 16 independent delays: the mean of a power is known to 1 / sqrt(4416) = 1.5 %.
    assert gaps.power.real.mean() == pytest.approx(whole.power.real.mean(), rel=0.06)


@pytest.mark.parametrize("flagged", [[], [28, 36], [0, 32], [0, 24, 40, 64]], ids=["none", "middle", "half", "most"])
def test_flagged_channels_correlate_delays(flagged, observe, white, beam):
    """The mean over some delays of a baseline has the scatter of its number of independent modes."""
    template = observe(MwaLayout(kind="mwa-compact-minredundant", count=24), n_channels=64)
    rng, found, settings = np.random.default_rng(11), [], SETTINGS.model_copy(update={"taper": "hann"})
    for _ in range(12):
        even, odd = white(template, rng), white(template, rng)
        for first, last in zip(flagged[::2], flagged[1::2], strict=True):
            even.flag_array[:, first:last] = odd.flag_array[:, first:last] = True
        found.append(delay_spectra(estimate_power(even, odd, beam, settings), settings))
    count = len(found[0].n_pairs)
    bins = np.where((np.arange(64) > 40) & (np.arange(64) < 52), np.arange(count)[:, None], -1)
    modes = binned.product_modes(found[0], bins, count, found[0].n_pairs)
    powers = np.array([one.power.real for one in found])
    ratio = powers[..., 41:52].mean(axis=-1).var() / np.mean(powers[..., 41:52].var(axis=(0, 1)) / modes[0])
    # 3312 means of a few products: their variance is known to about 4 %.
    # With the taper's correlation alone it is 1.8 and 1.9 for half and most of the channels.
    assert ratio == pytest.approx(1, abs=0.12)


def test_flagged_baselines_are_left_out(observe, white, beam):
    template, rng = (
        observe(MwaLayout(kind="mwa-compact-minredundant", count=5), n_channels=16),
        np.random.default_rng(9),
    )
    even, odd = white(template, rng), white(template, rng)
    even.flag_array[3] = True
    spectra = delay_spectra(estimate_power(even, odd, beam, SETTINGS), SETTINGS)
    assert len(spectra.n_pairs) == template.Nbls - 1
    removed = np.linalg.norm(baseline_vectors(template)[3])
    assert np.abs(spectra.length - removed).min() > 0.01
    even.flag_array[:] = True
    with pytest.raises(InputError, match="no pair of baselines has data in the same channels"):
        delay_spectra(estimate_power(even, odd, beam, SETTINGS), SETTINGS)


@pytest.mark.parametrize(("until", "since"), [(14, 11), (26, 26)])
def test_pairs_with_few_channels_in_common_are_left_out(until, since, observe, white, beam, caplog):
    """The power of such a pair is divided by little: its noise would be that of hundreds of others."""
    settings = PowerSettings(pairs="redundant-group")
    template, rng = observe(HexLayout(kind="hex", side=2), n_channels=64), np.random.default_rng(3)
    even, odd = white(template, rng), white(template, rng)
    whole = estimate_power(even, odd, beam, settings)
    for uvd in (even, odd):
        antennas = antenna_pairs(uvd)
        uvd.flag_array[(antennas == 0).any(axis=1), until:] = True
        uvd.flag_array[(antennas == 6).any(axis=1), :since] = True
    part = estimate_power(even, odd, beam, settings)
    noise = np.sqrt(
        np.mean(np.abs(part.data_array[0][..., 0]) ** 2, axis=1) / np.mean(np.abs(whole.data_array[0]) ** 2)
    )
    # The rms of a pair has a scatter of about 0.2: the taper leaves some 30 delays that are independent.
    assert 0.3 * whole.Nblpairs < part.Nblpairs < whole.Nblpairs
    assert noise.max() < 2.5
    assert f"{whole.Nblpairs - part.Nblpairs} of {whole.Nblpairs} pairs of baselines are left out" in caplog.text


@given(
    n_units=st.integers(1, 12),
    n_delays=st.integers(4, 40),
    seed=st.integers(0, 999),
    buffer=st.floats(0, 5e-6),
)
def test_averages_of_a_constant_are_that_constant(n_units, n_delays, seed, buffer):
    rng = np.random.default_rng(seed)
    vectors, n_pairs = rng.normal(size=(n_units, 3)) * 50, rng.integers(1, 9, n_units)
    spectra = make_spectra(np.full((n_units, n_delays), 3.0 - 2.0j), vectors, n_pairs)
    settings = PowerSettings(wedge_buffer=f"{buffer} s")
    outside, everything = (spherical_average(spectra, settings, exclude_wedge=e) for e in (True, False))
    for spectrum in (outside, everything):
        filled = spectrum.n_modes > 0
        np.testing.assert_allclose(spectrum.power[filled], 3.0 - 2.0j)
        assert np.isnan(spectrum.power[~filled]).all()
        assert ((spectrum.sample_modes > 0) == filled).all()
        assert (spectrum.sample_modes <= spectrum.n_modes * (1 + 1e-9)).all()
    assert (outside.n_modes <= everything.n_modes).all()
    assert (
        outside.n_modes.sum()
        == outside_wedge(spectra, buffer)[
            np.hypot(spectra.k_perp[:, None], spectra.k_parallel) <= everything.bin_edges[-1]
        ].sum()
    )
    np.testing.assert_allclose(cylindrical_average(spectra, settings).power, 3.0 - 2.0j)


def test_the_wedge_mask_is_the_horizon_plus_the_buffer():
    vectors = np.array([[30.0, 0, 0], [0, 90.0, 0]])
    spectra = make_spectra(np.ones((2, 384), dtype=complex), vectors)
    mask = outside_wedge(spectra, 100e-9)
    for row, length in zip(mask, (30.0, 90.0), strict=True):
        edge = length / constants.c.value + 100e-9
        assert np.abs(spectra.delay[row]).min() > edge
        assert np.abs(spectra.delay[~row]).max() <= edge


def test_bins_reach_the_maximum():
    edges = make_bin_edges(KBins())
    assert edges.size == 86
    assert edges[-1] == pytest.approx(3.4)
    with pytest.raises(ValueError, match=r"0\.5 h/Mpc must be larger than min, 1 h/Mpc"):
        KBins(min="1.0 h/Mpc", max="0.5 h/Mpc")
    assert make_bin_edges(KBins(max="1.0 h/Mpc", width="0.3 h/Mpc"))[-1] == pytest.approx(1.2)


@pytest.mark.parametrize("n_delays", [15, 16])
def test_folding_averages_opposite_delays(n_delays):
    rng = np.random.default_rng(1)
    power = rng.normal(size=(6, n_delays)) + 1j * rng.normal(size=(6, n_delays))
    spectra = make_spectra(power, rng.normal(size=(6, 3)) * 20)
    folded = cylindrical_average(spectra, SETTINGS)
    edges, row = length_bins(spectra.length, SETTINGS.length_bin)
    flat = np.array([power[row == number].mean(axis=0) for number in range(len(edges))])
    np.testing.assert_array_equal(folded.bin_edges, edges)
    assert folded.delay[0] == 0
    assert folded.k_parallel[0] == 0
    zero = n_delays // 2
    np.testing.assert_allclose(folded.power[:, 0], flat[:, zero])
    np.testing.assert_allclose(folded.power[:, 3], (flat[:, zero + 3] + flat[:, zero - 3]) / 2)
    np.testing.assert_allclose(folded.delay[3], spectra.delay[zero + 3])
    if n_delays % 2 == 0:
        np.testing.assert_allclose(folded.power[:, -1], flat[:, 0])
    assert (np.diff(folded.baseline_length) > 0).all()
    assert ((edges[:, 0] <= folded.baseline_length) & (folded.baseline_length < edges[:, 1])).all()
    np.testing.assert_allclose(folded.horizon_delay, folded.baseline_length / constants.c.value)


@pytest.mark.parametrize("taper", ["blackman-harris", "none"])
@pytest.mark.parametrize("n", [1, 4])
def test_noise_errors_equal_the_scatter(taper, n):
    """Noise only: baselines with themselves (n = 1), or groups of n with the others of the group."""
    rng, n_units, n_delays, n_trials = np.random.default_rng(21), 5, 48, 1500
    vectors = rng.normal(size=(n_units, 3)) * 30
    shape = (n_trials, n_units, n, n_delays)
    even, odd = (white_delay_spectra(rng, shape, taper) for _ in range(2))
    power = (even.conj() * odd)[:, :, 0] if n == 1 else cross_group(even, odd)
    n_pairs = np.full(n_units, 1 if n == 1 else n * (n - 1))
    spectra = make_spectra(power[0], vectors, n_pairs, taper)
    trial, values, filled = spherical_averages(power, spectra, SETTINGS, exclude_wedge=True)
    levels = [binned.noise_level(dataclasses.replace(spectra, power=one)) for one in power]
    assert np.sqrt(np.mean(np.square(levels))) == pytest.approx(np.sqrt(0.5), rel=0.01)
    predicted = binned.with_errors(trial, noise=np.sqrt(0.5)).error[filled]
    # 1500 trials give each standard deviation to 2 %.
    np.testing.assert_allclose(values.std(axis=0), predicted, rtol=0.07)
    assert np.mean(values.std(axis=0) / predicted) == pytest.approx(1.0, abs=0.015)


@pytest.mark.parametrize("n", [1, 4])
def test_noise_errors_of_units_that_differ_equal_the_scatter(n):
    rng, n_delays, n_trials = np.random.default_rng(26), 16, 4000
    noise = np.array([1.0, 1.5, 2.0, 2.5, 3.0])
    shape = (n_trials, noise.size, n, n_delays)
    even, odd = (np.sqrt(noise)[:, None, None] * white_delay_spectra(rng, shape, "none") for _ in range(2))
    power = (even.conj() * odd)[:, :, 0] if n == 1 else cross_group(even, odd)
    n_pairs = np.full(noise.size, 1 if n == 1 else n * (n - 1))
    spectra = make_spectra(power[0], rng.normal(size=(noise.size, 3)) * 30, n_pairs, "none")
    predicted = noise_error(spectra, np.zeros(power[0].shape, int), 1, noise)
    # 4000 trials give the standard deviation to 1.1 %; the limit is four times that.
    assert power.real.mean(axis=(1, 2)).std() == pytest.approx(predicted[0], rel=0.045)


@pytest.mark.parametrize("n", [1, 4])
def test_sample_variance_equals_the_scatter(n):
    """Signal only, the same in all baselines of a group: crossing more of them does not help."""
    rng, n_units, n_delays, n_trials = np.random.default_rng(22), 5, 48, 1500
    vectors = rng.normal(size=(n_units, 3)) * 300
    signal = white_delay_spectra(rng, (n_trials, n_units, n_delays), "blackman-harris")
    power = np.abs(signal) ** 2 + 0j
    n_pairs = np.full(n_units, 1 if n == 1 else n * (n - 1))
    settings = PowerSettings(bins=KBins(min="1.5 h/Mpc", max="6.0 h/Mpc", width="0.5 h/Mpc"))
    trial, values, filled = spherical_averages(power, make_spectra(power[0], vectors, n_pairs), settings, False)
    expected = dataclasses.replace(trial, power=np.ones_like(trial.power))
    predicted = binned.with_errors(expected, signal=expected)
    np.testing.assert_allclose(predicted.noise_error[filled], 0)
    np.testing.assert_allclose(values.mean(axis=0), 1.0, rtol=0.05)
    assert np.mean(values.std(axis=0) / predicted.error[filled]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("n", [1, 5])
@pytest.mark.parametrize(("noise", "low", "high"), [(0.0, 0.98, 1.02), (1e3, 0.98, 1.02), (1.0, 1.02, 1.25)])
def test_the_sum_of_errors_is_right_in_the_limits_and_conservative_between(n, noise, low, high):
    """One mode of signal power 1 and noise power `noise`, of a baseline or of a group of n."""
    rng, n_trials = np.random.default_rng(23), 50000
    signal = white_delay_spectra(rng, (n_trials, 1, 4), "none")
    even, odd = (signal + np.sqrt(noise) * white_delay_spectra(rng, (n_trials, n, 4), "none") for _ in range(2))
    power = (even.conj() * odd)[:, 0] if n == 1 else cross_group(even, odd)
    products = 1 if n == 1 else n * (n - 1)
    predicted = 1.0 + noise * np.sqrt(0.5 / products)
    assert low <= predicted / power.real.std() <= high


def test_signal_of_neighbouring_baselines_is_not_counted_twice():
    """The scatter over white skies seen through a Gaussian beam by baselines a few metres apart."""
    rng, n_trials, n_delays, sigma = np.random.default_rng(24), 1200, 8, np.sqrt(OMEGA_PP / np.pi)
    vectors = np.array([[40, 0, 0], [41, 0, 0], [42.5, 1, 0], [-41.5, -1.5, 0], [60, 3, 0]], dtype=float)
    axis = np.linspace(-4 * sigma, 4 * sigma, 33)
    sky = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    response = np.exp(-0.5 * (sky**2).sum(axis=1) / sigma**2) * np.exp(
        2j * np.pi * FREQUENCY / constants.c.value * vectors[:, :2] @ sky.T
    )
    response /= np.sqrt((np.abs(response) ** 2).sum(axis=1, keepdims=True))
    brightness = rng.normal(size=(sky.shape[0], n_delays * n_trials))
    visibilities = (response @ brightness).reshape(len(vectors), n_trials, n_delays)
    power = np.abs(np.fft.fft(visibilities, axis=-1)) ** 2 / n_delays + 0j
    settings = PowerSettings(bins=KBins(max="20.0 h/Mpc", width="20.0 h/Mpc"))
    power = power.swapaxes(0, 1)
    spectra = make_spectra(power[0], vectors, taper="none")
    trial, values, _ = spherical_averages(power, spectra, settings, False)
    expected = dataclasses.replace(trial, power=np.ones(1, dtype=complex))
    assert values.std() / binned.with_errors(expected, signal=expected).error[0] == pytest.approx(1.0, abs=0.06)
    assert trial.sample_modes[0] < 0.75 * trial.n_modes[0]


@pytest.mark.parametrize("n", [1, 4])
def test_the_error_of_the_difference_is_the_scatter_where_the_signal_is_common(n):
    """Signal and noise of power 1 on close baselines, whose signal is partly the same, or on groups of n."""
    rng, n_delays, n_trials = np.random.default_rng(25), 32, 2000
    vectors = np.array([[40, 0, 0], [90, 3, 0], [20, 70, 0]], dtype=float)
    if n == 1:
        # Each three times: independent noise, the same signal.
        vectors = np.repeat(vectors, 3, axis=0)
    shape = (n_trials, len(vectors), n, n_delays)
    signal = white_delay_spectra(rng, (n_trials, 3, 1, n_delays), "blackman-harris")
    signal = np.repeat(signal, len(vectors) // 3, axis=1)
    even, odd = (signal + white_delay_spectra(rng, shape, "blackman-harris") for _ in range(2))
    power = (even.conj() * odd)[:, :, 0] if n == 1 else cross_group(even, odd)
    n_pairs = np.full(len(vectors), 1 if n == 1 else n * (n - 1))
    settings = PowerSettings(bins=KBins(min="1.5 h/Mpc", max="4.5 h/Mpc", width="1.0 h/Mpc"))
    spectra = make_spectra(power[0], vectors, n_pairs)
    trial, total, filled = spherical_averages(power, spectra, settings, False)
    sky = spherical_averages(np.abs(signal[:, :, 0]) ** 2 + 0j, spectra, settings, False)[1]
    assert filled.all()
    scatter = np.std(total - sky, axis=0)
    expected = dataclasses.replace(trial, power=np.ones_like(trial.power))
    predicted = binned.with_errors(trial, noise=np.sqrt(0.5), signal=expected).difference_error
    # 2000 trials give each standard deviation to 1.6 %; limits are four times that.
    np.testing.assert_allclose(scatter / predicted, 1.0, atol=0.065)
    assert np.mean(scatter / predicted) == pytest.approx(1.0, abs=0.04)


def test_polarizations_share_the_signal_not_the_noise():
    spectra = make_spectra(np.ones((3, 16), dtype=complex), np.eye(3) * 40)
    two = dataclasses.replace(spectra, n_polarizations=2)
    bins = np.zeros((3, 16), dtype=int)
    np.testing.assert_allclose(
        binned.product_modes(two, bins, 1, two.n_pairs), 2 * binned.product_modes(spectra, bins, 1, spectra.n_pairs)
    )
    np.testing.assert_allclose(binned.sample_modes(two, bins, 1), binned.sample_modes(spectra, bins, 1))


def test_noise_power_from_visibilities_has_its_known_level(observe, white, beam):
    """sigma_N = P_N / sqrt(2) with P_N from the standard deviation of the visibilities, groups or not."""
    template = observe(HexLayout(kind="hex", side=3), n_channels=32)
    cosmo, z = c.make_cosmology("Planck15"), c.redshift(template.freq_array.mean())
    omega_pp = beam.solid_angles(template.freq_array, "xx")[1].mean()
    kelvin = 2 * 0.5e-26 * (constants.c.value / template.freq_array.mean()) ** 2 / constants.k_B.value
    volume = c.transverse_scale(cosmo, z) ** 2 * c.radial_scale(cosmo, z) * cosmo.h**3
    p_noise = 1e6 * volume / omega_pp * WIDTH * (7.0 * kelvin) ** 2
    for pairs in ("same-baseline", "redundant-group"):
        rng, settings = np.random.default_rng(31), PowerSettings(pairs=pairs)
        uvp = estimate_power(white(template, rng, 7.0), white(template, rng, 7.0), beam, settings)
        level = binned.noise_level(delay_spectra(uvp, settings))
        assert level == pytest.approx(p_noise / np.sqrt(2), rel=0.08)


@pytest.mark.parametrize("shares", [True, False])
def test_baselines_of_the_same_vector_have_their_own_noise(observe, white, beam, shares):
    """Without shares, by which antennas are known, they have the mean of those of their vector."""
    template, rng = observe(HexLayout(kind="hex", side=3), n_channels=8), np.random.default_rng(4)
    settings = PowerSettings(pairs="same-baseline")
    whole = delay_spectra(estimate_power(white(template, rng), white(template, rng), beam, settings), settings)
    # A baseline without spectra, and one whose noise is not known.
    noise, spectra = whole, whole.of_units(np.arange(1, len(whole.n_pairs)))
    level = np.arange(len(whole.n_pairs)) + 1.0
    level[7] = np.nan
    if shares:
        expected = np.where(np.isnan(level), np.nanmean(level), level)[1:]
    else:
        empty = {name: np.zeros(0, int) for name in ("share_unit", "share_antenna", "share_pairs")}
        noise, spectra = (dataclasses.replace(one, **empty) for one in (noise, spectra))
        places = np.rint(whole.vectors).astype(int)
        places *= np.where(places[:, 0] != 0, np.sign(places[:, 0]), np.sign(places[:, 1]))[:, None]
        same = (places[:, None] == places).all(axis=2)
        expected = np.array([np.nanmean(level[row]) for row in same])[1:]
    np.testing.assert_allclose(noise_of_units(spectra, noise, level, 1.0), expected)


def test_redundant_groups_have_the_mean_noise_of_their_baselines(observe, white, beam):
    template, rng = observe(HexLayout(kind="hex", side=2), n_channels=8), np.random.default_rng(4)
    data = white(template, rng)
    noise, groups = (
        delay_spectra(estimate_power(data, data, beam, settings), settings)
        for settings in (PowerSettings(pairs="same-baseline"), PowerSettings(pairs="redundant-group"))
    )
    # The spacing is 14 m. The baselines of 28 m have no partner: their interference is in no group.
    for alone in (np.nan, 1e6):
        level = np.where(noise.length > 27, alone, noise.length**2)
        found = noise_of_units(groups, noise, level, 1.0)
        np.testing.assert_allclose(found, groups.length**2, rtol=1e-3)


def test_without_noise_errors_are_zero(observe, white, beam):
    template = observe(HexLayout(kind="hex", side=2), n_channels=8)
    settings = PowerSettings(pairs="same-baseline")
    data = white(template, np.random.default_rng(4))
    spectra = delay_spectra(estimate_power(data, data, beam, settings), settings)
    bins = np.where(np.arange(spectra.power.shape[1]) > 3, 1, -1) * np.ones(spectra.power.shape, int)
    found = noise_error(spectra, bins, 3, np.zeros(len(spectra.power)))
    np.testing.assert_array_equal(found, [np.nan, 0.0, np.nan])
    # One noisy baseline has its part of the mean of all.
    one, level = noise_error(spectra, bins, 3, np.eye(len(spectra.power))[0]), np.ones(len(spectra.power))
    assert one[1] == pytest.approx(noise_error(spectra, bins, 3, level)[1] / np.sqrt(len(level)), rel=1e-6)


def test_frequencies_that_two_programs_round_are_the_same(observe, white, beam):
    template, rng = observe(HexLayout(kind="hex", side=2), n_channels=8), np.random.default_rng(4)
    even, odd = white(template, rng), white(template, rng)
    odd.freq_array = odd.freq_array + 1.0
    settings = PowerSettings(pairs="same-baseline")
    assert np.isfinite(delay_spectra(estimate_power(even, odd, beam, settings), settings).power).all()
    odd.freq_array = even.freq_array + 0.1 * even.channel_width[0]
    with pytest.raises(ValueError, match="differ in freq_array"):
        estimate_power(even, odd, beam, settings)


def test_noise_of_an_average_is_that_of_the_samples_whose_variance_is_known(observe, white):
    template = observe(HexLayout(kind="hex", side=2), n_channels=8, n_times=5)
    data = white(template, np.random.default_rng(1))
    shape = (5, template.Nbls, 8, 1)
    variance, flags = np.full(shape, 9.0), np.zeros(shape, bool)
    variance[0, 1] = variance[:, 2] = np.nan
    flags[1, 3] = flags[:, 4] = True
    data.flag_array = flags.reshape(data.flag_array.shape)
    data.nsample_array[:] = 2.0
    found = noise_of_average(variance, data, np.arange(5))
    np.testing.assert_allclose(found[[0, 1]], 3 / np.sqrt(5))
    np.testing.assert_allclose(found[3], 3 / np.sqrt(4))
    assert np.isnan(found[[2, 4]]).all()


def test_noise_of_an_average_weighs_variances_by_the_squares_of_the_numbers_of_samples(observe, white):
    data = white(observe(HexLayout(kind="hex", side=2), n_channels=8, n_times=2), np.random.default_rng(1))
    shape = (2, data.Nbls, 8, 1)
    counts, variance = (np.broadcast_to(np.reshape(two, (2, 1, 1, 1)), shape) for two in ((1.0, 3.0), (4.0, 1.0)))
    data.nsample_array = counts.reshape(data.nsample_array.shape)
    # Of (n + 3 n') / 4: (1 x 4 + 9 x 1) / 16.
    np.testing.assert_allclose(noise_of_average(variance, data, np.arange(2)), np.sqrt(13 / 16))


def test_samples_of_unknown_noise_have_that_of_their_own_numbers_of_measurements(observe, white):
    """Averages of samples of variance 9 / n scatter as it says they do, whichever of the samples are known."""
    template, rng = observe(HexLayout(kind="hex", side=3), n_channels=64, n_times=8), np.random.default_rng(5)
    shape = (8, template.Nbls, 64, 1)
    counts = rng.uniform(0.05, 2.0, shape)
    data = white(template, rng, sigma=3.0)
    samples = to_cube(data) / np.sqrt(counts)
    data.nsample_array = counts.reshape(data.nsample_array.shape)
    unknown = rng.uniform(size=shape) < 0.5
    found = noise_of_average(np.where(unknown, np.nan, 9.0 / counts), data, np.arange(8))
    whole = noise_of_average(9.0 / counts, data, np.arange(8))
    known = ~unknown.all(axis=0)
    np.testing.assert_allclose(found[known], whole[known], rtol=1e-12)
    averages = np.average(samples, axis=0, weights=counts)[known]
    # Some 10,000 averages: known to 1 %, and the limit is four times that.
    assert np.mean(np.abs(averages / found[known]) ** 2) == pytest.approx(1.0, rel=0.04)


def test_the_difference_of_unequal_halves_has_the_power_of_the_noise_of_their_product(observe, white):
    template, rng = observe(HexLayout(kind="hex", side=3), n_channels=64), np.random.default_rng(3)
    even, odd = white(template, rng, sigma=1.0), white(template, rng, sigma=0.5)
    odd.nsample_array[:] = 4.0
    even.flag_array[1, 2] = odd.flag_array[3, 5] = True
    odd.data_array[3, 5] = 1e6
    found = half_difference(even, odd)
    assert np.argwhere(found.flag_array)[:, :2].tolist() == [[1, 2], [3, 5]]
    # sigma_E sigma_O, of 10,942 samples: known to 1 %, and the limit is four times that.
    assert np.mean(np.abs(found.data_array[~found.flag_array]) ** 2) == pytest.approx(1.0 * 0.5, rel=0.04)


def of_delays(delays, settings, folder):
    """The task that averages delay spectra of measured data, by their names, from files in a folder."""
    for name, spectra in delays.items():
        (folder / name).mkdir()
        save_spectrum(folder / name / DELAY_SPECTRA, spectra)
    return ObservedSpectra("spectra", power=settings, delays={name: folder / name for name in delays})


@pytest.mark.parametrize(("last", "first", "told"), [(10, 4, " ± "), (7, 6, " (error not known)"), (5, 5, "")])
def test_noise_from_two_sources_is_compared_on_the_baselines_of_both(tmp_path, observe, white, beam, last, first, told):
    """Flagged autocorrelations leave baselines without noise from them."""
    template, rng = (
        observe(MwaLayout(kind="mwa-compact-minredundant", count=5), n_channels=64),
        np.random.default_rng(4),
    )
    settings, data = PowerSettings(pairs="same-baseline", wedge_buffer="0 ns"), white(template, rng)
    whole = delay_spectra(estimate_power(data, data, beam, settings), settings)
    known = {"difference": whole.of_units(np.arange(last)), "autos": whole.of_units(np.arange(first, 10))}
    delays = dict.fromkeys(WHAT, whole)
    delays |= {f"noise of {what} from {name}": one for what in ("data", "residual") for name, one in known.items()}
    task = of_delays(delays, settings, tmp_path)
    ratio = task.make(tmp_path)["noise"]["data"]["difference_over_autos"]
    assert (ratio is None) == (first >= last)
    (table,) = task.shown(tmp_path)
    # Powers of the same white data, outside the wedge and everywhere.
    assert ratio is None or ratio["mean"] == pytest.approx(1, abs=0.2)
    assert all(told in row[-1] and bool(told) == bool(row[-1]) for row in table.rows)


def test_bars_of_data_as_given_are_of_their_own_noise_and_all_others_of_that_of_the_residual(
    tmp_path, observe, white, beam
):
    settings = PowerSettings(pairs="same-baseline", wedge_buffer="0 ns")
    template = observe(MwaLayout(kind="mwa-compact-minredundant", count=5), n_channels=64)
    data = white(template, np.random.default_rng(4))
    whole = delay_spectra(estimate_power(data, data, beam, settings), settings)
    noise = {"data": dataclasses.replace(whole, power=9 * whole.power), "residual": whole}
    delays = dict.fromkeys(WHAT, whole) | {f"noise of {name} from difference": one for name, one in noise.items()}
    of_delays(delays, settings, tmp_path).make(tmp_path)
    files = [tmp_path / spectrum_file(what, "outside-wedge") for what in WHAT]
    bars = [load_spectrum(path, SphericalSpectrum).noise_error for path in files]
    assert np.isfinite(bars[0]).sum() > 5
    np.testing.assert_allclose(bars, [bars[0], bars[0] / 9, bars[0] / 9])


def test_equal_lengths_share_a_bin_of_the_wedge(observe, white, beam):
    """Lengths of 14, 28, 42 and 56 m of a hexagon are edges of bins, and differ by rounding."""
    settings = PowerSettings(pairs="same-baseline", length_bin="14 m")
    template = observe(HexLayout(kind="hex", side=3), n_channels=16)
    data = white(template, np.random.default_rng(3))
    spectra = delay_spectra(estimate_power(data, data, beam, settings), settings)
    assert len(np.unique(spectra.length)) > len(np.unique(spectra.length.round(6)))
    counts = np.bincount(np.floor(spectra.length.round(6) / 14 + 1e-9).astype(int))[1:]
    wedge = cylindrical_average(spectra, settings)
    np.testing.assert_array_equal(wedge.n_pairs, counts)
    injection = Injection(spectra, spectra, spectra)
    np.testing.assert_allclose(cylindrical_transfer(injection, 14.0).bin_edges, wedge.bin_edges)
    ones = np.ones(spectra.power.shape)
    expected = bin_expected(spectra, ones, 0 * ones, [0.0, 1.0], 0.0, 14.0)
    np.testing.assert_allclose(expected.length_edges, wedge.bin_edges)


def test_redundant_baselines_without_shares_are_not_matched(observe, white, beam, caplog):
    settings, template = PowerSettings(pairs="same-baseline"), observe(HexLayout(kind="hex", side=2), n_channels=16)
    data = white(template, np.random.default_rng(3))
    whole = delay_spectra(estimate_power(data, data, beam, settings), settings)
    part = whole.of_units(np.arange(2, 12))
    assert of_common_units({"eor": whole, "residual": part})["eor"].power.tolist() == part.power.tolist()
    assert "averages of different numbers" not in caplog.text
    of_common_units({"eor": dataclasses.replace(whole, n_times=3), "residual": whole})
    assert "of times and polarizations (eor 3 and 1, residual 1 and 1), because some were not calibrated" in caplog.text
    empty = {name: np.zeros(0, int) for name in ("share_unit", "share_antenna", "share_pairs")}
    whole, part = (dataclasses.replace(one, **empty) for one in (whole, part))
    assert of_common_units({"eor": whole, "residual": whole})["eor"] is whole
    with pytest.raises(
        InputError, match=r"of eor, residual are not of the same baselines.*\(share_unit, share_antenna"
    ):
        of_common_units({"eor": whole, "residual": part})


def test_redundant_groups_that_lack_an_antenna_keep_the_signal(observe, white, beam, caplog):
    """An antenna without gains is missing in most groups. The other baselines of a group see the same sky."""
    settings = PowerSettings(pairs="redundant-group", wedge_buffer="0 ns")
    template, rng = observe(HexLayout(kind="hex", side=3), n_channels=64), np.random.default_rng(5)
    uvd = white(template, rng)
    groups, cube = redundant_groups(baseline_vectors(uvd), settings.redundancy_tolerance), to_cube(uvd).copy()
    cube = cube[:, np.unique(groups.index, return_index=True)[1][groups.index]]
    uvd = from_cube(uvd, np.where(groups.conjugated[:, None, None], cube.conj(), cube))
    eor = delay_spectra(estimate_power(uvd, uvd, beam, settings), settings)
    for flagged in (0, 9):
        part = uvd.copy()
        part.flag_array |= (antenna_pairs(part) == flagged).any(axis=1)[:, None, None]
        residual = delay_spectra(estimate_power(part, part, beam, settings), settings)
        caplog.clear()
        common = of_common_units({"eor": eor, "residual": residual})
        assert len(common["eor"].n_pairs) == len(residual.n_pairs) > 0.7 * len(eor.n_pairs)
        lost = len(eor.n_pairs) - len(residual.n_pairs)
        assert (f"{lost} of {len(eor.n_pairs)} baselines or redundant groups are left out" in caplog.text) == (lost > 0)
        for name in ("n_pairs", "share_unit", "share_antenna", "share_pairs"):
            np.testing.assert_array_equal(getattr(common["eor"], name), getattr(common["residual"], name))
        clusters = clusters_in_k(common["eor"], np.array([0.0, 1.0, 3.0]), 0.0, inside=False)
        found, error = clusters.powers(common["residual"]).ratio(clusters.powers(common["eor"]))
        np.testing.assert_allclose(found, 1)
        np.testing.assert_allclose(error, 0, atol=1e-7)


def test_parts_of_a_group_that_flags_split_are_matched_with_the_whole(observe, white, beam):
    """Pairs of baselines with no channels in common are left out; those that are left are two units of one group."""
    settings = PowerSettings(pairs="redundant-group", wedge_buffer="0 ns")
    uvd = white(observe(HexLayout(kind="hex", side=3), n_channels=64), np.random.default_rng(5))
    eor = delay_spectra(estimate_power(uvd, uvd, beam, settings), settings)
    part = uvd.copy()
    part.flag_array[(antenna_pairs(part) <= 6).any(axis=1), 30:] = True
    part.flag_array[(antenna_pairs(part) >= 12).any(axis=1), :34] = True
    residual = delay_spectra(estimate_power(part, part, beam, settings), settings)
    assert len(residual.n_pairs) > len(eor.n_pairs)
    common = of_common_units({"eor": eor, "residual": residual})
    for name in ("n_pairs", "share_unit", "share_antenna", "share_pairs"):
        np.testing.assert_array_equal(getattr(common["eor"], name), getattr(common["residual"], name))
    assert len(common["eor"].n_pairs) > len(eor.n_pairs)


def test_tables_come_back(tmp_path):
    rng = np.random.default_rng(2)
    spectra = make_spectra(rng.normal(size=(6, 16)) + 0j, rng.normal(size=(6, 3)) * 20)
    spherical = binned.with_errors(spherical_average(spectra, SETTINGS, True), noise=2.0)
    wedge = cylindrical_average(spectra, SETTINGS)
    for name, spectrum in (("s.h5", spherical), ("w.h5", wedge)):
        save_spectrum(tmp_path / name, spectrum)
        back = load_spectrum(tmp_path / name, type(spectrum))
        for item in dataclasses.fields(spectrum):
            np.testing.assert_array_equal(getattr(back, item.name), getattr(spectrum, item.name))
        assert type(back) is type(spectrum)
    assert load_spectrum(tmp_path / "s.h5", type(spherical)).wedge_excluded is True
    with pytest.raises(ValueError, match="holds 'SphericalSpectrum', expected 'CylindricalSpectrum'"):
        load_spectrum(tmp_path / "s.h5", CylindricalSpectrum)
    write_csv(tmp_path / "s.csv", spherical)
    lines = (tmp_path / "s.csv").read_text().splitlines()
    assert lines[0].startswith("k [h/Mpc],power real [mK2 h-3 Mpc3]")
    assert len(lines) == spherical.k.size + 1
    row = np.array(lines[5].split(","), dtype=float)
    np.testing.assert_array_equal(row[:2], [spherical.k[4], spherical.power.real[4]])
