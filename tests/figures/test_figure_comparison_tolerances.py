"""Tolerances say of which level of the EoR they are."""

import numpy as np
import pytest

from calstudy.figures.comparison_summary import draw_tolerances
from calstudy.power.score import BANDS, Score
from calstudy.products.comparison import Case
from calstudy.products.tolerances import faults

EDGES = np.array(BANDS)
WORLDS = {"ideal": 0.0, "positions: 1 cm": 0.3, "positions: 10 cm": 30.0}


def made_up(bias: float, **solves: int) -> Case:
    bins = EDGES.size - 1
    ones = np.ones(bins)
    bands = Score(
        k=(EDGES[1:] + EDGES[:-1]) / 2,
        bin_edges=EDGES,
        transfer=0.9 * ones,
        transfer_error=0.01 * ones,
        bias=bias * ones,
        bias_error=0.01 * ones,
        recovered=ones,
        recovered_error=0.01 * ones,
        flux_scale=1.0,
    )
    return Case(bands, bands, {"by_status": solves or {"converged": 4}})


@pytest.mark.parametrize(("level", "title"), [(-40.0, "$, EoR at $-40$ dB of the foregrounds"), (None, "{-1}$")])
def test_the_level_of_the_eor_stands_above_the_figure_if_all_cases_have_one(level, title):
    cases = {world: {"one": made_up(bias)} for world, bias in WORLDS.items()}
    figure = draw_tolerances(faults(list(WORLDS)), cases, ["one"], eor_level=level)
    bias, _ = figure.axes
    assert bias.get_title(loc="left").endswith(title)
    np.testing.assert_allclose(bias.get_lines()[0].get_ydata(), list(WORLDS.values()))


def test_a_cross_is_over_a_case_of_which_most_solves_did_not_converge():
    cases = {world: {"one": made_up(bias)} for world, bias in WORLDS.items()}
    figure = draw_tolerances(faults(list(WORLDS)), cases, ["one"])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one"]
    cases["positions: 10 cm"] = {"one": made_up(30.0, **{"converged": 1, "max-steps": 2})}
    figure = draw_tolerances(faults(list(WORLDS)), cases, ["one"])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "most solves did not converge"]
    for axes, value in zip(figure.axes, (30.0, 0.9), strict=True):
        (cross,) = (line for line in axes.get_lines() if line.get_marker() == "x")
        np.testing.assert_allclose(cross.get_xydata(), [[10.0, value]])
