"""Redundant calibration as a start: gains up to what redundancy cannot know, and flags without influence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, HEX, make_toy, scattered
from toy_data import ONE_SOLVE, make_uvdata, sky_of

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.calibrate.calibrators.least_squares import CalamityRedundant
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.preparation import prepare
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import BasisSettings, FlagWeights, RedundantStart
from calstudy.instrument.layouts import redundant_groups

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")


@pytest.fixture(scope="module")
def hexagon():
    """A perfect hexagon whose antennas have cables of up to 600 ns, and small errors besides."""
    toy = make_toy(HEX, noise=1e-4)
    delays = np.random.default_rng(4).uniform(-300e-9, 300e-9, 7)
    return replace(toy, gains=toy.gains * np.exp(2j * np.pi * delays[:, None] * (FREQUENCIES - FREQUENCIES[0])))


def start_of(toy, delays, change=None):
    data = make_uvdata(toy, 1)
    if change is not None:
        change(data)
    settings = ONE_SOLVE.model_copy(update={"initial_gains": RedundantStart(kind="redundant", delays=delays)})
    return data, settings, prepare(Observation(data), settings).start[..., 0, 0]


def test_gains_are_right_up_to_what_redundancy_cannot_know(hexagon):
    _, _, start = start_of(hexagon, delays=True)
    ratio = gain_products(start / hexagon.gains, hexagon.antennas)
    groups = redundant_groups(hexagon.vectors, 0.5)
    assert groups.index.max() + 1 < len(ratio)
    ratio = np.where(groups.conjugated[:, None], ratio.conj(), ratio)
    for group in range(groups.index.max() + 1):
        members = ratio[groups.index == group]
        assert np.abs(members / members[0] - 1).max() < 5e-3


@pytest.mark.chain
def test_long_cables_are_within_reach_of_the_fit_from_there_but_not_from_unity(hexagon):
    data, settings, _ = start_of(hexagon, delays=True)
    near, far = run_calibrator(settings, data).solutions[0], run_calibrator(ONE_SOLVE, data).solutions[0]
    # Without noise the minimum is zero, which single precision does not reach.
    assert near.status in ("converged", "stalled")
    assert near.loss_history[0] < 0.1 * far.loss_history[0]
    assert near.loss_history[-1] < 0.1 * far.loss_history[-1]


def test_flagged_samples_have_no_influence(hexagon):
    def flag(data):
        data.flag_array[3, 10:14] = True
        data.flag_array[:, 40] = True
        data.flag_array[5] = True

    def spoil(data):
        flag(data)
        data.data_array[data.flag_array] = 1e6

    clean, dirty = start_of(hexagon, True, flag)[2], start_of(hexagon, True, spoil)[2]
    assert np.allclose(clean, dirty)
    assert np.isfinite(clean).all()


def test_arrays_without_redundancy_are_refused():
    with pytest.raises(InputError, match="needs redundant baselines"):
        start_of(make_toy(scattered(5)), delays=False)


@pytest.mark.parametrize("seed", range(3))
def test_foregrounds_that_groups_share_start_with_the_phase_gradient_of_the_sky_model(seed):
    toy = make_toy(HEX, noise=1e-3, seed=seed)
    delays = np.random.default_rng(seed).uniform(-50e-9, 50e-9, 7)
    toy = replace(toy, gains=toy.gains * np.exp(2j * np.pi * delays[:, None] * FREQUENCIES))
    data = make_uvdata(toy, 1)
    settings = CalamityRedundant(
        basis=BasisSettings(min_delay="50 ns", buffer="50 ns"),
        weights=FlagWeights(),
        initial_gains=RedundantStart(kind="redundant"),
    )
    (solve,) = run_calibrator(settings, data, sky_of(data, toy.foregrounds)).solutions
    # With another gradient the sums of model and sky model have no common scale.
    assert solve.status == "converged"
    assert solve.loss_history[-1] < 2e-6 * np.mean(np.abs(toy.visibilities) ** 2)
