"""Pooled realizations where the answer is known: means, covariances, coverage, and power corrected by T of others."""

from dataclasses import replace

import numpy as np
import pytest
from realization_samples import BINS, INPUT, LOSS, design_of, draw, transfer_function

from calstudy.power.corrected import correct_realizations, transfer_of_others
from calstudy.power.realizations import (
    coverage,
    error_ratio,
    inside_bars,
    mean_over_bins,
    pool,
    pool_region,
    together,
)

EVERYTHING = design_of((("eor", "gains", "noise"), 8))
TWO_BLOCKS = design_of((("gains", "noise"), 7), (("eor",), 6))


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(8)


def test_pooling_finds_mean_scatter_and_covariance(random):
    truth = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, -0.5], [0.0, -0.5, 0.5]])
    values = random.multivariate_normal([1, 2, 3], truth, size=20_000)
    found = pool(values, np.full(values.shape, 0.7))
    # The standard error of a covariance is at most 2 / sqrt(20,000) = 0.014 here.
    assert found.covariance == pytest.approx(truth, abs=0.06)
    assert found.scatter == pytest.approx(np.sqrt(np.diagonal(truth)), rel=0.02)
    assert np.abs(found.mean - [1, 2, 3]).max() < 4 * found.error.max()
    assert found.error == pytest.approx(found.scatter / np.sqrt(20_000))
    assert found.quoted == pytest.approx(np.full(3, 0.7))
    assert found.correlation[0, 1] == pytest.approx(0.6 / np.sqrt(2), abs=0.03)


def test_two_blocks_together_have_the_scatter_and_the_error_of_everything_that_was_drawn(random):
    """x = 1 + a + b, a drawn in one block and b in the other, both fixed at their first draw elsewhere."""
    errors, deviations, scatters = [], [], []
    for _ in range(3000):
        a, b = 0.3 * random.standard_normal(5), 0.2 * random.standard_normal(4)
        blocks = [pool((1 + values)[:, None], np.ones((values.size, 1))) for values in (a + b[0], b + a[0])]
        found = together(blocks, np.array([1 + a[0] + b[0]]))
        deviations.append(found.mean[0] - 1)
        errors.append(found.error[0] ** 2)
        scatters.append(found.scatter[0] ** 2)
    expected = 0.3**2 / 5 + 0.2**2 / 4
    assert np.mean(deviations) == pytest.approx(0, abs=4 * np.sqrt(expected / 3000))
    # 3000 draws of few degrees of freedom: 2 to 3 per cent.
    assert np.var(deviations) == pytest.approx(expected, rel=0.12)
    assert np.mean(errors) == pytest.approx(expected, rel=0.06)
    assert np.mean(scatters) == pytest.approx(0.3**2 + 0.2**2, rel=0.06)


@pytest.mark.parametrize("design", [EVERYTHING, TWO_BLOCKS], ids=["one block", "two blocks"])
def test_right_error_bars_cover_what_they_should(design, random):
    """Without loss, the bars of P^R - P^S are exact; those against the input are the paper's sum, which is larger."""
    found = {"eor": [], "input": []}
    for _ in range(60):
        samples = draw(design, random, np.ones(BINS), 0.0)
        pooled = pool_region(samples, design)
        for kind in found:
            pulls = pooled.values[f"pull_{kind}"]
            place = design.block_of("noise" if kind == "eor" else "eor")
            rows = pulls[list(design.blocks[place][1])]
            found[kind].append(coverage(inside_bars(rows, np.ones(rows.shape)), independent=True))
    values = {kind: np.array(items) for kind, items in found.items()}
    spread = np.sqrt(0.95 * 0.05 / (60 * 6 * BINS))
    assert values["eor"][:, 0].mean() == pytest.approx(0.95, abs=5 * spread)
    assert values["input"][:, 0].mean() >= 0.95
    # The uncertainty is that of a binomial or more.
    assert values["eor"][:, 0].std() < 1.3 * values["eor"][:, 1].mean()


def test_the_uncertainty_of_coverage_knows_of_correlated_bins(random):
    """Bins that all move together are one trial: the scatter over realizations says so, the binomial does not."""
    pulls = np.repeat(random.standard_normal((40, 1)), BINS, axis=1)
    found = coverage(inside_bars(pulls, np.ones(pulls.shape)), independent=True)
    assert found.uncertainty > 2 * np.sqrt(0.95 * 0.05 / pulls.size)
    same = np.repeat(random.standard_normal((1, BINS)), 40, axis=0)
    repeated = coverage(inside_bars(same, np.ones(same.shape)), independent=False)
    assert repeated.uncertainty == pytest.approx(np.sqrt(0.95 * 0.05 / BINS))


def test_errors_that_are_too_small_are_found_out(random):
    values = random.standard_normal((400, BINS))
    right = error_ratio(values, np.ones(values.shape))
    assert right.value == pytest.approx(1, abs=4 * right.uncertainty)
    # 1 / sqrt(2 x 399 x 20), for independent bins.
    assert right.uncertainty == pytest.approx(0.0079, rel=0.3)
    assert error_ratio(values, np.full(values.shape, 0.5)).value == pytest.approx(2 * right.value)
    assert np.isnan(error_ratio(values[:2], np.ones((2, BINS))).value)


