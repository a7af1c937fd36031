"""The smooth bandpass has the variance, the correlation and the smoothness that are asked for."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument

from calstudy.base.observation import Observation
from calstudy.corrupt.effects.gains import Bandpass
from calstudy.corrupt.interface import draw_truth
from calstudy.instrument.telescope import make_template


@pytest.fixture(scope="module")
def observed() -> Observation:
    """Sixty antennas and 64 channels of 480 kHz, two polarizations, without data."""
    instrument = small_instrument(
        layout={"kind": "linear", "count": 60},
        channels={"count": 64, "width": "480 kHz"},
        times={"count": 1},
        polarizations=["xx", "yy"],
    )
    return Observation(make_template(instrument))


def deviations(observed: Observation, seeds: range, **settings: object) -> np.ndarray:
    """Return (g - 1) / sigma of many draws, (Ndraws, Nfreqs), with sigma of 0.2."""
    drawn = [draw_truth(Bandpass(sigma=0.2, seed=seed, **settings), observed)["gains"][:, :, 0] - 1 for seed in seeds]
    return np.concatenate(drawn).transpose(0, 2, 1).reshape(-1, observed.n_channels) / 0.2


def test_a_polynomial_has_its_order_and_its_rms(observed):
    found = deviations(observed, range(10), shape={"kind": "polynomial", "order": 4})
    place = np.linspace(-1, 1, observed.n_channels)
    fitted = np.polynomial.polynomial.polyfit(place, found.T, 4)
    assert np.polynomial.polynomial.polyval(place, fitted) == pytest.approx(found, abs=1e-10)
    lower = np.polynomial.polynomial.polyval(place, np.polynomial.polynomial.polyfit(place, found.T, 3))
    # 1200 draws of five coefficients; one of five is missing from the lower fit.
    assert np.mean(abs(found - lower) ** 2) == pytest.approx(2 / 5, rel=0.15)
    assert np.mean(found.real**2) == pytest.approx(1, rel=0.1)
    assert np.mean(found.imag**2) == pytest.approx(1, rel=0.1)
    assert abs(np.mean(found)) < 0.1


def test_delays_have_a_flat_spectrum_up_to_their_largest(observed):
    found = deviations(observed, range(20), shape={"kind": "delays", "max_delay": "200 ns"})
    separations = np.array([0, 1, 3, 5, 10, 20])
    covariance = [np.mean(found[:, : 64 - lag].conj() * found[:, lag:]) / 2 for lag in separations]
    # 2400 draws, each of about 2 x 200 ns x 30 MHz = 13 independent values.
    assert covariance == pytest.approx(np.sinc(2 * 200e-9 * 480e3 * separations), abs=0.03)
    taper = np.blackman(64)
    power = np.mean(abs(np.fft.fft(found * taper)) ** 2, axis=0)
    delay = abs(np.fft.fftfreq(64, 480e3))
    # The main lobe of the taper is 3 / 30.72 MHz = 98 ns wide to either side.
    assert power[delay > 320e-9].max() < 1e-4 * power[delay < 100e-9].min()


def test_antennas_and_polarizations_differ_and_seeds_reproduce(observed):
    gains = draw_truth(Bandpass(), observed)["gains"]
    assert gains.shape == (60, 64, 1, 2)
    assert np.array_equal(gains, draw_truth(Bandpass(), observed)["gains"])
    assert abs(gains[0] - gains[1]).min() > 0
    assert abs(gains[..., 0] - gains[..., 1]).min() > 0
    flat = draw_truth(Bandpass(shape={"kind": "polynomial", "order": 0}), observed)["gains"]
    assert flat == pytest.approx(np.broadcast_to(flat[:, :1], flat.shape), abs=1e-15)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ({"form": "gaussian", "length": "2 MHz"}, lambda nu: np.exp(-((nu / 2e6) ** 2) / 2)),
        ({"form": "exponential", "length": "2 MHz"}, lambda nu: np.exp(-nu / 2e6)),
        ({"length": "0 MHz"}, lambda nu: 1.0 * (nu == 0)),
    ],
)
def test_correlated_gains_have_their_correlation(observed, shape, expected):
    found = deviations(observed, range(20), shape={"kind": "correlated", **shape})
    separations = np.array([0, 1, 3, 5, 10, 20])
    covariance = [np.mean(found[:, : 64 - lag].conj() * found[:, lag:]) / 2 for lag in separations]
    # 2400 draws, each of six or more independent values.
    assert covariance == pytest.approx(expected(480e3 * separations), abs=0.03)


def test_gains_keep_their_correlation_time():
    instrument = small_instrument(
        layout={"kind": "linear", "count": 60},
        channels={"count": 30, "width": "480 kHz"},
        times={"count": 12, "integration": "8 s"},
    )
    white, settings = {"kind": "correlated", "length": "0 MHz"}, {"sigma": 0.1, "seed": 3}
    effect = Bandpass(shape=white, time="20 s", **settings)
    found = (draw_truth(effect, Observation(make_template(instrument)))["gains"][..., 0] - 1) / 0.1
    assert found.shape == (60, 30, 12)
    # 1800 processes.
    assert np.mean(np.abs(found) ** 2, axis=(0, 1)) == pytest.approx(2, rel=0.1)
    for lag in (1, 3, 6):
        kept = np.mean(found[..., lag:] * found[..., :-lag].conj()).real / 2
        assert kept == pytest.approx(np.exp(-8 * lag / 20), abs=0.03)
    assert effect.varies
    assert not Bandpass().varies


@pytest.mark.parametrize("common", [0.0, 0.3, 1.0])
def test_antennas_share_a_part_of_the_variance(observed, common):
    shape = {"kind": "correlated", "length": "0 MHz"}
    found = draw_truth(Bandpass(sigma=0.1, shape=shape, common=common), observed)["gains"][:, :, 0] / 0.1 - 10
    assert np.mean(np.abs(found) ** 2) == pytest.approx(2, rel=0.15)
    mean = found.mean(axis=0)
    # 64 channels of two polarizations; 60 antennas leave 1/60 of what they do not share.
    assert np.mean(np.abs(mean) ** 2) / 2 == pytest.approx(common + (1 - common) / 60, abs=0.04 + 0.2 * common)


def test_gains_that_share_nothing_are_those_of_before():
    """The fields for time and common parts leave the draws of all others as they were."""
    instrument = small_instrument(layout={"kind": "linear", "count": 3}, channels={"count": 8}, times={"count": 1})
    observed = Observation(make_template(instrument))
    effect = Bandpass(sigma=0.1, seed=4)
    real, imaginary = (
        np.random.default_rng(4).standard_normal((2, 3, observed.n_polarizations, 4))
        @ effect.shape.components(observed.frequencies).T
    )
    expected = np.moveaxis(1 + 0.1 * (real + 1j * imaginary), 2, 1)[:, :, None]
    assert draw_truth(effect, observed)["gains"] == pytest.approx(expected, abs=1e-14)
