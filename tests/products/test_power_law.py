"""Power laws: the exponent, and how well it is known."""

from __future__ import annotations

import numpy as np
import pytest

from calstudy.products.run_times import fit_power_law


def test_the_scatter_of_exponents_is_what_the_fit_says():
    size = np.array([16.0, 24, 32, 48, 64, 96, 128])
    rng = np.random.default_rng(1)
    fits = [fit_power_law(size, 1e-4 * size**1.7 * np.exp(0.1 * rng.normal(size=size.size))) for _ in range(2000)]
    exponents = np.array([fit.exponent for fit in fits])
    assert exponents.mean() == pytest.approx(1.7, abs=4 * exponents.std() / 2000**0.5)
    assert exponents.std() == pytest.approx(np.sqrt(np.mean([fit.error**2 for fit in fits])), rel=0.06)
    assert np.median([fit.at(50.0) for fit in fits]) == pytest.approx(1e-4 * 50**1.7, rel=0.01)


@pytest.mark.parametrize(("size", "value"), [([1, 2], [1, 2]), ([1, 2, 2], [1, 2, 3]), ([1, 2, 3], [1, 0, 3])])
def test_what_no_power_law_can_be_fitted_to_is_refused(size, value):
    with pytest.raises(ValueError, match="three sizes or more"):
        fit_power_law(np.array(size), np.array(value))
