"""Errors of sums over baselines that share antennas: Monte Carlo against the scatter of many draws."""

import itertools

import numpy as np
import pytest
from gain_projection import projector, random

from calstudy.power.clusters import Clusters, clusters_in_k
from calstudy.power.delay import delays
from calstudy.power.spectra import DelaySpectra, skies

ANTENNAS = 16
PAIRS = np.array(list(itertools.combinations(range(ANTENNAS), 2)))
DRAWS = 200


def spectra(power: np.ndarray, **shares: np.ndarray) -> DelaySpectra:
    """Spectra of given power, (Nu, Nd), at arbitrary delays."""
    units, count = power.shape
    return DelaySpectra(
        power=power.astype(complex), vectors=shares.pop("vectors", np.ones((units, 3))),
        n_pairs=shares.pop("n_pairs", np.ones(units, int)),
        n_polarizations=1, delay=delays(count, 1e5), k_perp=np.ones(units), k_parallel=np.arange(count) - count // 2,
        frequency=180e6, omega_pp=0.1, taper="none", **shares,
    )  # fmt: skip


def of_baselines(power: np.ndarray, pairs: np.ndarray = PAIRS, **more: np.ndarray) -> DelaySpectra:
    """Spectra of each baseline crossed with itself."""
    units = np.repeat(np.arange(len(pairs)), 2)
    return spectra(
        power,
        share_unit=units,
        share_antenna=pairs.ravel(),
        share_pairs=np.ones(units.size, int),
        share_power=power[units].astype(complex),
        **more,
    )


def mean_and_error(found: DelaySpectra) -> tuple[float, float]:
    bins = np.zeros(found.power.shape, int)
    clusters = Clusters.of(found, bins, np.broadcast_to(np.arange(len(bins))[:, None], bins.shape), 1)
    value, error = clusters.powers(found).ratio(clusters.counts)
    return float(value[0]), float(error[0])


def quoted_over_true(draws: list[tuple[float, float]]) -> float:
    values, errors = np.array(draws).T
    return float(np.sqrt(np.mean(errors**2)) / values.std(ddof=1))


# The standard deviation of DRAWS normal values is known to 1 / sqrt(2 DRAWS) = 5 %; limits are four times that.
AGREE = pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("shared", [0.0, 1.0, 3.0])
def test_errors_are_the_scatter_of_draws_whatever_antennas_share(shared):
    draws = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        antenna = shared * rng.normal(size=(ANTENNAS, 1))
        draws.append(mean_and_error(of_baselines(antenna[PAIRS].sum(axis=1) + rng.normal(size=(len(PAIRS), 3)))))
    assert quoted_over_true(draws) == AGREE
    assert np.mean([value for value, _ in draws]) == pytest.approx(
        0, abs=4 * np.std([d[0] for d in draws]) / np.sqrt(DRAWS)
    )


def test_the_scatter_of_baselines_alone_understates_what_antennas_share():
    draws = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        antenna = rng.normal(size=(ANTENNAS, 1))
        draws.append(mean_and_error(spectra(antenna[PAIRS].sum(axis=1) + rng.normal(size=(len(PAIRS), 3)))))
    assert quoted_over_true(draws) < 0.6


def test_one_number_per_baseline_has_the_error_of_a_spectrum_of_one_delay():
    """Four antennas have baselines to all, the others to these alone: without one of the four more is missing."""
    pairs = PAIRS[PAIRS[:, 0] < 4]
    rng = np.random.default_rng(2)
    found = of_baselines(rng.normal(size=(ANTENNAS, 1))[pairs].sum(axis=1) + rng.normal(size=(len(pairs), 1)), pairs)
    clusters = Clusters.of_baselines(pairs)
    value, error = clusters.powers(found).ratio(clusters.counts)
    assert (value[0], error[0]) == pytest.approx(mean_and_error(found), rel=1e-12)


