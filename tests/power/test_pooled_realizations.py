"""Pooled realizations where the answer is known: means, covariances, coverage, and power corrected by T of others."""

from dataclasses import replace

import numpy as np
import pytest
from realization_samples import BINS, INPUT, LOSS, design_of, draw, transfer_function

from calstudy.power.realizations import (
    correct_realizations,
    coverage,
    error_ratio,
    inside_bars,
    mean_over_bins,
    pool,
    pool_region,
    together,
    transfer_of_others,
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


def draw_terms(shape: tuple[int, ...], variances: dict[tuple[int, ...], float], random: np.random.Generator):
    """Return x = 1 + sum_S f_S of the realizations of blocks that share the first one, and which belong to each block.

    Parameters
    ----------
    shape
        Draws of each block, then bins.
    variances
        Of f_S, by the blocks in S.
    """
    *counts, bins = shape
    numbers = [tuple(0 for _ in counts)]
    members = []
    for block, count in enumerate(counts):
        members.append([0, *range(len(numbers), len(numbers) + count - 1)])
        numbers += [tuple(draw if place == block else 0 for place in range(len(counts))) for draw in range(1, count)]
    values = np.ones((len(numbers), bins))
    for blocks, variance in variances.items():
        drawn: dict[tuple[int, ...], np.ndarray] = {}
        for row, number in enumerate(numbers):
            draws = tuple(number[block] for block in blocks)
            values[row] += drawn.setdefault(draws, np.sqrt(variance) * random.standard_normal(bins))
    return values, members


TERMS = {
    "sum": ((10, 4), {(0,): 1.0, (1,): 1.0}),
    "product": ((10, 4), {(0, 1): 1.0}),
    "both": ((10, 4), {(0,): 0.2, (1,): 0.5, (0, 1): 1.0}),
    "one block has all": ((10, 4), {(0,): 1.0}),
    "product of three": ((6, 5, 4), {(0, 1, 2): 1.0, (1,): 0.5}),
}


@pytest.mark.parametrize(("shape", "variances"), TERMS.values(), ids=TERMS)
def test_blocks_together_have_the_error_and_the_scatter_of_what_was_drawn_in_sum_and_product(shape, variances, random):
    """A product of ten and four draws had an error of 0.59 by sum_b s_b^2 / K_b; its mean was off by 0.84."""
    found = []
    for _ in range(300):
        values, members = draw_terms((*shape, 60), variances, random)
        found.append(together(values, np.ones(values.shape), members))
    deviations = np.array([item.mean - 1 for item in found])
    squares = np.mean([item.error**2 for item in found])
    # 18,000 trials, and s^2 from three degrees of freedom or more in each: a per cent.
    assert deviations.mean() == pytest.approx(0, abs=4 * np.sqrt(squares / deviations.size))
    assert deviations.var() == pytest.approx(squares, rel=0.04)
    # What is counted twice is known to 0.1 from sixty bins, and cut at its limits: this moves the mean by up to 0.05.
    assert np.mean([item.scatter**2 for item in found]) == pytest.approx(sum(variances.values()), rel=0.12)
    assert found[0].covariance.shape == (60, 60)
    assert np.linalg.eigvalsh(found[0].covariance).min() > -1e-9


def test_products_of_two_of_three_blocks_are_not_taken_for_less(random):
    """Their error and scatter are too large, by sqrt(0.507 / 0.174) = 1.7 and sqrt(4/3)."""
    deviations, squares, scatters = [], [], []
    for _ in range(300):
        values, members = draw_terms((6, 5, 4, 60), {(0, 1): 1.0}, random)
        found = together(values, np.ones(values.shape), members)
        deviations.append(found.mean - 1)
        squares.append(found.error**2)
        scatters.append(found.scatter**2)
    assert np.mean(squares) / np.var(deviations) == pytest.approx(0.507 / 0.174, rel=0.06)
    assert np.mean(scatters) == pytest.approx(4 / 3, rel=0.08)


def test_one_block_has_mean_and_error_of_its_realizations(random):
    values = random.standard_normal((7, BINS))
    found, alone = together(values, values, [range(7)]), pool(values, values)
    for name in ("mean", "scatter", "error", "quoted", "covariance"):
        assert getattr(found, name) == pytest.approx(getattr(alone, name))


def test_bars_of_the_right_size_have_pulls_that_scatter_by_one_with_an_error_that_is_right(random):
    """Half of the variance of (P^R - P^S) / sigma is the product of noise and EoR, which every block draws again."""
    design = design_of((("gains", "noise"), 10), (("eor",), 4))
    scatters, means = [], []
    for _ in range(150):
        pooled = pool_region(draw(design, random, np.ones(BINS), 0.0), design)
        scatters.append(np.mean(pooled.total["pull_eor"].scatter ** 2))
        means.append(mean_over_bins(pooled.values["pull_eor"], design)[:2])
    values, errors = np.transpose(means)
    # What is counted twice is known to 0.15 from twenty bins. With it the variance is 1.49.
    assert np.mean(scatters) == pytest.approx(1, abs=0.12)
    # An error of an error from 150 trials: 6 per cent. That of a model without interaction is 25 per cent too small.
    assert values.std() == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.15)


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
            found[kind].append(coverage(inside_bars(rows, np.ones(rows.shape)))[:2])
    values = {kind: np.array(items) for kind, items in found.items()}
    spread = np.sqrt(0.95 * 0.05 / (60 * 6 * BINS))
    assert values["eor"][:, 0].mean() == pytest.approx(0.95, abs=5 * spread)
    assert values["input"][:, 0].mean() >= 0.95
    # The uncertainty is that of a binomial or more.
    assert values["eor"][:, 0].std() < 1.3 * values["eor"][:, 1].mean()


