"""Gains of coarse channels: the passband of the MWA in each of them, and levels of their own."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument
from pydantic import ValidationError

from calstudy.base.observation import Observation
from calstudy.corrupt.effects.gains import CoarseChannels
from calstudy.corrupt.interface import draw_truth
from calstudy.instrument.layouts import size_of_instrument
from calstudy.instrument.telescope import make_template

COARSE = 1.28e6
FIRST = 130
"""Centred at 166.4 MHz, as are the MWA's."""
N_COARSE = 3


def instrument(width: float, n_antennas: int = 2, shift: float = 0.0):
    """Return an instrument with three whole coarse channels, but for a shift of its channels, all in Hz."""
    first = (FIRST - 0.5) * COARSE + width / 2 + shift
    count = round(N_COARSE * COARSE / width)
    return small_instrument(
        layout={"kind": "linear", "count": n_antennas},
        channels={"first": f"{first} Hz", "width": f"{width} Hz", "count": count},
        times={"count": 1},
        polarizations=["xx", "yy"],
    )


def drawn(width: float, n_antennas: int = 2, shift: float = 0.0, **settings: object) -> np.ndarray:
    """Return gains, (Nants, Npols, Nfreqs)."""
    observed = Observation(make_template(instrument(width, n_antennas, shift)))
    gains = draw_truth(CoarseChannels(**settings), observed)["gains"]
    assert gains.shape == (n_antennas, observed.n_channels, 1, 2)
    assert not gains.imag.any()
    return np.moveaxis(gains.real[:, :, 0], 1, -1)


@pytest.mark.parametrize("width", [40e3, 80e3, 160e3, 320e3])
def test_all_antennas_have_the_same_passband_in_every_coarse_channel(width):
    gains = drawn(width, level_scatter=0.0)
    passbands = gains.reshape(2, 2, N_COARSE, -1)
    assert passbands == pytest.approx(np.broadcast_to(passbands[0, 0, 0], passbands.shape), rel=1e-9)
    assert passbands == pytest.approx(passbands[..., ::-1], rel=1e-9)
    assert gains.min() > np.sqrt(0.5)


def test_the_passband_is_that_by_which_the_mwa_corrects_its_data():
    power = drawn(80e3, level_scatter=0.0)[0, 0, :8] ** 2
    # From the coefficients of the filter, in Birli (PFB_JAKE_2022_200HZ), averaged over 80 kHz from the lower edge.
    expected = [0.5461, 0.7510, 0.9382, 1.0006, 1.0014, 1.0011, 1.0030, 1.0009]
    assert power == pytest.approx(expected, abs=1e-3)


def test_a_channel_has_the_mean_power_of_its_parts_wherever_coarse_channels_end():
    # A quarter of every fourth channel lies in another coarse channel than the rest.
    wide, fine = (drawn(width, level_scatter=0.0, shift=shift) for width, shift in ((320e3, -80e3), (40e3, -80e3)))
    assert wide**2 == pytest.approx(np.mean(fine.reshape(2, 2, -1, 8) ** 2, axis=-1), rel=1e-9)
    assert np.isfinite(wide).all()
    assert wide.min() > np.sqrt(0.5)


def test_levels_differ_between_coarse_channels_antennas_and_polarizations():
    ratios = drawn(160e3, 60, level_scatter=0.1) / drawn(160e3, 60, level_scatter=0.0)
    ratios = ratios.reshape(60, 2, N_COARSE, -1)
    levels = ratios[..., 0] - 1
    assert ratios == pytest.approx(np.broadcast_to(ratios[..., :1], ratios.shape), rel=1e-9)
    # 360 uniform draws.
    assert np.sqrt(np.mean(levels**2)) == pytest.approx(0.1, rel=0.1)
    assert abs(levels).max() <= 0.1 * np.sqrt(3)
    assert abs(np.mean(levels)) < 5 * 0.1 / np.sqrt(levels.size)
    for products in (levels[1:] * levels[:-1], levels[:, 0] * levels[:, 1], levels[..., 1:] * levels[..., :-1]):
        assert abs(np.mean(products)) < 5 * 0.1**2 / np.sqrt(products.size)


def test_shapes_of_antennas_differ_by_a_factor_of_the_passband_in_decibel():
    common = np.log(drawn(40e3, level_scatter=0.0)[0, 0])
    logarithms = np.log(drawn(40e3, 60, level_scatter=0.0, shape_scatter=0.1))
    slopes = logarithms @ common / (common @ common)
    assert logarithms == pytest.approx(slopes[..., None] * common, abs=1e-9)
    # 120 normal draws.
    assert np.std(slopes - 1) == pytest.approx(0.1, rel=0.25)
    assert abs(np.mean(slopes - 1)) < 5 * 0.1 / np.sqrt(slopes.size)


def test_the_same_seed_draws_the_same_and_the_shape_does_not_change_the_levels():
    assert np.array_equal(drawn(80e3), drawn(80e3))
    assert not np.allclose(drawn(80e3), drawn(80e3, seed=18))
    # At the centre the passband is one, whatever its exponent.
    centre = slice(7, None, 16)
    assert drawn(80e3, shape_scatter=0.1)[..., centre] == pytest.approx(drawn(80e3)[..., centre], rel=1e-3)


def test_channels_that_are_too_wide_for_the_passband_are_refused():
    def refusal(width: str) -> str | None:
        return CoarseChannels().refusal(size_of_instrument(small_instrument(channels={"width": width})))

    assert refusal("426.6667 kHz") is None
    told = "width: 1.28 MHz: a coarse channel holds 2 channels of 0.64 MHz; its passband takes at least 3"
    assert refusal("640 kHz") == told
    with pytest.raises(ValidationError, match="less than or equal to"):
        CoarseChannels(level_scatter="60 %")
