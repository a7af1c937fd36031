"""Exchanges between gains and foregrounds that no residual can see, drawn by hypothesis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from observations import small_instrument

from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.structure import make_structure
from calstudy.instrument.telescope import make_template
from calstudy.validation.degeneracies import EXCHANGES, best_misfit, narrow_model
from calstudy.validation.scene import Scene, rms
from calstudy.visibilities import from_cube


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Seven antennas, 96 channels, foregrounds of waves well within the narrow basis, which ends at 100 ns."""
    template = make_template(small_instrument(channels={"count": 96, "width": "320 kHz"}, times={"count": 1}))
    rng = np.random.default_rng(3)
    delays = np.linspace(-60e-9, 60e-9, 13)
    amplitudes = rng.standard_normal((2, template.Nbls, delays.size))
    waves = np.exp(2j * np.pi * np.outer(delays, template.freq_array))
    settings_of_fit = CalibrationSettings()
    data = from_cube(template, ((amplitudes[0] + 1j * amplitudes[1]) @ waves)[None, :, :, None])
    structure, numbers = make_structure(data, settings_of_fit)
    return Scene(data, structure, numbers, settings_of_fit, 1e-3)


@given(kind=st.sampled_from(sorted(EXCHANGES)), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_misfit_does_not_see_an_exchange(scene, kind, seed):
    rng = np.random.default_rng(seed)
    shape = (scene.structure.n_antennas, scene.structure.n_frequencies)
    gains = 1 + 0.1 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    model = narrow_model(scene)
    noise = scene.noise_std * (rng.standard_normal(model.shape) + 1j * rng.standard_normal(model.shape))
    visibilities = scene.products(gains) * model + noise
    before = best_misfit(scene, visibilities, gains)
    after = best_misfit(scene, visibilities, gains * EXCHANGES[kind](scene, rng))
    assert rms(after - before) < 1e-6 * rms(visibilities)
    # The noise is in both: it is no perfect fit that is compared.
    assert rms(before) > 0.1 * scene.noise_std


def test_an_exchange_that_is_none_is_seen(scene):
    rng = np.random.default_rng(5)
    gains = np.ones((scene.structure.n_antennas, scene.structure.n_frequencies), complex)
    visibilities = scene.products(gains) * narrow_model(scene)
    rough = 1 + 0.01 * rng.standard_normal(gains.shape)
    before, after = (best_misfit(scene, visibilities, gains * factor) for factor in (1, rough))
    assert rms(after - before) > 1e-3 * rms(visibilities)
