from __future__ import annotations

import numpy as np
import pytest

from calstudy.figures.layout import LayoutPanel, draw_layouts


@pytest.fixture
def panels():
    rng = np.random.default_rng(21)
    return [
        LayoutPanel("left", np.arange(36), 50 * rng.normal(size=(36, 3)), (0, 1)),
        LayoutPanel("right", 100 + np.arange(7), 1000 + 14 * rng.normal(size=(7, 2))),
    ]


def test_antennas_are_at_their_positions_with_their_numbers(panels):
    for axes, panel in zip(draw_layouts(panels).axes, panels, strict=True):
        positions = np.concatenate([line.get_xydata() for line in axes.get_lines()])
        expected = panel.enu[:, :2]
        np.testing.assert_allclose(np.sort(positions, axis=0), np.sort(expected, axis=0))
        for number, text in zip(panel.numbers, axes.texts, strict=True):
            assert text.get_text() == str(number)
            np.testing.assert_allclose(text.xy, expected[panel.numbers == number][0])


def test_highlighted_antennas_are_filled(panels):
    plain, special = draw_layouts(panels).axes[0].get_lines()
    np.testing.assert_allclose(special.get_xydata(), panels[0].enu[:2, :2])
    assert special.get_markerfacecolor() != plain.get_markerfacecolor()


def test_a_metre_is_as_long_east_as_north(panels):
    figure = draw_layouts(panels)
    figure.draw_without_rendering()
    for axes in figure.axes:
        origin, east, north = axes.transData.transform([(0, 0), (10, 0), (0, 10)])
        assert east[0] - origin[0] == pytest.approx(north[1] - origin[1], rel=1e-6)
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        positions = np.concatenate([line.get_xydata() for line in axes.get_lines()])
        assert (positions > low).all()
        assert (positions < high).all()


@pytest.mark.parametrize(("spacing", "extent"), [(14.0, 60.0), (7.72, 165.0)])
def test_circles_do_not_overlap(spacing, extent):
    """Two neighbours in an array of the paper's size, and in a wide one."""
    positions = np.array([(0, 0), (spacing, 0), (0, extent), (extent, extent)])
    figure = draw_layouts([LayoutPanel("pair", np.arange(4), positions)] * 2)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    origin, neighbour = axes.transData.transform(positions[:2]) * 72 / figure.dpi
    assert 4 <= axes.get_lines()[0].get_markersize() <= neighbour[0] - origin[0]


def test_large_arrays_have_no_numbers():
    rng = np.random.default_rng(22)
    axes = draw_layouts([LayoutPanel("128", np.arange(128), 300 * rng.normal(size=(128, 3)))]).axes[0]
    assert len(axes.texts) == 0
