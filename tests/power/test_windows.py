"""The unbiased spectrum against a toy calibration whose loss is known, for Gaussian signals of any slope."""

from __future__ import annotations

import numpy as np
import pytest

from calstudy.calibrate.expected_loss import DelayModes
from calstudy.power.spectra import BaselineModes, SphericalSpectrum, outside_wedge
from calstudy.power.windows import (
    LARGEST_DIFFERENCE,
    LEAST_KEPT,
    Responses,
    bins_of,
    follows,
    parts_in_k,
    power_in_bins,
    unbiased,
    windows,
)

CHANNELS, WIDTH, BUFFER = 96, 320e3, 0.0
FREQUENCY = 170e6 + WIDTH * np.arange(CHANNELS)
DELAYS = DelayModes(FREQUENCY)
# So short that all delays but zero are outside the wedge, at k above 0.08 h/Mpc.
LENGTHS = np.linspace(1, 2, 24)
MODES = BaselineModes(LENGTHS, 0.08 + 1e-3 * LENGTHS, DELAYS.delay, 0.52e6 * DELAYS.delay)
EDGES = np.arange(0.08, 0.65, 0.04)
N_BINS = EDGES.size - 1
K = np.hypot(MODES.k_perp[:, None], MODES.k_parallel)
BINS = bins_of(MODES, EDGES)
USED = outside_wedge(MODES, BUFFER) & (BINS >= 0) & (BINS < N_BINS)
TOGETHER = 4
"""Baselines of which one gain in each channel absorbs what they share."""
PHASES = np.exp(2j * np.pi * np.random.default_rng(5).uniform(size=(LENGTHS.size, CHANNELS)))


def draw(slope: float, draws: int, seed: int) -> np.ndarray:
    """Return Gaussian visibilities with P(k) of k^slope, (draws, Nbls, Nfreqs), which are not periodic in the band."""
    longer = 4 * CHANNELS
    delay = np.fft.fftfreq(longer, WIDTH)
    k = np.hypot(MODES.k_perp[:, None], 0.52e6 * delay)
    real, imaginary = np.random.default_rng(seed).standard_normal((2, draws, LENGTHS.size, longer))
    return np.fft.fft((real + 1j * imaginary) * k ** (slope / 2), axis=-1)[..., :CHANNELS]


def left_of(signal: np.ndarray) -> np.ndarray:
    """Return what a toy calibration leaves: gains take a quarter, and throw power from each delay to all others."""
    groups = (signal * PHASES.conj()).reshape(*signal.shape[:-2], -1, TOGETHER, CHANNELS)
    absorbed = np.broadcast_to(groups.mean(axis=-2, keepdims=True), groups.shape)
    return signal - PHASES * absorbed.reshape(signal.shape)


def power(signals: np.ndarray) -> np.ndarray:
    """Return the power of signals in the bins outside the wedge, (..., Nk)."""
    amplitudes = DELAYS.amplitudes(signals)[..., USED]
    return power_in_bins(amplitudes[None], amplitudes[None], BINS[USED], N_BINS).T


@pytest.fixture(scope="module")
def found():
    """The windows from one white signal of 40 draws, in place of the modes of a larger array."""
    centres = (EDGES[1:] + EDGES[:-1]) / 2
    put_in, left, level = [], [], []
    for signal in draw(0, 40, seed=1):
        parts = np.stack([*parts_in_k(signal, K, centres), signal])
        put_in.append(power(parts).T)
        left.append(power(left_of(parts)).T)
        level.append(np.full(N_BINS, np.mean(np.abs(DELAYS.amplitudes(signal)) ** 2)))
    responses = Responses(*(np.mean(arrays, axis=0) for arrays in (put_in, left, level)))
    return windows(EDGES, responses, responses.left[:, -1] / responses.put_in[:, -1])


