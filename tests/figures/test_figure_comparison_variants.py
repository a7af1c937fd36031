"""The figure of variants: what is measured, what is a limit and what stalled must look different."""

from __future__ import annotations

from dataclasses import replace

import pytest
from flat_scores import case

from calstudy.figures.comparison import VARIANT_COLOURS, draw_variants, variants
from calstudy.verdicts.standing import upper_limit


def with_status(found, **by_status):
    return replace(found, summary={"by_status": by_status})


@pytest.fixture
def figure():
    good = with_status(case(bias=10.0, bias_error=1.0), converged=4)
    hidden = with_status(case(bias=0.1, bias_error=0.1), converged=4)
    lost = with_status(case(bias=1e6, bias_error=1e5), converged=1, stalled=3)
    cases = {
        "short, white": {"fit, equal": good, "fit, gains": hidden},
        "short, smooth": {"fit, equal": lost, "fit, gains": hidden},
        "long, white": {"fit, equal": good},
    }
    return draw_variants(cases, ["fit, equal", "fit, gains", "other, equal"])


def test_labels_are_split_at_their_last_comma():
    assert variants(["CALAMITY, groups, equal", "CALAMITY, groups, gains", "none"]) == {
        "CALAMITY, groups": {"equal": "CALAMITY, groups, equal", "gains": "CALAMITY, groups, gains"},
        "none": {"": "none"},
    }


def test_symbols_say_what_was_measured(figure):
    panel = figure.axes[0]
    points = {(line.get_marker(), line.get_color()): line for line in panel.lines if line.get_linestyle() == "None"}
    equal, gains = VARIANT_COLOURS[:2]
    assert set(points) == {("o", equal), ("x", equal), ("o", gains), ("s", gains)}
    assert points["o", equal].get_xdata()[0] == 10.0
    assert points["o", equal].get_markerfacecolor() == equal
    assert points["o", gains].get_xdata()[0] == upper_limit(0.1, 0.1)
    assert points["o", gains].get_markerfacecolor() == "white"


def test_symbols_of_worlds_are_those_of_the_legend_and_none_is_left_out():
    good = with_status(case(bias=10.0, bias_error=1.0), converged=4)
    names = [f"fit, {number}" for number in range(6)]
    worlds = ["ideal", *(f"positions, {size} cm" for size in (2, 5, 10, 20, 50, 100))]
    figure = draw_variants({world: dict.fromkeys(names, good) for world in worlds}, names)
    legend = {
        text.get_text(): line for text, line in zip(figure.legends[0].texts, figure.legends[0].get_lines(), strict=True)
    }
    drawn = [line.get_marker() for line in figure.axes[2].lines if line.get_linestyle() == "None"]
    assert drawn == 6 * [legend[f"{size} cm"].get_marker() for size in (2, 5, 10, 20, 50, 100)]


def test_each_kind_of_world_has_the_calibrators_that_worked_there(figure):
    short, long = figure.axes[0], figure.axes[2]
    assert short.get_title(loc="left") == "short"
    assert [label.get_text() for label in long.get_yticklabels()] == ["fit"]
    assert len([line for line in long.lines if line.get_linestyle() == "None"]) == 1
