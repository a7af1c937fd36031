"""Errors of what is left without EoR: of noise by Monte Carlo, and of power in a few bins."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from calstudy.claims.bins import pull_without_eor, rms_without_eor

BINS, EOR, SCALE = 84, 10.0, 1.1
USED = np.ones(BINS, bool)


def run_of(power: np.ndarray, noise: np.ndarray, error: np.ndarray) -> SimpleNamespace:
    """A run with P^R0 and its errors by noise and by leaving out antennas, in bins with the same power of the EoR."""
    edges = np.arange(BINS + 1.0)
    residual = SimpleNamespace(power=power.astype(complex), noise_error=noise, bin_edges=edges)
    eor = SimpleNamespace(power=np.full(BINS, EOR, complex))
    score = SimpleNamespace(bias_error=error * SCALE**2 / EOR, flux_scale=SCALE, bin_edges=edges)
    spectra = {"eor": eor, "residual_without_eor": residual}
    return SimpleNamespace(spherical=lambda variant, modes: spectra[variant], score=score)


@pytest.mark.parametrize("left", [0.0, 1.0, 30.0])
def test_the_error_of_an_rms_is_its_scatter(left):
    """Noise that falls with k, alone and on power that is left in all bins."""
    rng, noise, found = np.random.default_rng(3), np.linspace(2, 1, BINS), []
    for _ in range(400):
        power = left + noise * rng.standard_normal(BINS)
        found.append(rms_without_eor(run_of(power, noise, noise), USED)[:2])
    values, errors = np.transpose(found)
    # 400 draws tell a scatter to 3.5 %.
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(values.std(), rel=0.12)


def test_power_in_two_bins_is_known_as_well_as_these():
    """Not as well as that of so many bins which are alike: leaving out antennas tells that it is known to a third."""
    power, noise = np.full(BINS, 0.1), np.full(BINS, 0.1)
    power[:2] = 100, 80
    found = rms_without_eor(run_of(power, noise, np.hypot(power / 3, noise)), USED)
    assert found.value == pytest.approx(np.hypot(100, 80) / np.sqrt(BINS), rel=1e-3)
    assert found.uncertainty / found.value == pytest.approx(1 / 3, rel=1e-2)
    assert found.uncertainty / found.value > 4 / np.sqrt(2 * BINS)


def test_units_are_those_of_the_noise():
    noise = np.linspace(2, 1, BINS)
    run = run_of(10 * noise, noise, np.hypot(noise, 5 * noise))
    in_noise, pulls = rms_without_eor(run, USED, noise), pull_without_eor(run, USED)
    assert (in_noise.value, pulls.value) == pytest.approx((10, 10))
    assert (in_noise.uncertainty, pulls.uncertainty) == pytest.approx((np.hypot(5, BINS**-0.5),) * 2, rel=1e-2)