def test_parts_have_the_power_of_the_signal():
    signal = draw(0, 1, seed=2)[0]
    parts = np.stack(list(parts_in_k(signal, K, (EDGES[1:] + EDGES[:-1]) / 2)))
    modes = np.abs(np.fft.ifft(parts, axis=-1)) ** 2
    np.testing.assert_allclose(modes.sum(axis=0), np.abs(np.fft.ifft(signal, axis=-1)) ** 2, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("slope", [0.0, -1.0, -2.5])
def test_estimate_is_unbiased_for_any_slope(found, slope):
    signals = draw(slope, 400, seed=3)
    truth, residual = power(signals), power(left_of(signals))
    kept = found.estimated
    estimate = residual @ found.undo.T
    error = (estimate - truth).std(axis=0) / np.sqrt(len(truth)) / truth.mean(axis=0)
    # The windows are from 40 draws of a flat P(k), and a power law is a straight line between the nodes to 2 %.
    allowed = 4 * error + 1 / np.sqrt(40 * np.bincount(BINS[USED])) + (0.02 if slope else 0)
    assert kept.all()
    np.testing.assert_array_less(np.abs(estimate.mean(axis=0) / truth.mean(axis=0) - 1), allowed)
    if slope:
        # Power from the lowest k is taken for that of the highest if T of a flat P(k) is divided by.
        divided = (residual / found.transfer).mean(axis=0) / truth.mean(axis=0)
        assert divided[-1] > 1 + 3 * allowed[-1]


def test_windows_are_parts_of_the_power(found):
    kept = found.estimated
    np.testing.assert_allclose(found.before[kept].sum(axis=1), 1)
    np.testing.assert_allclose(found.after[kept].sum(axis=1), 1)
    # Gains that four baselines share take a quarter of a flat P(k); 40 draws of some 100 modes tell it to 2 %.
    np.testing.assert_allclose(found.transfer, 1 - 1 / TOGETHER, rtol=0.06)


def test_bins_with_little_left_or_without_a_linear_response_are_not_estimated():
    n_bins = 4
    edges = np.linspace(0, 0.4, n_bins + 1)
    put_in = np.hstack([np.eye(n_bins), np.ones((n_bins, 1))])
    kept = np.array([0.9 * LEAST_KEPT, 1.1 * LEAST_KEPT, 0.8, 0.9])
    left = np.hstack([np.diag(kept), kept[:, None]])
    measured = kept * np.array([1, 1, 1 + 2 * LARGEST_DIFFERENCE, 1])
    found = windows(edges, Responses(put_in, left, np.ones(n_bins)), measured)
    assert found.estimated.tolist() == [False, True, False, True]
    # Without leaks between bins U divides by T.
    np.testing.assert_allclose(np.diag(found.undo)[found.estimated], 1 / kept[found.estimated])
    assert not follows(np.array([0.5]), np.array([np.nan]))


def test_the_error_has_the_noise_after_the_fit_and_that_of_the_transfer(found):
    n_bins = N_BINS
    zeros, ones = np.zeros(n_bins), np.ones(n_bins)
    spectrum = SphericalSpectrum(
        found.k, EDGES, 5 * ones + 0j, 100 * ones, 100 * ones, 100 * ones, 100 * ones, 0.2 * ones, zeros, True
    )
    kept = found.estimated
    estimate = unbiased(found, spectrum, spectrum, zeros, scale=1.0)
    np.testing.assert_allclose(estimate.error[kept], 0.2 / np.sqrt(found.transfer[kept]))
    with_transfer = unbiased(found, spectrum, spectrum, 0.1 * ones, scale=1.0)
    np.testing.assert_allclose(with_transfer.error[kept], np.hypot(estimate.error, 0.1 * estimate.power)[kept])
    # Gains that are too large by half make the calibrated power too small.
    np.testing.assert_allclose(
        unbiased(found, spectrum, spectrum, zeros, scale=1.5).power[kept], 2.25 * estimate.power[kept]
    )
    assert np.isnan(estimate.power[~kept]).all()
