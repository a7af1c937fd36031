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
