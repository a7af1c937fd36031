"""Claims over realizations: what one run leaves undecided, and statements that one run cannot measure at all."""

import numpy as np
import pytest

from calstudy.claims.evaluation import evaluate_members, evaluate_run
from calstudy.claims.realizations import PooledResults
from calstudy.experiment.files import validate
from calstudy.experiment.model import PAPERS
from calstudy.power.realizations import QUANTITIES, TRANSFER_QUANTITIES
from calstudy.verdicts.statement import Unevaluated

PAPER = PAPERS.make("calamity2022")
K = 0.04 * np.arange(85) + 0.02
DRAWS = 12
NOISE = 0.03
"""Of the power of one bin, in units of the EoR."""


@pytest.fixture
def pooled(tmp_path):
    """Return a maker of realizations: `make(bias, **means of other quantities)`."""

    def make(bias=0.0, seed=1, layout="mwa-compact-minredundant", **means) -> PooledResults:
        blocks = [{"draw": ["gains", "noise", "eor"], "count": DRAWS}]
        data = {
            "name": "drawn",
            "papers": ["calamity2022"],
            "calibration": {"weights": "flags"},
            "realizations": blocks,
        }
        data["instrument"] = {"layout": layout}
        data["outputs"] = {"figures": []}
        rng, arrays = np.random.default_rng(seed), {}
        for modes in ("outside-wedge", "all-modes"):
            left = NOISE * rng.standard_normal((DRAWS, K.size)) + np.where(K < 0.5, bias, 0)
            arrays |= {f"{modes}.k": K, f"{modes}.bin_edges": np.append(K - 0.02, K[-1] + 0.02)}
            arrays[f"{modes}.eor"] = 7.0 * (1 + 0.05 * rng.standard_normal((DRAWS, K.size)))
            arrays[f"{modes}.input"] = np.full((DRAWS, K.size), 7.0)
            known = {name: np.ones((DRAWS, K.size)) for name in (*QUANTITIES, *TRANSFER_QUANTITIES)}
            known |= {"bias": left, "pull_without_eor": left / NOISE, "ratio": 1 + left}
            known |= {name: value + NOISE * rng.standard_normal((DRAWS, K.size)) for name, value in means.items()}
            arrays |= {f"{modes}.values.{name}": values for name, values in known.items()}
            arrays[f"{modes}.quoted.ratio"] = np.full((DRAWS, K.size), NOISE)
        return PooledResults(validate(data, tmp_path), arrays)

    return make


def verdicts(run: PooledResults) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in evaluate_run([PAPER], run).verdicts}


def test_a_bias_that_one_run_cannot_see_is_seen_over_realizations(pooled, make_study):
    """A bias of the noise of a bin: of few bins one run knows it to its own size, twelve realizations to a third."""
    found = verdicts(pooled(bias=NOISE, seed=2))
    single = {claim.name: claim.verdict for claim in evaluate_run([PAPER], make_study(without_eor_bias=NOISE)).verdicts}
    for name in ("bias-at-level-of-noise-below-0p2", "bias-at-level-of-noise-from-0p2-to-0p5"):
        assert (single[name], found[name]) == ("undecided", "supported")
    assert found["positive-bias-at-small-k"] == "supported"


def test_without_a_bias_realizations_contradict_one_of_the_size_of_the_noise(pooled):
    found = verdicts(pooled())
    # A bias smaller than what was seen is slight, too; one of half the noise is excluded.
    assert found["positive-bias-at-small-k"] == "undecided"
    assert found["bias-at-level-of-noise-from-0p2-to-0p5"] == "contradicted"
    assert verdicts(pooled(bias=-NOISE))["positive-bias-at-small-k"] == "contradicted"


def test_the_power_that_was_put_in_tells_what_the_average_loses(pooled):
    run = pooled()
    assert verdicts(run)["average-loses-nothing"] == "supported"
    for modes in ("outside-wedge", "all-modes"):
        run.arrays[f"{modes}.eor"] *= 0.8
    assert verdicts(run)["average-loses-nothing"] == "contradicted"


@pytest.mark.parametrize(("coherence", "verdict"), [(1.0, "supported"), (0.944, "contradicted")])
def test_loss_far_from_the_wedge_is_that_of_all_realizations(pooled, coherence, verdict):
    assert verdicts(pooled(squared_coherence=coherence))["loss-limited-to-wedge"] == verdict


def test_statements_on_single_runs_are_left_to_them(pooled, make_study):
    run = pooled()
    alone = evaluate_run([PAPER], run)
    needs_two = {"bias-reaches-larger-k"}
    assert {claim.runs for claim in alone.verdicts if claim.name not in needs_two} == {("drawn",)}
    assert "gains-within-20-percent" not in verdicts(run)
    assert evaluate_members([PAPER], {"minimally_redundant": run}).verdicts == alone.verdicts
    runs = {"minimally_redundant": run, "redundant": make_study(redundant_fraction=0.9)}
    together = {item.name: item for item in evaluate_members([PAPER], runs).verdicts}
    assert together["positive-bias-at-small-k"].runs == ("drawn",)
    assert together["gains-within-20-percent"].reason == f"needs {PAPER.roles['minimally_redundant']}"


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [([0.28] * 12, "supported"), ([0.6] * 12, "contradicted"), ([0.2, 0.28, 0.36, 0.4] * 3, "undecided")],
)
def test_where_a_bias_ends_is_known_by_its_scatter_over_realizations(pooled, make_study, ends, verdict):
    name = "bias-with-wedge-ends-near-0p3"
    run = pooled()
    run.arrays["all-modes.values.ratio"] = np.where(np.array(ends)[:, None] > K, 0.5, 1.0)
    found = {claim.name: claim for claim in evaluate_run([PAPER], run).verdicts}[name]
    assert (found.measured, found.uncertainty) == pytest.approx((np.mean(ends), np.std(ends, ddof=1)))
    assert found.verdict == verdict
    single = {claim.name: claim for claim in evaluate_run([PAPER], make_study()).verdicts}[name]
    assert "needs realizations" in single.reason


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [
        # Draws that both arrays share are compared one by one.
        (([0.2, 0.4] * 6, [0.28, 0.48] * 6), "supported"),
        (([0.2, 0.4] * 6, [0.48, 0.28] * 6), "undecided"),
    ],
)
def test_extents_of_two_arrays_differ_beyond_the_scatter_of_draws(pooled, ends, verdict):
    runs = {"minimally_redundant": pooled(), "redundant": pooled(layout="mwa-compact-hex-east")}
    for run, bounds in zip(runs.values(), ends, strict=True):
        run.arrays["outside-wedge.values.ratio"] = np.where(np.array(bounds)[:, None] > K, 0.5, 1.0)
    found = {claim.name: claim for claim in evaluate_members([PAPER], runs).verdicts}["bias-reaches-larger-k"]
    assert found.verdict == verdict


def test_what_is_not_in_the_arrays_is_said(pooled):
    run = pooled()
    with pytest.raises(Unevaluated, match="no modes between k = 7 and 8 h/Mpc"):
        run.mean("bias", "outside-wedge", 7, 8)
    del run.arrays["outside-wedge.values.squared_coherence"]
    assert verdicts(run)["loss-limited-to-wedge"] == "not evaluated"