def test_the_uncertainty_of_coverage_knows_of_correlated_bins(random):
    """Bins that all move together are one trial: the scatter over realizations says so, the binomial does not."""
    pulls = np.repeat(random.standard_normal((40, 1)), BINS, axis=1)
    found = coverage(inside_bars(pulls, np.ones(pulls.shape)))
    assert found.uncertainty > 2 * np.sqrt(0.95 * 0.05 / pulls.size)


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
        means.append(mean_over_bins(corrected.power / INPUT, design)[:2])
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


def test_flux_scales_that_differ_leave_the_power_on_the_true_scale_as_it_is(random):
    samples = draw(EVERYTHING, random)
    scales = 1.1 + 0.05 * random.standard_normal(len(samples))
    rescaled = []
    for sample, scale in zip(samples, scales, strict=True):
        residual, found = sample.residual, sample.transfer
        transfer = replace(
            found,
            transfer=found.transfer / scale**2,
            cross_transfer=found.cross_transfer / scale,
            scale_free_transfer=found.transfer,
            flux_scale=scale,
        )
        rescaled.append(replace(sample, residual=replace(residual, power=residual.power / scale**2), transfer=transfer))
    power = correct_realizations(samples, EVERYTHING).power
    assert np.isfinite(power).all()
    assert correct_realizations(rescaled, EVERYTHING).power_known_scale == pytest.approx(power, rel=1e-9)


def test_intervals_about_the_input_cover_it_with_few_modes(random):
    """Skies of twelve modes, no noise, T known: bars that follow the measured power cover in 91 per cent."""
    modes, count = 12.0, 8
    inside, own = [], []
    for _ in range(200):
        eor = INPUT * random.gamma(modes, 1 / modes, size=(count, BINS))
        samples = [
            replace(
                sample,
                residual=replace(sample.residual, power=LOSS * sky + 0j, noise_error=np.zeros(BINS)),
                eor=replace(sample.eor, power=sky + 0j, sample_modes=np.full(BINS, modes)),
                transfer=transfer_function(LOSS, 1e-4),
            )
            for sample, sky in zip(draw(EVERYTHING, random), eor, strict=True)
        ]
        corrected = correct_realizations(samples, EVERYTHING)
        inside.append(inside_bars(corrected.power - INPUT, corrected.error_with_sample))
        own.append(inside_bars(eor - INPUT, eor / np.sqrt(modes)))
    # 32,000 trials know the part to 0.0012. Of a gamma distribution of twelve modes 0.9543 is within 1.96 sigma.
    assert np.mean(inside) == pytest.approx(0.9543, abs=0.004)
    assert np.mean(own) < 0.92


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


def test_where_what_is_left_is_not_the_eor_there_is_a_reason_and_no_number(random):
    """T of 0.6 and more is ten times its error everywhere; C is nothing in two bins, and a fifth of T in three."""
    samples = draw(EVERYTHING, random)
    part = np.where(np.arange(BINS) < 2, 0.0, np.where(np.arange(BINS) < 5, 0.2, 1.0))
    others = [
        replace(sample, transfer=replace(sample.transfer, cross_transfer=part * sample.transfer.transfer))
        for sample in samples
    ]
    corrected = correct_realizations(others, EVERYTHING)
    for array in (corrected.power, corrected.error, corrected.error_with_sample, corrected.power_known_scale):
        assert np.isnan(array[:, :5]).all()
        assert np.isfinite(array[:, 5:]).all()
    assert corrected.reasons[0].startswith("C = 0 is not above 5 times its error, 0.014: ")
    assert "is not above 0.5 T, T = 0.6" in corrected.reasons[4]
    assert set(corrected.reasons[5:]) == {""}


def test_two_realizations_are_too_few_to_correct(random):
    design = design_of((("eor", "gains", "noise"), 2))
    corrected = correct_realizations(draw(design, random), design)
    assert np.isnan(corrected.power).all()
    assert set(corrected.reasons) == {"too few realizations for an error of T"}


def test_a_single_realization_is_not_pooled():
    with pytest.raises(ValueError, match="at least two"):
        pool(np.ones((1, 3)), np.ones((1, 3)))
