"""Chebyshev nodes interpolate what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_cases import observe

from calstudy.instrument.array_layouts.geometric import HexLayout
from calstudy.instrument.beam_models.tables import HeraBeam
from calstudy.instrument.settings import Channels, InstrumentSettings, Times
from calstudy.simulate.chunks import Component, simulate_visibilities
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.nodes import (
    EXACT,
    Accuracy,
    chebyshev_count,
    chebyshev_nodes,
    frequency_axis,
    frequency_bandwidth,
    integration_times,
    interpolation_matrix,
    time_axis,
    time_bandwidth,
    turning_length,
)
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources

DEFAULT = Accuracy(tolerance=1e-9, beam_extent=20.0)


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
    times, channels = time_axis(template, DEFAULT), frequency_axis(template, DEFAULT)
    assert (len(times.nodes), len(channels.nodes)) == (17, 94)
    # 176 m and 20 m of beam: half the turns of the horizon delay over 30.64 MHz.
    assert frequency_bandwidth(template.freq_array, 196.15) == pytest.approx(np.pi * 196.15 / 299792458 * 30.64e6)
    assert turning_length(template) < 177
    fastest = time_bandwidth(integration_times(template), 197.6e6, 197)
    assert fastest == pytest.approx(np.pi * 197.6e6 / 299792458 * 197 * 7.29e-5 * 110, rel=1e-3)


def test_east_west_baselines_turn_faster_than_polar_ones():
    template = observe(count=8)
    vectors = template.telescope.get_enu_antpos()
    latitude = template.telescope.location.geodetic.lat.rad
    pole = np.array([0, np.cos(latitude), np.sin(latitude)])
    assert turning_length(template) > 1.0
    along = template.copy()
    # The same array laid out along the Earth's axis does not turn at all.
    distances = np.linspace(0, np.ptp(vectors[:, 0]), len(vectors))
    from pyuvdata import utils

    centre = np.array([axis.to_value("m") for axis in template.telescope.location.geocentric])
    ecef = utils.ECEF_from_ENU(distances[:, None] * pole, center_loc=template.telescope.location)
    along.telescope.antenna_positions = ecef - centre
    assert turning_length(along) < 1e-6 * turning_length(template)


@pytest.mark.parametrize("accuracy", [EXACT, Accuracy(tolerance=1e-9, beam_extent=1e5)])
def test_without_nodes_every_sample_is_simulated(accuracy):
    template = observe(channels=12, times=5, integration="2 s")
    times, channels = time_axis(template, accuracy), frequency_axis(template, accuracy)
    assert times.at_samples
    assert channels.at_samples
    np.testing.assert_array_equal(times.nodes, integration_times(template))
    np.testing.assert_array_equal(channels.nodes, template.freq_array)
    values = np.random.default_rng(0).normal(size=(5, template.Nbls))
    np.testing.assert_array_equal(times.interpolate(values), values)


@pytest.mark.parametrize("rough", ["smooth_sky", "smooth_beam"])
def test_what_is_not_smooth_has_every_channel_as_a_node(rough):
    template = observe(channels=64, width="80 kHz", times=40, integration="2 s")
    accuracy = Accuracy(tolerance=1e-9, beam_extent=20.0, **{rough: False})
    assert frequency_axis(template, accuracy).at_samples
    assert not frequency_axis(template, DEFAULT).at_samples
    assert not time_axis(template, accuracy).at_samples


def test_axes_interpolate_arrays_of_any_shape():
    template = observe(channels=64, width="80 kHz", times=40, integration="2 s")
    axis = time_axis(template, DEFAULT)
    rng = np.random.default_rng(4)
    values = rng.normal(size=(len(axis.nodes), 2, 3)) + 1j * rng.normal(size=(len(axis.nodes), 2, 3))
    expected = np.einsum("mn,nab->mab", axis.matrix, values)
    np.testing.assert_allclose(axis.interpolate(values), expected, atol=1e-13)
    np.testing.assert_allclose(axis.interpolate(values.swapaxes(1, 2)), expected.swapaxes(1, 2), atol=1e-13)


def test_foregrounds_through_heras_beam_err_by_the_tolerance():
    """Its structure has larger delays than that of a tile, for which the default is."""
    array = InstrumentSettings(
        layout=HexLayout(side=2, spacing="14.6 m"),
        location="hera",
        beam=HeraBeam(),
        channels=Channels(first="167.075 MHz", width="480 kHz", count=64),
        times=Times(count=1, integration="2 s"),
        polarizations=("xx",),
    )
    sources = SyntheticSources(kind="g4jy-and-counts", count=100)
    component = Component(array, SimulationSettings(), sources, "Planck18")
    beam, template = component.beam, component.template
    sky = make_foregrounds(sources, template.freq_array).sky

    exact, *interpolated = (
        simulate_visibilities(DenseEngine(), sky, beam, template, each) for each in (EXACT, component.accuracy, DEFAULT)
    )
    rms = np.sqrt(np.mean(np.abs(exact) ** 2))
    own, default = (float(np.abs(cube - exact).max() / rms) for cube in interpolated)
    assert len(frequency_axis(template, component.accuracy).nodes) < 64
    # The bound is for phasors of the fastest fringe; a beam is none, and may err by some times more.
    assert own < 10 * component.accuracy.tolerance
    assert default > 1000 * component.accuracy.tolerance
