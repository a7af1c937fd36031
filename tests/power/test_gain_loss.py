"""What gains absorb of a signal, by linear algebra of one channel: the counting that results at full scale are held to.

A gain error moves the data by F (eta_a + eta_b*). A fit of gains to foregrounds projects these directions out of any
small signal; there are 2 N - 1 of them for N antennas.
"""

import itertools

import numpy as np
import pytest
from gain_projection import projector, random

from calstudy.instrument.array_layouts.geometric import HexLayout
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.layouts import ArrayLayout, make_layout, redundant_groups


@pytest.mark.parametrize("antennas", [10, 36])
def test_gains_leave_of_independent_signals_what_counting_says(antennas):
    pairs = np.array(list(itertools.combinations(range(antennas), 2)))
    left = projector(pairs, random(np.random.default_rng(1), len(pairs)))
    expected = 1 - (2 * antennas - 1) / (antennas * (antennas - 1))
    assert np.trace(left) / len(left) == pytest.approx(expected, abs=1e-9)


def oriented_pairs(settings: ArrayLayout) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of antennas, those of a redundant group all in one direction, and the group of each."""
    layout = make_layout(settings)
    pairs = np.array(list(itertools.combinations(range(len(layout.enu)), 2)))
    groups = redundant_groups(layout.enu[pairs[:, 1]] - layout.enu[pairs[:, 0]], 0.5)
    pairs[groups.conjugated] = pairs[groups.conjugated, ::-1]
    return pairs, groups.index


def left_of_groups(left: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Return the covariance of what a projector leaves of signals that are common to groups, (Npairs, Npairs)."""
    covariance = left @ np.kron(np.eye(2), same) @ left.T
    half = len(same)
    return covariance[:half, :half] + covariance[half:, half:]


def test_on_a_hexagon_baselines_retain_more_and_pairs_of_different_baselines_less():
    """The eastern hexagon, foregrounds of equal strength and signal common to each group.

    With themselves baselines retain more than on an array without redundancy. Crossed with others of their group they
    retain less than with themselves: crossing does not avoid the loss.
    """
    pairs, group = oriented_pairs(MwaLayout(kind="mwa-compact-hex-east"))
    same = (group[:, None] == group).astype(float)
    others = same - np.eye(len(pairs))
    for seed in range(3):
        power = left_of_groups(projector(pairs, random(np.random.default_rng(seed), group.max() + 1)[group]), same)
        by_themselves, crossed = np.trace(power) / (2 * len(pairs)), np.sum(power * others) / (2 * others.sum())
        # Without redundancy 1 - 71 / (36 * 35) = 0.944 is left.
        assert by_themselves > 0.95
        assert crossed < by_themselves - 0.005


def test_a_hexagon_of_19_retains_more_than_counting_says():
    """Each baseline with itself, gains that scatter by 0.1. Calibrated simulations have 0.930 +- 0.009."""
    pairs, group = oriented_pairs(HexLayout(kind="hex", side=3))
    same = (group[:, None] == group).astype(float)
    kept, power = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        foregrounds, gains = random(rng, group.max() + 1)[group], 1 + 0.1 * random(rng, 19)
        weights = np.abs(gains[pairs[:, 0]] * gains[pairs[:, 1]]) ** 2
        kept.append(np.trace(left_of_groups(projector(pairs, foregrounds), same)) / (2 * len(pairs)))
        power.append(np.trace(left_of_groups(projector(pairs, foregrounds, weights), same)) / (2 * len(pairs)))
    # Counting has 1 - 37 / (19 * 18) = 0.892. Single draws scatter by 0.002 and 0.003.
    assert np.mean(kept) == pytest.approx(0.913, abs=0.003)
    assert np.mean(power) == pytest.approx(0.917, abs=0.005)


def test_weights_of_uneven_gains_leave_the_signal_that_counting_says_and_leak_power_besides():
    """The fit is orthogonal with weights |g_a g_b*|^2, power spectra have flat ones.

    With <S* S> = 1, C = trace / dimension and T = sum of squares / dimension. The full-scale study has 0.0041 +- 0.0002
    for T s^2 - C^2 / T far from the wedge, with gains of this scatter.
    """
    pairs = np.array(list(itertools.combinations(range(36), 2)))
    counted = 1 - 71 / (36 * 35)
    excess = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        gains = 1 + 0.1 * random(rng, 36)
        left = projector(pairs, random(rng, len(pairs)), np.abs(gains[pairs[:, 0]] * gains[pairs[:, 1]]) ** 2)
        kept, power = np.trace(left) / len(left), np.sum(left**2) / len(left)
        assert kept == pytest.approx(counted, abs=1e-9)
        assert power > counted + 0.001
        excess.append(power - kept**2 / power)
    assert np.mean(excess) == pytest.approx(0.0041, abs=0.001)
