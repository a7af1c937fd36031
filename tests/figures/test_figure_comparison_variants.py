"""The figure of variants: what is measured, what is a limit and what did not converge must look different."""

from __future__ import annotations

from dataclasses import replace

import pytest
from flat_scores import case

from calstudy.figures.comparison import CROSS, VARIANT_COLOURS, draw_spectra, draw_variants, variants
from calstudy.plotting import style
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
    assert set(points) == {("o", equal), ("s", equal), ("x", style.BLACK), ("o", gains), ("s", gains)}
    assert points["o", equal].get_xdata()[0] == 10.0
    assert points["o", equal].get_markerfacecolor() == equal
    assert points["o", gains].get_xdata()[0] == upper_limit(0.1, 0.1)
    assert points["o", gains].get_markerfacecolor() == "white"


@pytest.mark.parametrize("bias_error", [1.0, 8.0])
@pytest.mark.parametrize(
    ("solves", "crossed"),
    [
        ({"converged": 2, "max-steps": 2}, False),
        ({"converged": 1, "max-steps": 3}, True),
        ({"converged": 1, "stalled": 1, "failed": 2}, True),
    ],
)
def test_a_cross_is_below_the_symbol_of_a_case_of_which_most_solves_did_not_converge(bias_error, solves, crossed):
    good = with_status(case(bias=10.0, bias_error=1.0), converged=4)
    other = with_status(case(bias=10.0, bias_error=bias_error), **solves)
    figure = draw_variants({"one, white": {"fit": good}, "one, smooth": {"fit": other}}, ["fit"])
    _, symbol, *crosses = (line for line in figure.axes[0].lines if line.get_linestyle() == "None")
    assert symbol.get_marker() == "s"
    assert symbol.get_markerfacecolor() == ("white" if bias_error == 8.0 else VARIANT_COLOURS[0])
    at = [list(cross.get_xydata()[0]) for cross in crosses]
    assert at == crossed * [list(symbol.get_xydata()[0])]
    assert all(cross.get_marker() == CROSS["marker"] for cross in crosses)
    assert all(symbol.get_markersize() < cross.get_markersize() for cross in crosses)
    assert all(symbol.get_zorder() > cross.get_zorder() for cross in crosses)
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert labels[3:] == ["95 % upper limit", *(["most solves did not converge"] if crossed else [])]


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


@pytest.mark.parametrize("bias", [0.004, 2e-5])
def test_a_small_bias_is_within_the_axis(bias):
    small = with_status(case(bias=bias, bias_error=bias / 8), converged=4)
    figure = draw_variants({"one, white": {"fit": small}}, ["fit"])
    low, high = figure.axes[0].get_xlim()
    assert low < bias < high


def test_a_world_in_which_all_calibrators_refuse_is_an_empty_row():
    figure = draw_spectra({"refused": {}, "one": {"fit": case()}}, ["fit"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["refused", "", "one", ""]


def test_each_kind_of_world_has_the_calibrators_that_worked_there(figure):
    short, long = figure.axes[0], figure.axes[2]
    assert short.get_title(loc="left") == "short"
    assert [label.get_text() for label in long.get_yticklabels()] == ["fit"]
    assert len([line for line in long.lines if line.get_linestyle() == "None"]) == 1
