"""Averages of expected T, and T and C of two linear responses, crossed as those of two realizations of the noise."""

from __future__ import annotations

import numpy as np

from calstudy.power.spectra import BaselineModes
from calstudy.power.transfer import bin_expected, bin_response


def test_what_depends_on_the_noise_lowers_neither_the_retained_part_nor_adds_to_it():
    lengths, delay = np.linspace(10, 20, 300), np.linspace(-2e-6, 2e-6, 61)
    modes = BaselineModes(lengths, 1e-3 * lengths, delay, 0.5e6 * delay)
    generator = np.random.default_rng(1)
    draws = generator.standard_normal((3, lengths.size, delay.size, 2)).view(complex)[..., 0]
    signal, first, second = draws
    kept, noise = 0.6, 0.5
    responses = kept * signal + noise * first, kept * signal + noise * second
    transfer, cross = bin_response(modes, signal, responses, [0.3, 0.9], buffer=100e-9)
    # Some 14,000 modes: the scatter of a product of independent amplitudes is below 1 % of P^S.
    np.testing.assert_allclose(transfer, kept**2, atol=0.02)
    np.testing.assert_allclose(cross, kept, atol=0.02)
    # One realization alone has the noise's part as well.
    alone, _ = bin_response(modes, signal, (responses[0], responses[0]), [0.3, 0.9], buffer=100e-9)
    np.testing.assert_allclose(alone, kept**2 + noise**2, atol=0.02)


def test_the_error_of_a_mean_of_expected_t_is_the_scatter_of_means():
    """Independent errors of modes, half of them twice as large, and some that are not known."""
    lengths, delay = np.linspace(10, 20, 12), np.linspace(-2e-6, 2e-6, 61)
    modes = BaselineModes(lengths, 1e-3 * lengths, delay, 0.5e6 * delay)
    error = np.where(np.arange(lengths.size) < 6, 0.1, 0.2)[:, None] * np.ones(delay.size)
    generator, found = np.random.default_rng(2), []
    for _ in range(2000):
        transfer = 0.7 + error * generator.standard_normal(error.shape)
        transfer[3, ::2] = np.nan
        found.append(bin_expected(modes, transfer, error, [0.3, 0.5, 0.9], buffer=100e-9, length_bin=2.0))
    # 2000 draws give a standard deviation to 1.6 %; the limit is four times that.
    np.testing.assert_allclose(np.std([one.outside for one in found], axis=0), found[0].outside_error, rtol=0.065)
