"""T and C of two linear responses, crossed as those of two realizations of the noise."""

from __future__ import annotations

import numpy as np

from calstudy.power.spectra import BaselineModes
from calstudy.power.transfer import bin_response


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
