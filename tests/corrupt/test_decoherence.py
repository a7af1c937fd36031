"""Loss of packets between boards: what it does to which baseline, and what gains can and cannot take up of it."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.corrupt.effects.losses import Decoherence
from calstudy.corrupt.interface import apply_effect, draw_flags, draw_truth, require_usable
from calstudy.instrument.layouts import size_of_instrument
from calstudy.instrument.telescope import make_template

EFFECT = Decoherence(loss="10 %", block="2 MHz", seed=3)


@pytest.fixture(scope="module")
def observed() -> Observation:
    """Seven antennas on boards 0-2, 3-5 and 6, with autocorrelations; 20 channels of 240 kHz, two polarizations."""
    instrument = small_instrument(channels={"count": 20, "width": "240 kHz"}, polarizations=["xx", "yy"])
    return Observation(make_template(instrument, autos=True))


@pytest.fixture
def sky(observed, rng) -> np.ndarray:
    return rng.normal(size=observed.shape) + 1j * rng.normal(size=observed.shape)


def test_every_baseline_between_boards_loses_what_its_boards_lose_and_no_other_loses_anything(observed, sky):
    truth = draw_truth(EFFECT, observed)
    lost = apply_effect(EFFECT, sky.copy(), observed, truth)
    # A block of 2 MHz is 8 channels of 240 kHz, so that 20 channels have blocks of 8, 8 and 4.
    assert truth["p"].shape == (3, 3)
    assert ((truth["p"] >= 0) & (truth["p"] < 0.1)).all()
    for row, (a, b) in enumerate(observed.antennas.tolist()):
        for channel in range(20):
            left = np.prod([1 - truth["p"][antenna // 3, channel // 8] for antenna in (a, b)])
            expected = sky[:, row, channel] * (1.0 if a // 3 == b // 3 else left)
            np.testing.assert_allclose(lost[:, row, channel], expected, rtol=1e-12)


def test_losses_are_uniform_and_their_size_scales_one_draw():
    instrument = small_instrument(layout={"kind": "hex", "side": 9}, channels={"count": 100, "width": "240 kHz"})
    many = Observation(make_template(instrument))
    found = draw_truth(Decoherence(loss=0.02, per_board=1, block="240 kHz"), many)["p"]
    # 217 boards and 100 blocks: the mean is known to 1 / sqrt(12 N), the standard deviation to about as much.
    assert found.shape == (217, 100)
    assert found.mean() == pytest.approx(0.01, abs=0.02 * 4 / np.sqrt(12 * found.size))
    assert found.std() == pytest.approx(0.02 / np.sqrt(12), rel=0.02)
    rare = draw_truth(Decoherence(loss=0.02, chance=0.1, per_board=1, block="240 kHz"), many)["p"]
    np.testing.assert_array_equal(rare[rare > 0], found[rare > 0])
    # A share of N is known to sqrt(p (1 - p) / N).
    assert (rare > 0).mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / found.size))
    larger = draw_truth(Decoherence(loss=0.2, per_board=1, block="240 kHz"), many)["p"]
    np.testing.assert_allclose(larger, 10 * found, rtol=1e-12)


def test_gains_take_the_loss_up_between_boards_and_then_are_wrong_within(observed, sky):
    """Gains of 1 - p make baselines between boards exact, and those within a board 1 / (1 - p)^2 too large."""
    truth = draw_truth(EFFECT, observed)
    gains = (1 - truth["p"])[truth["board"]][:, np.arange(20) // 8]
    first, second = observed.antennas.T
    products = (gains[first] * gains[second])[:, :, None]
    calibrated = apply_effect(EFFECT, sky.copy(), observed, truth) / products
    within = first // 3 == second // 3
    np.testing.assert_allclose(calibrated[:, ~within], sky[:, ~within], rtol=1e-12)
    np.testing.assert_allclose(calibrated[:, within], sky[:, within] / products[within], rtol=1e-12)
    assert abs(products[within] - 1).max() > 0.1


def test_dropping_flags_the_cross_correlations_within_boards_and_nothing_else(observed):
    truth = draw_truth(EFFECT, observed)
    assert draw_flags(EFFECT, observed, truth) is None
    dropping = EFFECT.model_copy(update={"drop": True})
    flags = np.broadcast_to(draw_flags(dropping, observed, truth), observed.shape)
    expected = [a != b and a // 3 == b // 3 for a, b in observed.antennas.tolist()]
    # Two boards of three antennas have three baselines each, and that of one has none.
    assert sum(expected) == 6
    assert (flags == np.array(expected)[None, :, None, None]).all()
    assert (EFFECT.can_flag, dropping.can_flag) == (False, True)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"per_board": 7}, "0.per_board: 7 antennas are on 1 board, and 2 are needed; per_board must be at most 6"),
        ({"per_board": 6}, None),
        (
            {"per_board": 4, "drop": True},
            "0.per_board: 7 antennas are on 2 boards, and 3 are needed, for baselines between two boards leave open "
            "how their gains compare; per_board must be at most 3",
        ),
        ({"per_board": 3, "drop": True}, None),
    ],
)
def test_too_few_boards_are_refused(settings, told):
    size, effects = size_of_instrument(small_instrument()), [Decoherence(**settings)]
    if told is None:
        require_usable(effects, size)
        return
    with pytest.raises(InputError) as caught:
        require_usable(effects, size)
    assert str(caught.value) == f"corruption.effects.{told}"
