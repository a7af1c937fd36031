"""Fractions of deviations from the true gains, and what of a deviation is no error."""

from __future__ import annotations

import numpy as np
import pytest
from toy import FREQUENCIES, complex_normal, make_toy, scattered

from calstudy.calibrate.agreement import EXPECTED, GainCoverage, pulls
from calstudy.calibrate.gain_errors import gain_errors

TOY = make_toy(scattered(5), noise=0.1)


def errors_of(**changes):
    return gain_errors(TOY.problem(**changes), TOY.gains, TOY.foregrounds, FREQUENCIES)


def test_normal_deviations_have_the_expected_fractions():
    found = GainCoverage.of(list(np.random.default_rng(1).standard_normal((3, 2, 10, 500))))
    assert found.observed.shape == (3, 2, EXPECTED.size)
    assert found.observed == pytest.approx(np.broadcast_to(EXPECTED, found.observed.shape), abs=0.03)
    assert found.within.shape == (3, 2, 10, 2)
    assert found.within.mean(axis=(0, 1, 2)) == pytest.approx([0.6827, 0.95], abs=0.01)


def test_antennas_without_errors_do_not_count():
    drawn = np.random.default_rng(1).standard_normal((2, 10, 500))
    drawn[:, 3] = np.nan
    found = GainCoverage.of([drawn])
    assert np.isnan(found.within[0, :, 3]).all()
    assert found.observed[0] == pytest.approx(np.broadcast_to(EXPECTED, (2, EXPECTED.size)), abs=0.03)


def test_what_no_data_determine_is_no_deviation():
    errors, rng = errors_of(), np.random.default_rng(2)
    phases = np.exp(1j * rng.uniform(-3, 3, FREQUENCIES.size))
    assert pulls(errors, 1.3 * phases * TOY.gains, TOY.gains) == pytest.approx(0, abs=1e-6)
    changed = TOY.gains * np.exp(0.01 * complex_normal(rng, TOY.gains.shape))
    expected = pulls(errors, changed, TOY.gains)
    assert pulls(errors, phases * changed, TOY.gains) == pytest.approx(expected, abs=1e-6)
    assert np.std(expected) > 0.05


def test_a_known_sky_determines_the_scale():
    errors = errors_of(sky_model=TOY.foregrounds, frozen=True)
    assert np.median(pulls(errors, 1.3 * TOY.gains, TOY.gains)[0]) > 1


def test_flagged_gains_have_no_deviation():
    weights = TOY.problem().weights.copy()
    weights[:, 7] = 0
    gains = np.where(np.arange(FREQUENCIES.size) == 7, 1, TOY.gains)
    found = pulls(errors_of(weights=weights), gains, TOY.gains)
    assert np.isnan(found[..., 7]).all()
    assert np.isfinite(np.delete(found, 7, axis=-1)).all()
