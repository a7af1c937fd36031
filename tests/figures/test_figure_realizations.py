"""Figures of realizations show what was pooled."""

from dataclasses import replace

import numpy as np
import pytest
from realization_samples import BINS, LOSS, design_of, draw

from calstudy.figures.realizations import _differences, draw_comparison, draw_realizations
from calstudy.products.realizations import JUDGED_REGION, RegionResults, judge, results_of

DESIGN = design_of((("gains", "noise"), 10), (("eor",), 4))


def results(seed: int, loss: np.ndarray = LOSS) -> RegionResults:
    return results_of(draw(DESIGN, np.random.default_rng(seed), loss), DESIGN)


@pytest.fixture(scope="module")
def regions() -> dict[str, RegionResults]:
    inside = results(2, np.where(np.arange(BINS) < 5, 0.02, np.nan))
    return {"outside-wedge": results(1), "inside-wedge": inside, "all-modes": results(3)}


def test_the_figure_shows_mean_scatter_and_quoted_error_of_t(regions):
    figure = draw_realizations(regions, ["ten", "four"])
    transfer, errors, correlation, pulls, coverage, corrected = figure.axes[:6]
    total = regions["outside-wedge"].pooled.total["transfer"]
    points = transfer.containers[0]
    assert points.lines[0].get_ydata() == pytest.approx(total.mean)
    (bars,) = points.lines[2]
    lengths = [np.ptp(segment[:, 1]) for segment in bars.get_segments()]
    assert lengths == pytest.approx(2 * total.scatter)
    lines = {line.get_label(): line.get_ydata() for line in errors.lines}
    assert lines["quoted error"] == pytest.approx(total.quoted)
    squares = lines["scatter: ten"] ** 2 + lines["scatter: four"] ** 2
    assert lines["scatter: all together"] ** 2 == pytest.approx((1 - total.counted_twice) * squares)
    image = correlation.collections[0].get_array()
    assert np.asarray(image) == pytest.approx(total.correlation)
    assert np.diagonal(np.asarray(image)) == pytest.approx(np.ones(BINS))
    assert len(pulls.containers) == len(corrected.containers) == 2
    means = corrected.containers[1].lines[0].get_ydata()
    assert np.abs(means - 1).max() < 0.1
    shown = [line.get_ydata() for line in coverage.lines[:4]]
    outside = regions["outside-wedge"]
    # Of the draws that are independent for it, as in the table.
    expected = [outside.coverage("corrected_eor", np.arange(BINS) == place).value for place in range(BINS)]
    assert not np.allclose(expected, outside.covered["corrected_eor"].mean(axis=0))
    assert any(len(values) == BINS and np.allclose(values, expected) for values in shown)


@pytest.mark.parametrize("dominant", [0, 1])
def test_what_chance_makes_of_a_correlation_depends_on_the_block_that_scatters(regions, dominant):
    """Of a block of K alone it is 1 / sqrt(K - 1): of ten draws, or of four."""
    outside = regions["outside-wedge"]
    blocks = [
        replace(block, scatter=block.scatter * (1.0 if place == dominant else 1e-3))
        for place, block in enumerate(outside.pooled.blocks["transfer"])
    ]
    pooled = replace(outside.pooled, blocks=outside.pooled.blocks | {"transfer": blocks})
    shown = regions | {"outside-wedge": replace(outside, pooled=pooled)}
    title = draw_realizations(shown, ["ten", "four"]).axes[2].get_title()
    assert rf"\pm{(9, 3)[dominant] ** -0.5:.2f}$ by chance" in title


def test_pulls_far_above_and_below_have_labels(regions):
    outside = regions["outside-wedge"]
    pulls = np.geomspace(60, 3000, BINS)
    total = outside.pooled.total
    moved = {name: replace(total[name], mean=sign * pulls) for name, sign in (("pull_eor", 1), ("pull_input", -1))}
    shown = regions | {"outside-wedge": replace(outside, pooled=replace(outside.pooled, total=total | moved))}
    ticks = draw_realizations(shown, ["ten", "four"]).axes[3].get_yticks()
    assert {-1000, -100, -10, 0, 10, 100, 1000} <= set(ticks)


def test_the_difference_of_two_arrays_is_known_better_than_that_of_independent_draws():
    """The same skies, gains and noise are in both; with the same seeds, only the loss differs."""
    first, second = (results(7, loss).pooled for loss in (LOSS, 0.98 * LOSS))
    difference = _differences(first, second)["transfer"]
    apart = np.hypot(first.total["transfer"].error, second.total["transfer"].error)
    assert difference.mean == pytest.approx(0.02 * first.total["transfer"].mean)
    assert (difference.error < 0.1 * apart).all()
    figure = draw_comparison({"First": first, "Second": second}, difference)
    assert figure.axes[1].containers[0].lines[0].get_ydata() == pytest.approx(difference.mean)


def test_verdicts_follow_the_criteria(regions):
    """Bars of P^R cannot cover P^S where a tenth is lost; those of P^R / T do, and its mean is the input."""
    verdicts = {item.name: item for item in judge(regions[JUDGED_REGION])}
    assert verdicts["bars-cover-eor"].verdict == "FAIL"
    assert verdicts["bars-cover-eor"].measured < 0.9
    assert abs(verdicts["corrected-mean"].measured - 1) < 4 * verdicts["corrected-mean"].uncertainty
    for name in ("corrected-covers-eor", "corrected-covers-input"):
        assert verdicts[name].measured == pytest.approx(0.95, abs=4 * verdicts[name].uncertainty)


def test_what_no_block_draws_is_not_judged():
    design = design_of((("gains", "noise"), 10))
    found = results_of(draw(design, np.random.default_rng(4)), design)
    verdicts = {item.name: item for item in judge(found)}
    assert verdicts["bars-cover-eor"].verdict in ("PASS", "FAIL")
    for name in ("bars-cover-input", "corrected-covers-input"):
        assert verdicts[name].reason == "no block of the realizations draws the eor"