def test_realizations_are_corrected_by_those_of_other_gains_and_noise():
    assert EVERYTHING.others(3) == dict.fromkeys([0, 1, 2, 4, 5, 6, 7], 1 / 7)
    assert [EVERYTHING.shared(3, other) for other in (0, 1)] == [0, 0]
    # Gains and noise 1 to 6 are in one realization each, and those of the first in all of other skies (7 to 11).
    sixth = {number: pytest.approx(1 / 6) for number in (1, 2, 3, 4, 5, 6)}
    assert TWO_BLOCKS.others(9) == TWO_BLOCKS.others(0) == sixth
    first = dict.fromkeys((0, 7, 8, 9, 10, 11), pytest.approx(1 / 36))
    assert TWO_BLOCKS.others(2) == {number: share for number, share in sixth.items() if number != 2} | first
    assert TWO_BLOCKS.shared(0, 1) == 1
    skies = design_of((("eor",), 3))
    assert skies.others(1) == {0: 0.5, 2: 0.5}


@pytest.mark.parametrize("design", [EVERYTHING, TWO_BLOCKS], ids=["one block", "two blocks"])
def test_how_far_t_is_from_that_of_others_is_foretold(design, random):
    squares, foretold = [], []
    for _ in range(200):
        values = np.stack([sample.transfer.transfer for sample in draw(design, random, scatter=0.03)]) / LOSS
        mean, error = transfer_of_others(values, design)
        squares.append((values - mean) ** 2)
        foretold.append(error**2)
    # For each realization: 4000 trials of few degrees of freedom.
    assert np.mean(foretold, axis=(0, 2)) == pytest.approx(np.mean(squares, axis=(0, 2)), rel=0.12)


@pytest.mark.parametrize("design", [EVERYTHING, TWO_BLOCKS], ids=["one block", "two blocks"])
def test_corrected_power_is_the_input_on_average_and_its_intervals_cover(design, random):
    means, covers = [], {"eor": [], "input": []}
    for _ in range(60):
        samples = draw(design, random)
        corrected = correct_realizations(samples, design)
        assert np.isfinite(corrected.power).all()
        means.append(mean_over_bins(corrected.power / INPUT, design))
        eor = np.stack([sample.eor.power.real for sample in samples])
        covers["eor"].append(np.nanmean(inside_bars(corrected.power - eor, corrected.error)))
        covers["input"].append(np.nanmean(inside_bars(corrected.power - INPUT, corrected.error_with_sample)))
    values, errors = np.transpose(means)
    assert values.mean() == pytest.approx(1, abs=4 * values.std() / np.sqrt(60))
    assert values.std() == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.35)
    # Few realizations give T's error: the intervals are those of Student's t, taken for Gaussian.
    assert np.mean(covers["eor"]) == pytest.approx(0.95, abs=0.015)
    assert np.mean(covers["input"]) == pytest.approx(0.95, abs=0.015)
    # Without the correction, the same data are 22 per cent below the input.
    assert np.mean([sample.residual.power.real.mean() for sample in samples]) < 0.85 * INPUT


def test_t_of_other_realizations_is_unbiased_where_that_of_the_same_one_is_not(random):
    """T that has half of the noise of P^R in it: P^R / T is too low by about (1/2 - 1/4) of the noise's variance."""
    noise = 0.3
    same, others = [], []
    for _ in range(300):
        relative = noise * random.standard_normal((8, BINS))
        transfer = 0.8 * (1 + relative / 2)
        power = 0.8 * INPUT * (1 + relative)
        mean, _ = transfer_of_others(transfer, EVERYTHING)
        same.append(np.mean(power / transfer) / INPUT)
        others.append(np.mean(power / mean) / INPUT)
    error = np.std(same) / np.sqrt(300)
    assert np.mean(same) == pytest.approx(1 - noise**2 / 4, abs=0.003)
    assert 1 - np.mean(same) > 10 * error
    # Dividing by a mean of seven leaves the square of its error, a quarter of the noise's variance over seven.
    assert np.mean(others) == pytest.approx(1 + noise**2 / 28, abs=0.003)


def test_where_t_is_too_small_there_is_a_reason_and_no_number(random):
    loss = np.where(np.arange(BINS) < 5, 0.01, LOSS)
    samples = draw(EVERYTHING, random, loss)
    noisy = [replace(sample, transfer=transfer_function(sample.transfer.transfer, 0.02)) for sample in samples]
    corrected = correct_realizations(noisy, EVERYTHING)
    for array in (corrected.power, corrected.error, corrected.error_with_sample):
        assert np.isnan(array[:, :5]).all()
        assert np.isfinite(array[:, 5:]).all()
    assert corrected.reasons[0] == "T = 0.01 is not above 5 times its error, 0.02"
    assert set(corrected.reasons[5:]) == {""}


def test_two_realizations_are_too_few_to_correct(random):
    design = design_of((("eor", "gains", "noise"), 2))
    corrected = correct_realizations(draw(design, random), design)
    assert np.isnan(corrected.power).all()
    assert set(corrected.reasons) == {"too few realizations for an error of T"}


def test_bins_that_differ_are_refused(random):
    first, second = draw(EVERYTHING, random)[:2]
    other = replace(second.eor, bin_edges=second.eor.bin_edges + 0.01)
    with pytest.raises(ValueError, match="different bins"):
        pool_region([first, replace(second, eor=other)], EVERYTHING)
    with pytest.raises(ValueError, match="at least two"):
        pool(np.ones((1, 3)), np.ones((1, 3)))
