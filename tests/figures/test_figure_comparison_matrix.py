"""The matrix of calibrators and worlds: what its cells say must be what was measured, and no more."""

import re

import numpy as np
import pytest
from flat_scores import case
from matplotlib.colors import same_color

from calstudy.experiment.model import FIGURES
from calstudy.figures.comparison_summary import draw_matrix
from calstudy.plotting import style
from calstudy.verdicts.standing import upper_limit


def draw(cases):
    """Draw cases by world of one calibrator."""
    return draw_matrix({world: {"mine": found} for world, found in cases.items()}, ["mine"])


def cell(found, worlds=1):
    """What the first cell of the first band says, and its colour."""
    axes = draw({f"world {number}": found for number in range(worlds)}).axes[0]
    return axes.texts[0].get_text().split("\n"), axes.images[0].get_array()[0, 0]


@pytest.mark.parametrize(
    ("bias", "error", "told"),
    [
        (0.224, 0.121, "bias < 0.47"),
        (-0.224, 0.121, "bias < 0.47"),
        (0.0, 0.121, "bias < 0.24"),
        (0.3, 0.121, "bias 0.3"),
        (-3.0, 0.5, "bias -3"),
        (7.0, np.nan, "bias 7"),
        (99.7, 9.0, "bias 100"),
        (np.nan, np.nan, "bias –"),
    ],
)
def test_a_bias_that_is_not_significant_is_an_upper_limit_that_holds_what_was_measured(bias, error, told):
    (text, _), colour = cell(case(bias, error))
    assert text == told
    # The colour is that of the number that is written.
    size = upper_limit(bias, error) if "<" in told else abs(bias)
    other = cell(case(size, 1e-9))[1] if np.isfinite(size) else np.ones(4)
    assert same_color(colour, other)
    hatched = {patch.get_hatch() for patch in draw({"world": case(bias, error)}).axes[0].patches}
    assert hatched == ({"////"} if "<" in told else set())


def test_a_limit_is_above_the_bias_by_two_standard_deviations():
    assert upper_limit(-0.224, 0.121) == pytest.approx(0.466)


@pytest.mark.parametrize(
    ("transfer", "error", "worlds", "told"),
    [
        (0.374, 0.01, 1, "$T$ = 0.37"),
        (0.374, 0.1, 1, "$T$ = 0.37"),
        (0.374, 0.26, 1, "$T$ = 0.37 ± 0.26"),
        (0.374, 0.26, 10, "$T$ = 0.4"),
        (0.374, 0.01, 10, "$T$ = 0.37"),
        (0.374, np.nan, 1, "$T$ = 0.37"),
        (np.nan, np.nan, 1, "no $T$"),
        # A calibration that diverged.
        (-4e5, 1e4, 1, "no $T$"),
    ],
)
def test_t_has_no_more_decimals_than_its_error_allows(transfer, error, worlds, told):
    (_, text), _ = cell(case(transfer=transfer, transfer_error=error), worlds)
    assert text == told


@pytest.mark.parametrize("worlds", [1, 3, 6, 8, 11, 18])
def test_texts_stay_in_their_cells(worlds):
    widest = case(bias=0.0984, bias_error=0.0984, transfer=-0.374, transfer_error=0.26, stalled=4)
    with style.journal_style():
        figure = draw({f"w{number}": widest for number in range(worlds)})
        figure.draw_without_rendering()
        axes = figure.axes[0]
        width = axes.get_window_extent().width / axes.images[0].get_array().shape[1]
        assert all(text.get_window_extent().width < width for text in axes.texts)


@pytest.mark.parametrize("worlds", [3, 18])
def test_each_cell_is_of_its_world_and_calibrator(worlds):
    cases = {
        f"w{world}": {name: case(bias=world + place / 10, bias_error=1e-3) for place, name in enumerate(("a", "b"), 2)}
        for world in range(1, worlds + 1)
    }
    del cases["w2"]["b"]
    figure = draw_matrix(cases, ["a", "b"])
    axes = figure.axes[0]
    columns = [label.get_text() for label in figure.axes[2].get_xticklabels()]
    rows = [label.get_text() for label in axes.get_yticklabels()]
    assert "w1" in (columns if worlds == 3 else rows)
    for text in axes.texts:
        column, row = (int(place) for place in text.get_position())
        world, name = sorted((columns[column], rows[row]), key=lambda label: label not in cases)
        found = cases[world].get(name)
        assert text.get_text().startswith("no scores" if found is None else f"bias {found.bands.bias[0]:.2g}")


@pytest.mark.parametrize(
    ("solves", "star"),
    [
        ({"converged": 4}, ""),
        ({"by-file": 4}, ""),
        ({"converged": 2, "stalled": 2}, ""),
        ({"converged": 1, "max-steps": 1, "stalled": 2}, "*"),
        ({"max-steps": 4}, "*"),
    ],
)
def test_a_star_marks_a_case_of_which_most_solves_did_not_converge(solves, star):
    figure = draw({"one": case(bias=3.0, **solves), "two": case()})
    assert [text.get_text().split("\n")[0] for text in figure.axes[0].texts] == [f"bias 3{star}", "bias 1"]
    assert ("*: most solves did not converge" in figure.axes[-1].get_ylabel()) == bool(star)


def test_the_caption_says_what_the_sign_means():
    assert re.search(r"< and hatched: 95 % upper limit", FIGURES.make("comparison-matrix").caption)
