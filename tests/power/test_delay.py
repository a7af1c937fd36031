from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calstudy.power import delay as d


@given(
    n=st.integers(2, 40),
    taper=st.sampled_from(sorted(d.TAPERS)),
    first=st.floats(1e8, 2e8),
    seed=st.integers(0, 100),
)
def test_transform_is_the_sum_of_the_paper(n, taper, first, seed):
    rng = np.random.default_rng(seed)
    frequencies = first + 80e3 * np.arange(n)
    data = rng.normal(size=(3, n)) + 1j * rng.normal(size=(3, n))
    phases = np.exp(2j * np.pi * d.delays(n, 80e3)[:, None] * frequencies)
    expected = 80e3 * (data * d.make_taper(taper, n)) @ phases.T
    np.testing.assert_allclose(d.delay_transform(data, frequencies, taper), expected, rtol=0, atol=1e-6 * 80e3 * n)


def test_a_source_appears_at_its_delay():
    frequencies = 180e6 + 80e3 * np.arange(64)
    tau = d.delays(64, 80e3)[40]
    data = np.exp(-2j * np.pi * tau * frequencies) * np.ones((2, 1))
    transform = d.delay_transform(data, frequencies, "none")
    assert transform.shape == (2, 64)
    np.testing.assert_allclose(transform[:, 40], 64 * 80e3, rtol=1e-6)
    assert np.abs(np.delete(transform, 40, axis=1)).max() < 1e-5 * 64 * 80e3


@pytest.mark.parametrize("taper", sorted(d.TAPERS))
def test_tapers_are_those_of_hera_pspec(taper):
    from uvtools.dspec import gen_window

    from calstudy.power.estimate import HERA_TAPERS

    np.testing.assert_allclose(d.make_taper(taper, 48), gen_window(HERA_TAPERS[taper], 48), rtol=0, atol=1e-15)


@pytest.mark.parametrize("flagged", [slice(0), slice(14, 18), slice(10), slice(1, None, 2)])
@pytest.mark.parametrize("taper", sorted(d.TAPERS))
def test_mode_correlation_is_that_of_white_noise(taper, flagged):
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(40000, 32)) + 1j * rng.normal(size=(40000, 32))
    noise[:, flagged] = 0
    power = np.abs(d.delay_transform(noise, 180e6 + 80e3 * np.arange(32), taper)) ** 2
    measured = np.corrcoef(power.T)
    weights = np.ones((3, 32, 2))
    weights[:, flagged] = 0
    expected = d.mode_correlation(taper, 32, weights)
    for lag in range(8):
        circular = [measured[i, (i + lag) % 32] for i in range(32)]
        # Means of other draws scatter by up to 0.0025.
        assert np.mean(circular) == pytest.approx(expected[lag], abs=0.01)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"hamming.*allowed.*blackman-harris"):
        d.make_taper("hamming", 8)
    with pytest.raises(ValueError, match="8 channels, frequencies 9"):
        d.delay_transform(np.zeros(8), 180e6 + 80e3 * np.arange(9), "none")
    with pytest.raises(ValueError, match="equally spaced"):
        d.delay_transform(np.zeros(3), np.array([1.0, 2.0, 4.0]), "none")


@pytest.mark.parametrize("written", [np.round, np.float32])
def test_frequencies_that_a_file_has_rounded_are_equally_spaced(written):
    """As those of HERA, in whole Hz or in single precision."""
    frequencies = 140e6 + 122_070.3125 * np.arange(64)
    assert d.channel_width(written(frequencies)) == pytest.approx(122_070.3125, rel=1e-5)
