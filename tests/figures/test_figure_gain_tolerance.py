"""The rms of gain errors that is tolerated follows from the measured bias, and from the law where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from calstudy.experiment.model import FIGURES
from calstudy.figures.gain_tolerance import GainTolerance, PublishedTolerance, draw_gain_tolerance, tolerated
from calstudy.power.gain_bias import GainBias
from calstudy.power.score import BANDS

BIAS = np.array([400.0, 40.0, 0.001])
"""Of a law without the second order, at an rms of 0.001."""
LAW = GainBias(
    sigma=1e-3,
    length=1e6,
    time=np.nan,
    common=0.0,
    form="gaussian",
    bin_edges=np.array(BANDS),
    bias=BIAS,
    terms=np.stack([BIAS / 1e-6, 0 * BIAS]),
    lengths=np.array([1e5, 1e6, 1e7]),
    terms_at=np.ones((3, 2, 3)),
)


def test_the_tolerated_rms_is_that_of_the_measurement_or_a_lower_limit():
    error = np.array([20.0, 4.0, 0.04])
    found = tolerated(LAW, np.array([100.0, 40.0, 0.01]), error)
    # The bias goes with the square: 0.1 is a thousandth of 100, and the upper limit of the last is 0.09.
    expected = 1e-3 * np.sqrt(0.1 / np.array([100, 40, 0.09]))
    assert found.sigma == pytest.approx(expected)
    assert found.sigma_error[:2] == pytest.approx(expected[:2] * [0.1, 0.05])
    assert np.isnan(found.sigma_error[2])


def test_without_a_law_the_bias_goes_with_the_variance():
    unknown = replace(LAW, bias=np.full(3, np.nan), terms=np.full((2, 3), np.nan))
    error = np.array([20.0, 2.0, 0.04])
    assert tolerated(unknown, BIAS, error).sigma == pytest.approx(tolerated(LAW, BIAS, error).sigma)


def test_points_of_the_measurement_stand_beside_the_lines_of_the_law():
    error = np.array([20.0, 2.0, 0.04])
    worlds = {
        "1 MHz": tolerated(LAW, BIAS, error),
        "white, 8 s": tolerated(replace(LAW, length=0.0, time=8.0), BIAS, error),
        "common": tolerated(replace(LAW, common=1.0, form="exponential"), BIAS, error),
    }
    figure = draw_gain_tolerance(worlds, -40.0)
    assert [axes.get_title() for axes in figure.axes[:1]] == [r"$k = 0.1$–$0.2$ $h\,\mathrm{Mpc}^{-1}$"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "constant",
        "8 s",
        "constant, exponential, 100 % common",
    ]
    first = figure.axes[0]
    assert [label.get_text() for label in first.get_xticklabels()] == ["0", "1"]
    drawn = [line.get_ydata() for line in first.get_lines()]
    # In percent.
    assert any(np.allclose(line, 100 * worlds["1 MHz"].sigma[0]) for line in drawn if len(line) == 1)


def test_what_a_faint_eor_tolerates_is_within_the_axis():
    faint = tolerated(replace(LAW, bias=1e6 * LAW.bias, terms=1e6 * LAW.terms), 1e6 * BIAS, np.full(3, 0.04))
    for axes in draw_gain_tolerance({"1 MHz": faint}, -60.0).axes:
        low, high = axes.get_ylim()
        assert low < 100 * faint.sigma.min()
        assert high == 100


def published(name="A", rms="1 %", source="a thesis", reason="the EoR"):
    return PublishedTolerance(name=name, rms=rms, source=source, reason=reason)


def test_published_tolerances_are_lines_with_names_beside_the_panel_that_do_not_overlap():
    worlds = {"1 MHz": tolerated(LAW, BIAS, np.array([20.0, 2.0, 0.04]))}
    near = [published("B", 0.011), published(), published("beyond the axis", "1e-7 %")]
    figure = draw_gain_tolerance(worlds, published=near)
    assert all(
        {1.0, 1.1} <= {round(float(line.get_ydata()[0]), 6) for line in axes.get_lines()} for axes in figure.axes
    )
    figure.draw_without_rendering()
    last = figure.axes[-1]
    lower, upper = (text.get_window_extent() for text in last.texts)
    assert [text.get_text() for text in last.texts] == ["A: 1 %", "B: 1.1 %"]
    assert lower.y1 <= upper.y0 + 0.5
    assert min(lower.x0, upper.x0) > last.get_window_extent().x1
    assert max(lower.x1, upper.x1) <= figure.bbox.x1
    # Without any, there are none.
    assert not draw_gain_tolerance(worlds).axes[-1].texts


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"rms": "120 %"}, "less than 1"),
        ({"source": " "}, "is empty"),
        ({"reason": ""}, "is empty"),
        ({"rms": 0}, "greater"),
    ],
)
def test_a_published_tolerance_says_what_it_needs(changes, sentence):
    with pytest.raises(ValidationError, match=sentence):
        published(**changes)


def test_the_caption_has_the_sources_and_reasons():
    plain = FIGURES.make("gain-tolerance")
    given = GainTolerance(published=(published(),))
    assert plain.captioned() == plain.caption
    assert given.captioned() == plain.caption + " Dotted lines: A (a thesis): the EoR."
