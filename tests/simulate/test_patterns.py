"""Our splines of a beam are pyuvdata's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline

from calstudy.instrument.beam_grid import bspline_coefficients
from calstudy.simulate.patterns import power_pattern

FREQUENCIES = np.array([171e6, 180.3e6, 195e6])


@pytest.fixture(scope="module")
def directions():
    rng = np.random.default_rng(2)
    azimuth = rng.uniform(0, 2 * np.pi, 400)
    zenith_angle = np.arccos(rng.uniform(0, 1, 400))
    # Across the wrap in azimuth, in the last ring of the grid, and at zenith.
    azimuth[:6] = 0.0, 1e-9, 2 * np.pi - 1e-9, np.deg2rad(0.5), np.deg2rad(359.5), np.deg2rad(359.99)
    zenith_angle[6:12] = np.pi / 2, np.pi / 2 - 1e-6, np.deg2rad(89.2), 0.0, 1e-9, np.deg2rad(0.3)
    return azimuth, zenith_angle


def test_tabulated_beam_equals_pyuvdata(embedded_beam, directions):
    azimuth, zenith_angle = directions
    tabulated = embedded_beam.at(FREQUENCIES)
    jones, _ = tabulated.interp(
        az_array=azimuth,
        za_array=zenith_angle,
        freq_array=FREQUENCIES,
        interpolation_function="az_za_simple",
        return_basis_vector=True,
    )
    expected = (np.abs(jones) ** 2).sum(axis=0)
    pattern = power_pattern(tabulated, FREQUENCIES, ["x", "y"])
    np.testing.assert_allclose(pattern.at(azimuth, zenith_angle), expected, rtol=0, atol=1e-13)
    only_y = power_pattern(tabulated, FREQUENCIES, ["y"])
    np.testing.assert_allclose(only_y.at(azimuth, zenith_angle), expected[1:], rtol=0, atol=1e-13)


def test_a_table_may_start_at_any_azimuth(embedded_beam, directions):
    tabulated = embedded_beam.at(FREQUENCIES)
    expected = power_pattern(tabulated, FREQUENCIES, ["x"]).at(*directions)
    shifted = tabulated.copy()
    shifted.axis1_array = tabulated.axis1_array - np.pi
    shifted.data_array = np.roll(tabulated.data_array, 180, axis=-1)
    found = power_pattern(shifted, FREQUENCIES, ["x"]).at(*directions)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_analytic_beam_is_evaluated_at_every_direction_and_frequency(tile_beam, directions):
    azimuth, zenith_angle = directions
    pattern = power_pattern(tile_beam.at(FREQUENCIES), FREQUENCIES, ["y"]).at(azimuth, zenith_angle)
    jones = tile_beam.at(FREQUENCIES).efield_eval(az_array=azimuth, za_array=zenith_angle, freq_array=FREQUENCIES[1:2])
    np.testing.assert_allclose(pattern[0, 1], (np.abs(jones[:, 1, 0]) ** 2).sum(axis=0), rtol=1e-13)


@given(st.lists(st.floats(-10, 10), min_size=5, max_size=40))
def test_uniform_bspline_coefficients_are_the_not_a_knot_spline(values):
    coefficients = bspline_coefficients(len(values)) @ values
    spline = make_interp_spline(np.arange(len(values)), values)
    middles = np.arange(len(values) - 1) + 0.5
    weights = np.array([1, 23, 23, 1]) / 48
    ours = [weights @ coefficients[cell : cell + 4] for cell in range(len(values) - 1)]
    np.testing.assert_allclose(ours, spline(middles), atol=1e-11)


def test_beams_that_cannot_be_used_say_why(embedded_beam):
    tabulated = embedded_beam.at(FREQUENCIES)
    with pytest.raises(ValueError, match="not tabulated at the frequencies"):
        power_pattern(tabulated, FREQUENCIES + 1e5, ["x"])
    with pytest.raises(ValueError, match="has no feed r"):
        power_pattern(tabulated, FREQUENCIES, ["r"])
    physical = tabulated.copy()
    physical.data_normalization = "physical"
    with pytest.raises(ValueError, match="peak is needed"):
        power_pattern(physical, FREQUENCIES, ["x"])
