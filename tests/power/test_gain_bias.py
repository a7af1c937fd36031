"""The law of the bias by gain errors against draws of them: in one baseline, between baselines, and in time."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from observations import small_instrument

from calstudy.base.observation import Observation
from calstudy.corrupt.effects.gains import Bandpass
from calstudy.corrupt.interface import apply_effect, draw_truth
from calstudy.instrument.telescope import make_template
from calstudy.power.delay import delay_transform, delays
from calstudy.power.gain_bias import ErrorCovariance, added_power, bias_terms, exponential, tolerated_sigma
from calstudy.power.spectra import DelaySpectra

CHANNELS, WIDTH, ANTENNAS, TIMES, INTEGRATION = 64, 160e3, 8, 6, 8.0
PAIRS = np.array(list(itertools.combinations(range(ANTENNAS), 2)))
DRAWS = 60
"""Times 28 baselines, of which no two have independent errors: 8 antennas."""


@pytest.fixture(scope="module")
def observed() -> Observation:
    instrument = small_instrument(
        layout={"kind": "linear", "count": ANTENNAS},
        channels={"count": CHANNELS, "width": "160 kHz"},
        times={"count": TIMES, "integration": "8 s"},
    )
    return Observation(make_template(instrument))


def spectra(power: np.ndarray, n_pairs: int = 1) -> DelaySpectra:
    """Spectra of units that are alike but for their power, (Nu, Nd)."""
    return DelaySpectra(
        power=power.astype(complex),
        vectors=np.tile([30.0, 0, 0], (len(power), 1)),
        n_pairs=np.full(len(power), n_pairs),
        n_polarizations=1,
        delay=delays(CHANNELS, WIDTH),
        k_perp=np.full(len(power), 0.05),
        k_parallel=delays(CHANNELS, WIDTH) * 0.5e6,
        frequency=180e6,
        omega_pp=0.1,
        taper="blackman-harris",
    )


def transformed(visibilities: np.ndarray) -> np.ndarray:
    """Return delay spectra of (..., Nfreqs) visibilities, in units of a channel."""
    frequencies = 170e6 + WIDTH * np.arange(CHANNELS)
    return delay_transform(visibilities, frequencies, "blackman-harris") / WIDTH


def residuals(observed: Observation, draws: int = DRAWS, **settings: object) -> tuple[np.ndarray, np.ndarray]:
    """Return delay spectra of foregrounds, (Nd,), the same in all baselines and times, and of residuals of many draws.

    The residuals, (Ndraws, Nbls, Nd), are averaged over time.
    """
    frequencies = np.arange(CHANNELS) / CHANNELS
    sky = np.exp(2j * np.pi * 1.5 * frequencies) + 0.6 * np.exp(-2j * np.pi * 0.7 * frequencies)
    shape = (TIMES, len(observed.antennas), CHANNELS, 1)
    found = []
    for seed in range(draws):
        effect, before = Bandpass(seed=seed, **settings), np.broadcast_to(sky[:, None], shape).copy()
        after = apply_effect(effect, before.copy(), observed, draw_truth(effect, observed))
        found.append(transformed((after - before)[..., 0].mean(axis=0)))
    return transformed(sky), np.stack(found)


def crossed(found: np.ndarray) -> np.ndarray:
    """Return the mean power of pairs of baselines of neighbours, (Nd,), of residuals of many draws.

    Each of these baselines has its second antenna in common with the first of the next.
    """
    found = found[:, np.diff(PAIRS)[:, 0] == 1]
    baselines, total = found.shape[1], found.sum(axis=1)
    power = np.abs(total) ** 2 - np.sum(np.abs(found) ** 2, axis=1)
    return np.mean(power, axis=0) / (baselines * (baselines - 1))


def covariance(effect: Bandpass) -> ErrorCovariance:
    return ErrorCovariance(
        channels=effect.shape.correlation(WIDTH * np.arange(CHANNELS)),
        times=exponential(TIMES, INTEGRATION, effect.time),
        common=effect.common,
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"shape": {"kind": "correlated", "length": "0 MHz"}},
        {"shape": {"kind": "correlated", "length": "0.4 MHz"}, "common": 0.5},
        {"shape": {"kind": "correlated", "length": "1 MHz", "form": "exponential"}, "time": "10 s"},
        {"shape": {"kind": "correlated", "length": "0.8 MHz"}, "sigma": 0.4},
    ],
    ids=["white", "half in common", "exponential, in time", "second order"],
)
def test_a_baseline_has_the_expected_power_at_every_delay(observed, settings):
    effect = Bandpass(**({"sigma": 1e-3} | settings))
    foregrounds, found = residuals(observed, **{"sigma": effect.sigma, **settings})
    terms = added_power(spectra(np.abs(foregrounds[None]) ** 2), covariance(effect))[:, 0]
    expected = effect.sigma**2 * terms[0] + effect.sigma**4 * terms[1]
    measured = np.mean(np.abs(found) ** 2, axis=(0, 1))
    used = expected > 1e-6 * expected.max()
    # 60 draws of 8 antennas, or of one where half is in common: a tenth. The mean of the second order is in the wedge.
    used &= np.abs(delays(CHANNELS, WIDTH)) > 0.5e-6
    assert used.sum() > 10
    ratio = measured[used] / expected[used]
    assert ratio == pytest.approx(1, abs=0.5)
    assert np.mean(ratio) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
def test_baselines_of_a_group_keep_what_antennas_have_in_common(observed, common):
    effect = Bandpass(sigma=1e-3, shape={"kind": "correlated", "length": "0.3 MHz"}, common=common)
    foregrounds, found = residuals(observed, sigma=1e-3, shape=effect.shape.model_dump(mode="json"), common=common)
    alone = added_power(spectra(np.abs(foregrounds[None]) ** 2), covariance(effect))[0, 0]
    expected = added_power(spectra(np.abs(foregrounds[None]) ** 2, n_pairs=6), covariance(effect))[0, 0]
    assert expected == pytest.approx(common * alone)
    # 60 draws, and several independent delays.
    assert np.sum(crossed(found)) / (1e-6 * np.sum(alone)) == pytest.approx(common, abs=0.12)


def test_baselines_of_a_group_keep_the_square_of_the_common_part_in_the_second_order(observed):
    settings = {"sigma": 1.0, "shape": {"kind": "correlated", "length": "0 MHz"}, "common": 0.3}
    foregrounds, found = residuals(observed, draws=300, **settings)
    terms = added_power(spectra(np.abs(foregrounds[None]) ** 2, n_pairs=6), covariance(Bandpass(**settings)))[:, 0]
    # The mean of the second order is in the wedge.
    used = np.abs(delays(CHANNELS, WIDTH)) > 0.6e-6
    # The second order is v c = 0.3 of the first, and would be 1 with c for its square. 300 draws know the sum to 0.05.
    assert np.sum(crossed(found)[used]) / np.sum(terms[:, used]) == pytest.approx(1, abs=0.2)


def test_white_errors_spread_the_power_of_the_foregrounds_over_all_delays():
    power = np.zeros((1, CHANNELS))
    power[0, CHANNELS // 2 - 2 : CHANNELS // 2 + 3] = [1, 4, 9, 4, 1]
    white = ErrorCovariance(np.eye(CHANNELS)[0], np.ones((1, 1)))
    assert added_power(spectra(power), white)[0] == pytest.approx(4 * power.sum() / CHANNELS)
    constant = ErrorCovariance(np.ones(CHANNELS), np.ones((1, 1)))
    assert added_power(spectra(power), constant)[0] == pytest.approx(4 * power, abs=1e-12)


def test_a_coherent_average_keeps_the_part_that_lasts():
    assert np.mean(exponential(1000, 1.0, None)) == 1
    # Two correlation times over the duration, less their square: the integral of exp(-|t - t'| / tau).
    x = 10 / 1000
    assert np.mean(exponential(1000, 1.0, 10.0)) == pytest.approx(2 * x * (1 - x), rel=0.01)
    assert np.mean(exponential(50, 8.0, 1e-3)) == pytest.approx(1 / 50)


def test_the_tolerated_rms_has_the_bias_that_is_asked_for():
    power = np.where(np.abs(delays(CHANNELS, WIDTH)) < 0.2e-6, 1e8, 0.0)[None]
    signal = spectra(np.ones((1, CHANNELS)))
    errors = ErrorCovariance(np.exp(-((np.arange(CHANNELS) * 0.16 / 0.5) ** 2) / 2), np.ones((1, 1)))
    terms = bias_terms(spectra(power), signal, errors, (0.2, 0.5, 1.0), 100e-9)
    sigma = tolerated_sigma(terms, 0.1)
    assert sigma**2 * terms[0] + sigma**4 * terms[1] == pytest.approx(0.1)
    assert sigma[1] > sigma[0]
    assert tolerated_sigma(np.zeros((2, 1)), 0.1) == np.inf