@pytest.mark.parametrize("shared", [0.0, 3.0])
def test_errors_of_redundant_groups_hold_what_the_sky_and_what_antennas_do(shared):
    """Groups of baselines on a ring of antennas; every group has a sky of its own."""
    crossed = []
    for group in range(1, ANTENNAS // 2):
        members = [(antenna, (antenna + group) % ANTENNAS) for antenna in range(ANTENNAS)]
        crossed += [(group - 1, *first, *second) for first, second in itertools.permutations(members, 2)]
    unit, antennas = np.array(crossed)[:, 0], np.array(crossed)[:, 1:]
    contains = np.stack([(antennas == antenna).any(axis=1) for antenna in range(ANTENNAS)])
    groups = unit.max() + 1
    share_unit, share_antenna = (axis.ravel() for axis in np.indices((groups, ANTENNAS)))
    n_pairs = np.bincount(unit)
    share_pairs = np.stack([np.bincount(unit, row) for row in contains], axis=1).astype(int).ravel()
    draws = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        pair = rng.normal(size=groups)[unit] + shared * rng.normal(size=ANTENNAS) @ contains
        power = (np.bincount(unit, pair) / n_pairs)[:, None]
        share = np.stack([np.bincount(unit, pair * row) for row in contains], axis=1).ravel()[:, None]
        found = spectra(
            power, n_pairs=n_pairs, share_unit=share_unit, share_antenna=share_antenna, share_pairs=share_pairs,
            share_power=share.astype(complex),
        )  # fmt: skip
        draws.append(mean_and_error(found))
    assert quoted_over_true(draws) == AGREE


@pytest.mark.parametrize(("sky", "shared"), [(1.0, 0.0), (1.0, 1.0), (0.0, 0.0)])
def test_redundant_baselines_that_are_not_crossed_see_one_sky(sky, shared):
    """Baselines of a ring of antennas, each with itself: those of a group have a sky in common, not their noise."""
    first, steps = (axis.ravel() for axis in np.indices((ANTENNAS, ANTENNAS // 2 - 1)))
    pairs = np.stack([first, (first + steps + 1) % ANTENNAS], axis=1)
    # Half of them are written from the other end, and all are off by a centimetre.
    signs = np.where(first % 2, 1, -1)
    vectors = (14.0 * signs * (steps + 1))[:, None] * np.array([1.0, 0.0, 0.0])
    vectors += np.random.default_rng(3).normal(scale=0.01, size=vectors.shape)
    draws, alone = [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        power = sky * rng.normal(size=(ANTENNAS // 2, 3))[steps] + shared * rng.normal(size=(ANTENNAS, 1))[pairs].sum(
            axis=1
        )
        found = of_baselines(power + rng.normal(size=power.shape), pairs, vectors=vectors)
        clusters = clusters_in_k(found, np.array([0.0, 10.0]), 0.0, inside=False)
        assert clusters.n_samples == ANTENNAS // 2 - 1
        value, error = clusters.powers(found).ratio(clusters.counts)
        draws.append((float(value[0]), float(error[0])))
        alone.append(mean_and_error(found))
    number, opposite = skies(found)
    assert len(set(zip(number.tolist(), steps.tolist(), strict=True))) == ANTENNAS // 2 - 1
    assert np.array_equal(opposite, signs != signs[np.unique(number, return_index=True)[1]][number])
    assert quoted_over_true(draws) == AGREE
    # Where antennas scatter as well, less is missing.
    assert quoted_over_true(alone) < (1.2 if not sky else 0.9 if shared else 0.5)


@pytest.mark.parametrize(("part", "most"), [(0.3, 1.4), (1.0, 3.0)])
def test_errors_of_a_linear_calibration_cover_the_scatter_of_many_skies(part, most):
    """Gains of one channel fitted to foregrounds absorb a signal: T = 1 - (2 N - 1) / (N (N - 1)) in the mean.

    Of all baselines together the loss is fixed by counting, which the scatter of baselines does not know: there the
    errors are too large. In bins that hold a part of the baselines they are about right.
    """
    rng = np.random.default_rng(1)
    draws = []
    for _ in range(DRAWS // 2):
        left = projector(PAIRS, random(rng, len(PAIRS)))
        signal = rng.normal(size=(2 * len(PAIRS), 40)) * np.tile(rng.random(len(PAIRS)) < part, 2)[:, None]
        response = left @ signal
        response[signal == 0] = 0
        powers = [found[: len(PAIRS)] ** 2 + found[len(PAIRS) :] ** 2 for found in (response, signal)]
        both = [of_baselines(power) for power in powers]
        bins = np.zeros(powers[0].shape, int)
        clusters = Clusters.of(both[0], bins, np.broadcast_to(np.arange(len(PAIRS))[:, None], bins.shape), 1)
        value, error = clusters.powers(both[0]).ratio(clusters.powers(both[1]))
        draws.append((float(value[0]), float(error[0])))
    if part == 1:
        expected = 1 - (2 * ANTENNAS - 1) / (ANTENNAS * (ANTENNAS - 1))
        values = [value for value, _ in draws]
        assert np.mean(values) == pytest.approx(expected, abs=4 * np.std(values) / np.sqrt(len(values)))
    assert 0.8 < quoted_over_true(draws) < most


def test_bins_of_one_sample_have_no_error_and_empty_ones_no_value():
    found = of_baselines(np.ones((len(PAIRS), 4)))
    bins = np.full(found.power.shape, -1)
    bins[0] = 0
    clusters = Clusters.of(found, bins, np.broadcast_to(np.arange(len(bins))[:, None], bins.shape), 2)
    value, error = clusters.powers(found).ratio(clusters.counts)
    assert value[0] == 1
    assert np.isnan([value[1], *error]).all()
