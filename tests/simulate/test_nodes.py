"""Chebyshev nodes interpolate what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_cases import observe

from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.simulate.nodes import (
    chebyshev_count,
    chebyshev_nodes,
    frequency_bandwidth,
    integration_times,
    interpolation_matrix,
    node_counts,
    node_grid,
    time_bandwidth,
)
from calstudy.simulate.settings import Nodes


@given(bandwidth=st.floats(0, 250), exponent=st.floats(-12, -3))
def test_the_fastest_phasor_is_interpolated_to_the_tolerance_and_few_nodes_fewer_would_not_do(bandwidth, exponent):
    tolerance = 10**exponent
    x = np.linspace(-1, 1, 401)

    def error(count):
        nodes = chebyshev_nodes(-1, 1, count)
        return np.abs(
            interpolation_matrix(nodes, x) @ np.exp(1j * bandwidth * nodes) - np.exp(1j * bandwidth * x)
        ).max()

    count = chebyshev_count(bandwidth, tolerance)
    assert error(count) < tolerance + 1e-14 * max(1, bandwidth)
    if count > 6:
        assert error(count - 5) > 0.1 * tolerance


@given(st.integers(1, 30), st.floats(1, 1e9), st.floats(-1e9, 1e9))
def test_polynomials_are_exact_and_nodes_map_to_themselves(count, span, first):
    nodes = chebyshev_nodes(first, first + span, count)
    samples = np.concatenate([np.linspace(first, first + span, 17), nodes])
    matrix = interpolation_matrix(nodes, samples)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_array_equal(matrix[17:], np.eye(count))
    # Scaled with the nodes as they are, for they are rounded where the span is small.
    powers = ((samples - first) / span) ** (count - 1)
    np.testing.assert_allclose(matrix @ powers[17:], powers, atol=1e-11)


def test_julian_dates_are_interpolated_below_their_own_rounding():
    """A Julian date is rounded to 40 us, in which a fringe turns by 2e-6: weights must be those of rounded nodes."""
    start = 2457708.3
    samples = start + np.arange(56) * 2 / 86400
    nodes = chebyshev_nodes(samples[0], samples[-1], 16)
    phase = 2 * np.pi * 0.0085 * 86400

    def fringe(times):
        return np.exp(1j * phase * (times - start))

    error = np.abs(interpolation_matrix(nodes, samples) @ fringe(nodes) - fringe(samples)).max()
    assert error < 1e-10
    assert np.abs(fringe(samples + 4e-10) - fringe(samples)).max() > 1e-6


def test_counts_of_the_paper_follow_from_its_baselines():
    template = observe(count=36, channels=384, width="80 kHz", times=56, integration="2 s", polarizations=("xx",))
    grid = node_grid(template, Nodes(), smooth_in_frequency=True)
    assert (len(grid.times_jd), len(grid.frequencies)) == (16, 94)
    # 176 m and 20 m of beam: half the turns of the horizon delay over 30.64 MHz.
    assert frequency_bandwidth(template, 20.0) == pytest.approx(np.pi * 196.15 / 299792458 * 30.64e6, rel=1e-4)
    assert time_bandwidth(template, 20.0) < np.pi * 197.6e6 / 299792458 * 197 * 7.29e-5 * 110
    assert not grid.at_integrations
    assert not grid.at_channels


def test_east_west_baselines_turn_faster_than_polar_ones():
    template = observe(count=8)
    vectors = template.telescope.get_enu_antpos()
    latitude = template.telescope.location.geodetic.lat.rad
    pole = np.array([0, np.cos(latitude), np.sin(latitude)])
    assert time_bandwidth(template, 0.0) > 0
    along = template.copy()
    # The same array laid out along the Earth's axis does not turn at all.
    distances = np.linspace(0, np.ptp(vectors[:, 0]), len(vectors))
    from pyuvdata import utils

    centre = np.array([axis.to_value("m") for axis in template.telescope.location.geocentric])
    ecef = utils.ECEF_from_ENU(distances[:, None] * pole, center_loc=template.telescope.location)
    along.telescope.antenna_positions = ecef - centre
    assert time_bandwidth(along, 0.0) < 1e-6 * time_bandwidth(template, 0.0)


@pytest.mark.parametrize("settings", [Nodes(enabled=False), Nodes(beam_extent="100 km")])
def test_without_nodes_every_sample_is_simulated(settings):
    template = observe(channels=12, times=5, integration="2 s")
    grid = node_grid(template, settings, smooth_in_frequency=True)
    assert grid.at_integrations
    assert grid.at_channels
    np.testing.assert_array_equal(grid.times_jd, integration_times(template))
    np.testing.assert_array_equal(grid.frequencies, template.freq_array)
    cube = np.random.default_rng(0).normal(size=(5, template.Nbls, 12, 2))
    np.testing.assert_array_equal(grid.interpolate(cube), cube)


def test_a_sky_that_is_not_smooth_has_every_channel_as_a_node():
    template = observe(channels=64, width="80 kHz", times=40, integration="2 s")
    grid = node_grid(template, Nodes(), smooth_in_frequency=False)
    assert grid.at_channels
    assert not grid.at_integrations


@pytest.mark.parametrize("layout", ["mwa-compact-minredundant", "hera-19", "mwa-extended"])
def test_plans_expect_the_nodes_that_there_are(layout):
    """The plan takes baselines for perpendicular to the Earth's axis, so it may have more, but not many more."""
    settings = InstrumentSettings.model_validate({"layout": {"kind": layout}, "times": {"integration": "10 s"}})
    grid = node_grid(make_template(settings), Nodes(), smooth_in_frequency=True)
    times, frequencies = node_counts(settings, Nodes())
    assert frequencies == len(grid.frequencies)
    assert len(grid.times_jd) <= times < 1.2 * len(grid.times_jd) + 2
    assert node_counts(settings, Nodes(enabled=False)) == (56, 384)
