"""Exchanges between gains and foregrounds that no residual can see, drawn by hypothesis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from observations import small_instrument

from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.problem import make_structure
from calstudy.corrupt.levels import rms
from calstudy.instrument.telescope import make_template
from calstudy.validation.steps.single_fit import EXCHANGES, SingleIntegration, best_misfit, narrow_model


@pytest.fixture(scope="module")
def integration() -> SingleIntegration:
    """Seven antennas, 96 channels, foregrounds of waves well within the narrow basis, which ends at 100 ns."""
    template = make_template(small_instrument(channels={"count": 96, "width": "320 kHz"}, times={"count": 1}))
    rng = np.random.default_rng(3)
    delays = np.linspace(-60e-9, 60e-9, 13)
    amplitudes = rng.standard_normal((2, template.Nbls, delays.size))
    waves = np.exp(2j * np.pi * np.outer(delays, template.freq_array))
    settings_of_fit = Calamity()
    data = from_cube(template, ((amplitudes[0] + 1j * amplitudes[1]) @ waves)[None, :, :, None])
    frame = Observation(data)
    structure, gains = make_structure(frame, settings_of_fit), np.ones((len(frame.numbers), 96), complex)
    return SingleIntegration(data, structure, frame.numbers, settings_of_fit, 1e-3, gains)


@given(kind=st.sampled_from(sorted(EXCHANGES)), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_misfit_does_not_see_an_exchange(integration, kind, seed):
    rng = np.random.default_rng(seed)
    shape = (integration.structure.n_antennas, integration.structure.n_frequencies)
    gains = 1 + 0.1 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    model = narrow_model(integration)
    noise = integration.noise_std * (rng.standard_normal(model.shape) + 1j * rng.standard_normal(model.shape))
    visibilities = integration.products(gains) * model + noise
    before = best_misfit(integration, visibilities, gains)
    after = best_misfit(integration, visibilities, gains * EXCHANGES[kind](integration, rng))
    assert rms(after - before) < 1e-6 * rms(visibilities)
    # The noise is in both: it is no perfect fit that is compared.
    assert rms(before) > 0.1 * integration.noise_std


def test_an_exchange_that_is_none_is_seen(integration):
    rng = np.random.default_rng(5)
    gains = np.ones((integration.structure.n_antennas, integration.structure.n_frequencies), complex)
    visibilities = integration.products(gains) * narrow_model(integration)
    rough = 1 + 0.01 * rng.standard_normal(gains.shape)
    before, after = (best_misfit(integration, visibilities, gains * factor) for factor in (1, rough))
    assert rms(after - before) > 1e-3 * rms(visibilities)
