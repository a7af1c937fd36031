"""What gains absorb of a signal, by linear algebra of one channel: the counting that results at full scale are held to.

A gain error moves the data by F (eta_a + eta_b*). A fit of gains to foregrounds projects these directions out of any
small signal; there are 2 N - 1 of them for N antennas.
"""

import itertools

import numpy as np
import pytest
from gain_projection import projector, random

from calstudy.instrument.layouts import make_layout, redundant_groups
from calstudy.instrument.settings import MwaLayout


@pytest.mark.parametrize("antennas", [10, 36])
def test_gains_leave_of_independent_signals_what_counting_says(antennas):
    pairs = np.array(list(itertools.combinations(range(antennas), 2)))
    left = projector(pairs, random(np.random.default_rng(1), len(pairs)))
    expected = 1 - (2 * antennas - 1) / (antennas * (antennas - 1))
    assert np.trace(left) / len(left) == pytest.approx(expected, abs=1e-9)


def test_on_a_hexagon_baselines_retain_more_and_pairs_of_different_baselines_less():
    """The eastern hexagon, foregrounds of equal strength and signal common to each group.

    With themselves baselines retain more than on an array without redundancy. Crossed with others of their group they
    retain less than with themselves: crossing does not avoid the loss.
    """
    layout = make_layout(MwaLayout(kind="mwa-compact-hex-east"))
    pairs = np.array(list(itertools.combinations(range(len(layout.enu)), 2)))
    groups = redundant_groups(layout.enu[pairs[:, 1]] - layout.enu[pairs[:, 0]], 0.5)
    pairs[groups.conjugated] = pairs[groups.conjugated, ::-1]
    same = (groups.index[:, None] == groups.index).astype(float)
    others = same - np.eye(len(pairs))
    for seed in range(3):
        left = projector(pairs, random(np.random.default_rng(seed), groups.index.max() + 1)[groups.index])
        covariance = left @ np.kron(np.eye(2), same) @ left
        power = covariance[: len(pairs), : len(pairs)] + covariance[len(pairs) :, len(pairs) :]
        by_themselves, crossed = np.trace(power) / (2 * len(pairs)), np.sum(power * others) / (2 * others.sum())
        # Without redundancy 1 - 71 / (36 * 35) = 0.944 is left.
        assert by_themselves > 0.95
        assert crossed < by_themselves - 0.005
