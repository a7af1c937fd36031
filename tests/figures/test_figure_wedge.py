from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.collections import QuadMesh

from calstudy.figures.wedge import TITLES, draw_wedge

C = 299792458.0
quick = settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def signed_power_at(axes, k_perp: float, k_parallel: float) -> float:
    """Read the power off the drawing: the value of the cell around a point, NaN where nothing is drawn."""
    positive, negative = (item for item in axes.collections if isinstance(item, QuadMesh))
    found = np.nan
    for sign, mesh in ((1, positive), (-1, negative)):
        corners = mesh.get_coordinates()
        column = np.searchsorted(corners[0, :, 0], k_perp) - 1
        row = np.searchsorted(corners[:, 0, 1], k_parallel, side="right") - 1
        value = np.ma.filled(mesh.get_array(), np.nan).reshape(corners.shape[0] - 1, -1)[row, column]
        if np.isfinite(value):
            assert np.isnan(found)
            found = sign * value
    return found


def test_panels_are_those_of_the_paper_in_its_order(wedge_panels):
    panels = draw_wedge(wedge_panels).axes[:5]
    assert [axes.get_title() for axes in panels] == [r"$P^{S+N+F}$", r"$P^{V}$", r"$P^{R}$", r"$P^{S}$", r"$P^{N}$"]


def test_each_cell_shows_its_signed_power(wedge_panels):
    figure = draw_wedge(wedge_panels)
    for axes, name in zip(figure.axes, TITLES, strict=False):
        spectrum = wedge_panels[name]
        floor = axes.collections[0].norm.vmin
        for (b, d), power in np.ndenumerate(spectrum.power.real):
            seen = signed_power_at(axes, spectrum.k_perp[b], spectrum.k_parallel[d])
            assert seen == pytest.approx(power if abs(power) > floor else np.copysign(floor, power or 1.0))


@quick
@given(present=st.lists(st.integers(1, 60), min_size=1, max_size=12, unique=True).map(sorted))
def test_lengths_without_baselines_stay_empty(make_wedge_spectrum, present):
    lower = 3.0 * np.array(present)
    spectrum = make_wedge_spectrum(
        1e7 + np.arange(4) * np.ones((lower.size, 1)), np.column_stack([lower, lower + 3]), np.arange(4) * 1e-7
    )
    axes = draw_wedge(dict.fromkeys(TITLES, spectrum)).axes[0]
    for number in range(present[0], present[-1] + 1):
        seen = signed_power_at(axes, 5.55e-4 * 3.0 * (number + 0.5), spectrum.k_parallel[2])
        assert np.isfinite(seen) == (number in present)
        assert not np.isfinite(seen) or seen == 1e7 + 2


def test_missing_power_is_not_drawn(wedge_panels):
    power = wedge_panels["residual"].power.copy()
    power[3, 5] = np.nan
    spectrum = replace(wedge_panels["residual"], power=power)
    axes = draw_wedge({**wedge_panels, "residual": spectrum}).axes[2]
    assert np.isnan(signed_power_at(axes, spectrum.k_perp[3], spectrum.k_parallel[5]))


def test_positive_is_warm_negative_is_blue_and_all_panels_share_the_colours(wedge_panels):
    figure = draw_wedge(wedge_panels)
    norms = set()
    for axes in figure.axes[:5]:
        positive, negative = (item for item in axes.collections if isinstance(item, QuadMesh))
        norms.add((positive.norm.vmin, positive.norm.vmax, negative.norm.vmin, negative.norm.vmax))
        decades = np.logspace(7, 8, 5)
        red, _, blue, _ = positive.to_rgba(decades).T
        assert (red > blue + 0.1).all()
        red, _, blue, _ = negative.to_rgba(decades).T
        assert (blue > red + 0.1).all()
    assert len(norms) == 1
    floor, highest, same_floor, lowest = norms.pop()
    spectra = [wedge_panels[name].power.real for name in TITLES]
    assert floor == same_floor
    assert highest >= max(power.max() for power in spectra)
    assert lowest >= -min(power.min() for power in spectra)


@pytest.mark.parametrize("buffer", [0.0, 250e-9])
def test_lines_are_at_the_light_travel_time_read_off_the_outer_axes(wedge_panels, buffer):
    figure = draw_wedge(wedge_panels, buffer=buffer)
    figure.draw_without_rendering()
    last = figure.axes[4]
    top, right = last.child_axes
    for line, extra in zip(last.get_lines(), (0.0, buffer), strict=True):
        k_perp, k_parallel = line.get_data()
        metres = np.interp(k_perp, last.get_xlim(), top.get_xlim())
        nanoseconds = np.interp(k_parallel, last.get_ylim(), right.get_ylim())
        assert metres[0] < 20 < 150 < metres[-1]
        np.testing.assert_allclose(nanoseconds, metres / C * 1e9 + extra * 1e9, rtol=1e-9)


@pytest.mark.chain
def test_delay_axis_ends_at_the_largest_delay_but_not_beyond_the_data(wedge_panels, monkeypatch):
    for max_delay, expected in ((1e-6, 1000.0), (1.0, 59.5 / 30.72e6 * 1e9)):
        monkeypatch.setattr("calstudy.plotting.axes.MAX_DELAY", max_delay)
        figure = draw_wedge(wedge_panels)
        figure.draw_without_rendering()
        right = figure.axes[4].child_axes[-1]
        assert right.get_ylim() == pytest.approx((0, expected))
