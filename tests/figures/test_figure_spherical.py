from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import same_color, to_rgba

from calstudy.figures.spherical import MARKINGS, draw_spherical
from calstudy.power.limits import Limits

CAPTION = {
    "uncorrupted": ("o", "#000000"),
    "uncalibrated": ("D", "#D55E00"),
    "residual": ("s", "#E69F00"),
    "residual_without_eor": ("s", "#56B4E9"),
    "noise": ("o", "#CC79A7"),
}


def drawn(axes) -> dict:
    return {container.get_label(): container for container in axes.containers}


@pytest.fixture
def columns(make_column):
    return [make_column(1), make_column(2, empty=2)]


def test_points_are_at_the_magnitude_filled_where_positive_and_open_where_negative(columns):
    grid = np.array(draw_spherical(columns).axes).reshape(2, 2)
    for column, axes in zip(columns, grid[0], strict=True):
        for name, (marker, colour) in CAPTION.items():
            spectrum = getattr(column, name)
            power = spectrum.power.real
            shift = MARKINGS[name].shift * 0.04
            for sign, chosen in (("positive", power > 0), ("negative", power < 0)):
                points = drawn(axes)[f"{name}, {sign}"].lines[0]
                np.testing.assert_allclose(points.get_xdata(), spectrum.k[chosen] + shift)
                np.testing.assert_allclose(points.get_ydata(), np.abs(power[chosen]))
                assert points.get_marker() == marker
                assert same_color(points.get_color(), colour)
                assert same_color(points.get_markerfacecolor(), "white" if sign == "negative" else colour)
    assert any((getattr(columns[0], name).power.real < 0).any() for name in CAPTION)


def test_bars_span_95_percent_of_a_normal_distribution(columns):
    axes = draw_spherical(columns).axes[0]
    for name in CAPTION:
        spectrum = getattr(columns[0], name)
        chosen = spectrum.power.real > 0
        (bars,) = drawn(axes)[f"{name}, positive"].lines[2]
        ends = np.array(bars.get_segments())[:, :, 1]
        sigma = (spectrum.noise_error + spectrum.sample_error)[chosen]
        np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 2 * 1.96 * sigma)
        np.testing.assert_allclose(ends.mean(axis=1), spectrum.power.real[chosen])


def test_no_point_leaves_its_bin_nor_the_axes(columns):
    axes = draw_spherical(columns).axes[0]
    first, last = axes.get_xlim()
    for name in CAPTION:
        spectrum = getattr(columns[0], name)
        for container in (drawn(axes)[f"{name}, {sign}"] for sign in ("positive", "negative")):
            x = container.lines[0].get_xdata()
            index = np.searchsorted(spectrum.bin_edges, x) - 1
            np.testing.assert_allclose(spectrum.k[index], x - MARKINGS[name].shift * 0.04)
            assert ((x > first) & (x < last)).all()


def test_grey_band_is_the_sample_variance_of_the_eor(columns):
    for column, axes in zip(columns * 2, draw_spherical(columns).axes, strict=True):
        (band,) = (item for item in axes.collections if item.get_label() == "eor")
        assert same_color(band.get_facecolor()[0], to_rgba("#C9C9C9"))
        spectrum = column.eor
        vertices = band.get_paths()[0].vertices
        for k, power, sigma in zip(spectrum.k, spectrum.power.real, spectrum.sample_error, strict=True):
            at_k = vertices[np.isclose(vertices[:, 0], k), 1]
            if np.isnan(power):
                assert at_k.size == 0
            else:
                assert at_k.min() == pytest.approx(power - 1.96 * sigma)
                assert at_k.max() == pytest.approx(power + 1.96 * sigma)


def test_rows_are_full_range_and_zoom(columns):
    grid = np.array(draw_spherical(columns).axes).reshape(2, 2)
    full, zoom = grid[0, 0].get_ylim(), grid[1, 0].get_ylim()
    for column in columns:
        assert full[1] > np.nanmax(column.uncorrupted.power.real)
        assert full[1] > np.nanmax(column.uncalibrated.power.real)
        assert zoom[0] < np.nanmedian(np.abs(column.noise.power.real))
        assert zoom[1] > np.nanmax(column.eor.power.real + 1.96 * column.eor.error)
    assert zoom[1] / zoom[0] < 1e-4 * full[1] / full[0]
    assert grid[1, 0].get_xlim()[1] == 1.0
    assert not any("uncalibrated" in label or "uncorrupted" in label for axes in grid[1] for label in drawn(axes))
    assert all("residual, positive" in drawn(axes) for axes in grid[1])


def test_series_that_are_absent_are_neither_drawn_nor_in_the_legend(columns):
    column = replace(columns[0], residual_without_eor=None, uncalibrated=None)
    figure = draw_spherical([column])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == [r"$P^{S+F+N}$", r"$P^{R}$", r"$P^{N}$", r"$P^{S}$, 95% sample variance", r"open: $P < 0$"]
    assert not any("uncalibrated" in label or "without_eor" in label for label in drawn(figure.axes[0]))


def test_legend_follows_the_caption(columns):
    figure = draw_spherical(columns)
    handles = figure.legends[0].legend_handles[:5]
    seen = [(handle.get_marker(), handle.get_color()) for handle in handles]
    assert seen == list(CAPTION.values())


def test_spectra_that_cannot_be_drawn_are_refused(columns):
    column = columns[0]
    empty = replace(column.eor, power=np.full_like(column.eor.power, np.nan))
    unknown = replace(column.noise, noise_error=np.full(column.noise.k.size, np.nan))
    for bad, message in (
        ([replace(column, eor=empty)], "no power of 'eor' is finite"),
        ([replace(column, noise=unknown)], "'noise' has power without an error bar"),
    ):
        with pytest.raises(ValueError, match=message):
            draw_spherical(bad)


def test_published_limits_are_drawn_as_power_above_with_their_redshifts(columns):
    limits = [
        Limits(name, "doi", z, np.array([0.2, 0.4]), np.array([1e3, 4e3])) for name, z in (("First", 6.5), ("B", 7.0))
    ]
    figure = draw_spherical(columns, limits=limits, z=6.77)
    grid = np.array(figure.axes).reshape(2, 2)
    for axes in grid[0]:
        (line,) = (line for line in axes.get_lines() if line.get_label() == "First, $z = 6.5$")
        # P = 2 pi^2 Delta^2 / k^3.
        np.testing.assert_allclose(line.get_ydata(), 2 * np.pi**2 * np.array([1e3 / 0.008, 4e3 / 0.064]))
    assert not any("First" in str(line.get_label()) for axes in grid[1] for line in axes.get_lines())
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names[-2:] == ["First, $z = 6.5$", "B, $z = 7$"]
    assert legend.get_title().get_text().startswith("spectra: $z = 6.77$")
    (without,) = draw_spherical(columns).legends
    assert [text.get_text() for text in without.get_texts()] == names[:-2]
    assert not without.get_title().get_text()
