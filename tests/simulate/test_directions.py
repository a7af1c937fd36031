"""Source positions and horizon crossings."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.time import Time
from simulation_cases import healpix_sky, observe, random_sky

from calstudy.simulate.nodes import integration_times
from calstudy.simulate.sources import SourceTracks, split_by_horizon

# Radians: 1e-10 rad of phase on a 176 m baseline.
TOLERANCE = 1e-13


@pytest.mark.parametrize("integration", ["2 s", "600 s"])
def test_directions_are_pyradioskys_at_every_time(integration):
    template = observe(times=30, integration=integration)
    sky = random_sky(template)
    location, times = template.telescope.location, integration_times(template)
    tracks = SourceTracks.of(sky, location, times)
    np.testing.assert_allclose(tracks.at(times[3:5]), [tracks.at(time) for time in times[3:5]], atol=TOLERANCE)
    for time in times[[0, 1, 17, 29]]:
        sky.update_positions(Time(time, format="jd", scale="utc", location=location), location)
        np.testing.assert_allclose(tracks.at(time), sky.pos_lmn, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(tracks.at(time, np.array([5, 3])), sky.pos_lmn[:, [5, 3]], rtol=0, atol=TOLERANCE)


def test_healpix_directions_are_pyradioskys():
    template = observe(times=2)
    sky = healpix_sky(template.freq_array)
    location, times = template.telescope.location, integration_times(template)
    tracks = SourceTracks.of(sky, location, times)
    sky.update_positions(Time(times[1], format="jd", scale="utc", location=location), location)
    np.testing.assert_allclose(tracks.at(times[1]), sky.pos_lmn, rtol=0, atol=TOLERANCE)


def test_sources_are_split_by_what_they_do_within_the_run():
    template = observe(times=20, integration="6 s")
    sky = random_sky(template, count=400)
    location, times = template.telescope.location, integration_times(template)
    up = []
    for time in times:
        sky.update_positions(Time(time, format="jd", scale="utc", location=location), location)
        up.append(sky.above_horizon)
    always_up, crossing = split_by_horizon(SourceTracks.of(sky, location, times), times)
    np.testing.assert_array_equal(always_up, np.flatnonzero(np.all(up, axis=0)))
    np.testing.assert_array_equal(crossing, np.flatnonzero(np.any(up, axis=0) & ~np.all(up, axis=0)))
    rising = [index for index in crossing if up[-1][index]]
    assert 0 < len(rising) < len(crossing)
