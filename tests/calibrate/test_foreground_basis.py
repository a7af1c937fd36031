"""The DPSS basis holds band-limited foregrounds and refuses what the channels cannot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.constants import speed_of_light
from toy import BASIS, FREQUENCIES

from calstudy.base.errors import InputError
from calstudy.calibrate.basis import delay_half_widths, make_basis, require_room
from calstudy.calibrate.settings import BasisSettings


def test_half_widths_follow_the_horizon_and_are_rounded_up():
    settings = BasisSettings(buffer="50 ns", min_delay="100 ns", delay_step="10 ns")
    lengths = speed_of_light * np.array([0, 50e-9, 100e-9, 201e-9, 300e-9])
    assert delay_half_widths(lengths, settings) == pytest.approx([150e-9, 150e-9, 150e-9, 260e-9, 350e-9])


def test_every_model_is_in_one_bucket_with_an_orthonormal_basis():
    lengths = np.random.default_rng(0).uniform(0, 60, 40)
    basis = make_basis(lengths, FREQUENCIES, BASIS)
    assert np.array_equal(np.sort(np.concatenate([bucket.members for bucket in basis.buckets])), np.arange(40))
    for bucket in basis.buckets:
        gram = bucket.vectors.T @ bucket.vectors
        assert np.abs(gram - np.eye(len(gram))).max() < 1e-10
    assert basis.n_coefficients == sum(b.members.size * b.vectors.shape[1] for b in basis.buckets)


@pytest.mark.parametrize("fraction", [0.0, 0.5, -0.9])
def test_tones_within_the_half_width_are_held_and_others_are_not(fraction):
    (bucket,) = make_basis(np.array([30.0]), FREQUENCIES, BASIS).buckets

    def misfit(delay):
        tone = np.exp(2j * np.pi * FREQUENCIES * delay)
        return np.linalg.norm(tone - bucket.vectors @ (bucket.vectors.T @ tone)) / np.sqrt(FREQUENCIES.size)

    assert misfit(fraction * bucket.half_width) < 1e-4
    assert misfit(3 * bucket.half_width) > 0.9


def test_autocorrelations_get_the_minimum_delay():
    (bucket,) = make_basis(np.array([0.0]), FREQUENCIES, BASIS).buckets
    assert bucket.half_width == pytest.approx(100e-9)


@pytest.mark.parametrize(
    ("length", "frequencies", "settings", "match"),
    [
        (400.0, FREQUENCIES, BASIS, "fills all 64 channels of 400 kHz"),
        (340.0, FREQUENCIES, BASIS, "fills all 64 channels"),
        (30.0, FREQUENCIES + 150e3 * (np.arange(64) > 30), BASIS, "on an even grid"),
        (30.0, FREQUENCIES[:1], BASIS, "on an even grid"),
        (30.0, np.full(2, 160e6), BASIS, "on an even grid"),
        (0.0, FREQUENCIES, BasisSettings(min_delay="0 ns", buffer="0 ns"), "half-width is 0 s"),
    ],
)
def test_impossible_bases_are_refused(length, frequencies, settings, match):
    with pytest.raises(ValueError, match=match):
        make_basis(np.array([length]), frequencies, settings)
    with pytest.raises(ValueError, match=match):
        require_room(length, frequencies, settings)


@pytest.mark.parametrize("used", [np.ones(64, bool), np.arange(64) % 8 > 1])
def test_room_is_found_where_a_basis_can_be_made(used):
    """The short cut, that fewer sequences than channels are asked for, agrees with making them."""

    def refused(check, length):
        try:
            check(length)
        except InputError as error:
            return str(error)
        return ""

    answers = []
    for length in np.linspace(0, 400, 41):
        made = refused(lambda length: make_basis(np.array([length]), FREQUENCIES[used], BASIS), length)
        planned = refused(lambda length: require_room(length, FREQUENCIES[used], BASIS), length)
        assert planned == (made and f"{made} (the longest baseline has {length:.0f} m)")
        answers.append(made)
    assert answers[0] == "" != answers[-1]
