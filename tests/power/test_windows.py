"""Window functions of what is left of a signal, and their inverse, against signals whose power is known."""

import numpy as np
import pytest

from calstudy.calibrate.expected_loss import DelayModes
from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
from calstudy.power.spectra import BaselineModes
from calstudy.power.windows import deconvolved, draw_in_bins, window_matrix

FREQUENCY = 167.075e6 + 160e3 * np.arange(96)
LENGTHS = np.linspace(10, 60, 40)
EDGES = np.arange(0, 0.65, 0.1)
BUFFER = 100e-9
COSMOLOGY = "Planck15"
GROUPS = np.arange(LENGTHS.size), np.zeros(LENGTHS.size, bool)


def draw(rng, lengths=LENGTHS, groups=GROUPS):
    return list(draw_in_bins(FREQUENCY, lengths, groups, EDGES, COSMOLOGY, rng))


@pytest.fixture(scope="module")
def modes():
    return DelayModes(FREQUENCY)


@pytest.fixture(scope="module")
def where(modes):
    cosmology, centre = make_cosmology(COSMOLOGY), FREQUENCY.mean()
    k_perp, k_par = (
        make(cosmology, of, centre) for make, of in ((k_perpendicular, LENGTHS), (k_parallel, modes.delay))
    )
    return BaselineModes(LENGTHS, k_perp, modes.delay, k_par)


def windows(modes, where, keep, draws=40):
    """W of a calibration that leaves `keep` of a signal, a function of (Nbls, Nfreqs)."""
    rng = np.random.default_rng(1)
    parts = [draw(rng) for _ in range(draws)]
    left = np.array([[modes.amplitudes(keep(one)) for one in found] for found in parts])
    put_in = np.sum(np.abs([modes.amplitudes(one) for found in parts for one in found]) ** 2, axis=0) / draws
    return window_matrix(where, (left, left), put_in, EDGES, BUFFER)


def delay_filter(modes, factor):
    """Multiply every mode of the DFT by a factor, which depends on its delay, (Ndelays,)."""
    grid = np.fft.ifftshift(factor)
    return lambda values: np.fft.fft(np.fft.ifft(values, axis=1) * grid, axis=1)


def test_signals_of_all_bins_are_white_with_a_mean_square_of_one():
    power = [np.abs(np.sum(draw(np.random.default_rng(seed)), axis=0)) ** 2 for seed in range(20)]
    # Of 20 draws of 40 baselines and 96 channels, and of each channel.
    assert np.mean(power) == pytest.approx(1, abs=4 / np.sqrt(20 * 40 * 96))
    assert np.mean(power, axis=(0, 1)) == pytest.approx(1, abs=4.5 / np.sqrt(20 * 40))


def test_without_loss_windows_add_up_to_one(modes, where):
    window = windows(modes, where, lambda signal: signal)
    # The first bin has no modes outside the wedge.
    assert np.isnan(window[0]).all()
    assert window[1:].sum(axis=1) == pytest.approx(1, rel=1e-6)
    # The taper mixes neighbours alone.
    far = np.abs(np.subtract.outer(np.arange(6), np.arange(6))) > 1
    assert window[1:][far[1:]].max() < 1e-3


def test_signals_have_power_in_their_bin_alone(modes, where):
    rng = np.random.default_rng(2)
    k = np.hypot(where.k_perp[:, None], where.k_parallel)
    for number, signal in enumerate(draw(rng)):
        power = np.abs(modes.amplitudes(signal)) ** 2
        # The taper's main lobe reaches three delays to either side.
        reach = 3 * np.diff(where.k_parallel).mean()
        away = (k < EDGES[number] - reach) | ((k > EDGES[number + 1] + reach) & (number < EDGES.size - 2))
        assert power[away].sum() < 1e-3 * power.sum()


def test_redundant_baselines_see_one_signal_and_reversed_ones_its_conjugate():
    groups, reversed_ones = np.repeat(np.arange(20), 2), np.tile([False, True], 20)
    lengths = np.repeat(LENGTHS[:20], 2)
    for signal in draw(np.random.default_rng(3), lengths, (groups, reversed_ones)):
        assert np.allclose(signal[1::2], signal[::2].conj())


def test_a_steep_spectrum_comes_back_where_a_flat_transfer_function_misses_it(modes, where):
    """A calibration that leaves next to nothing of small delays, and a spectrum that falls by a factor of 26."""
    squared = (where.k_parallel / 0.15) ** 2
    keep = delay_filter(modes, squared / (1 + squared))
    window = windows(modes, where, keep)
    # The first bin, without modes outside the wedge, is taken to have the power of the second.
    truth = (np.maximum(EDGES[1:] + EDGES[:-1], 0.3) / 2 / 0.3) ** -2.5
    white = np.full((LENGTHS.size, modes.delay.size), np.sum(modes.weights**2))
    rng, total, draws = np.random.default_rng(5), np.zeros(6), 60
    for _ in range(draws):
        parts = [np.sqrt(power) * one for power, one in zip(truth, draw(rng), strict=True)]
        left = modes.amplitudes(keep(np.sum(parts, axis=0)))[None, None]
        ones = np.repeat(left, 6, axis=1)
        total += window_matrix(where, (ones, ones), white, EDGES, BUFFER)[:, 0] / draws
    found, error = deconvolved(window, total, 0.01 * total)
    assert np.isnan(found[0])
    # Scatter of the draws, in the windows and in the signal.
    assert found[1:] == pytest.approx(truth[1:], rel=0.08)
    by_flat = total / window.sum(axis=1)
    assert np.abs(by_flat[1:] / truth[1:] - 1).max() > 0.16
    assert (error[1:] > 0.01 * found[1:]).all()


def test_errors_are_those_of_many_draws():
    window = np.array([[0.5, 0.2, 0.0], [0.1, 0.8, 0.1], [0.0, 0.05, 0.9]])
    truth, error = np.array([3.0, 2.0, 1.0]), np.array([0.1, 0.2, 0.05])
    rng = np.random.default_rng(7)
    drawn = [deconvolved(window, window @ truth + error * rng.standard_normal(3), error) for _ in range(2000)]
    found = np.array([power for power, _ in drawn])
    assert found.mean(axis=0) == pytest.approx(truth, abs=0.03)
    # The scatter of 2000 draws is known to 1.6 %.
    assert found.std(axis=0) == pytest.approx(drawn[0][1], rel=0.07)


def test_bins_of_which_nothing_is_left_have_no_result_and_the_power_of_their_neighbour():
    # Most of what is in the first one is the power of the second.
    window = np.array([[0.02, 0.2, 0.0], [0.2, 0.7, 0.1], [0.0, 0.1, 0.9]])
    truth = np.array([2.0, 2.0, 1.0])
    found, error = deconvolved(window, window @ truth, np.full(3, 0.1))
    assert np.isnan(found[0])
    assert np.isnan(error[0])
    assert found[1:] == pytest.approx(truth[1:])
