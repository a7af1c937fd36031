"""The synthetic population against the published counts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from calstudy.sky.counts import differential_counts, draw_population, expected_sources


def expected(faint, bright):
    """Sources on the whole sky, by adaptive quadrature."""
    return 4 * np.pi * quad(lambda x: differential_counts(np.exp(x)) * np.exp(x), np.log(faint), np.log(bright))[0]


@pytest.fixture(scope="module")
def population():
    return draw_population(0.1, 60.0, seed=1)


def test_counts_at_1_jy_are_the_published_ones():
    """At 154 MHz the polynomial at S = 1 Jy is its first coefficient; seen at 200 MHz that source has 0.811 Jy."""
    scale = (200 / 154) ** 0.8
    assert differential_counts(np.array([1 / scale]))[0] == pytest.approx(10**3.52 * scale)


def test_counts_predict_what_gleam_should_see():
    """3.29e5 sources above 50 mJy at 200 MHz over GLEAM's 24,831 deg²."""
    assert expected(0.05, 60) * 24831 / 41252.96 == pytest.approx(3.29e5, rel=0.01)


@pytest.mark.parametrize(
    ("faint", "bright"), [(0.1, 0.15), (0.15, 0.25), (0.25, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 60.0)]
)
def test_population_follows_the_counts(population, faint, bright):
    flux = population[2]
    found, mean = ((flux >= faint) & (flux < bright)).sum(), expected(faint, bright)
    assert abs(found - mean) < 4 * np.sqrt(mean)
    assert abs(found / mean - 1) < 0.05


def test_population_is_isotropic(population):
    """Means of the unit vector's components and of their products, within 4 standard errors."""
    right_ascension, declination, flux = population
    direction = np.array(
        [
            np.cos(declination) * np.cos(right_ascension),
            np.cos(declination) * np.sin(right_ascension),
            np.sin(declination),
        ]
    )
    assert np.abs(direction.mean(axis=1)).max() < 4 / np.sqrt(3 * len(flux))
    second = direction @ direction.T / len(flux)
    assert np.abs(second - np.eye(3) / 3).max() < 4 * np.sqrt(4 / 45 / len(flux))


def test_flux_limit_only_removes_sources(population):
    brighter = draw_population(0.37, 60.0, seed=1)
    chosen = population[2] >= 0.37
    for all_of, some in zip(population, brighter, strict=True):
        np.testing.assert_array_equal(np.sort(all_of[chosen]), np.sort(some))


def test_seed_decides(population):
    np.testing.assert_array_equal(population[2], draw_population(0.1, 60.0, seed=1)[2])
    assert len(population[2]) != len(draw_population(0.1, 60.0, seed=2)[2])


@pytest.mark.parametrize("faint", [0.1, 0.5, 3.0])
def test_the_expected_number_of_sources_is_that_of_the_drawn_ones(population, faint):
    """Plans estimate simulations by it. Five standard deviations of a Poisson number, 3 % at most."""
    drawn = int((population[2] >= faint).sum())
    assert drawn == pytest.approx(expected_sources(faint), abs=5 * np.sqrt(drawn))
