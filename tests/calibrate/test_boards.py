"""Losses between boards of a correlator: what skycal finds of them, and what its correction leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hera_cal.skycal import estimate_SNAP_decoherence
from toy import FREQUENCIES, Toy, make_toy, scattered
from toy_data import make_uvdata, sky_of

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.base.visibilities import flag_cube, from_cube, to_cube
from calstudy.calibrate.boards import Boards
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.calibrators.other_packages import Skycal
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Calibration, Calibrator, DpssSmoothing, Solve
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import FlagWeights, GaussNewtonSettings
from calstudy.corrupt.effects.losses import Decoherence
from calstudy.corrupt.interface import apply_effect, draw_truth

NOISE, CHANNELS = 1e-4, 16
BOARDS = {"per_board": 3, "block": "6.4 MHz", "detection": 0.0}
"""Sixteen channels of 400 kHz: four blocks. All losses are kept, for none is zero."""


@pytest.fixture(scope="module")
def toy() -> Toy:
    """Twelve antennas at random with gains of 10 % that are cubic in frequency, and noise of 1e-4."""
    rng = np.random.default_rng(5)
    made = make_toy(scattered(12), noise=NOISE)
    powers = np.linspace(-1, 1, FREQUENCIES.size) ** np.arange(4)[:, None]
    real, imaginary = rng.standard_normal((2, 12, 4)) @ powers
    return replace(made, gains=1 + 0.05 * (real + 1j * imaginary))


@pytest.fixture(scope="module")
def losses() -> np.ndarray:
    """Losses of up to 5 %, (Nboards, Nblocks)."""
    return 0.05 * np.random.default_rng(6).random((4, 4))


def lossy(toy: Toy, losses: np.ndarray) -> Toy:
    """The toy with losses between boards, which gains of antennas cannot describe."""
    kept = np.repeat((1 - losses)[np.arange(12) // 3], CHANNELS, axis=1)
    first, second = toy.antennas.T
    factors = np.where((first // 3 == second // 3)[:, None], 1, kept[first] * kept[second])
    return replace(toy, foregrounds=factors * toy.foregrounds, noise=factors * toy.noise)


def within(toy: Toy) -> np.ndarray:
    first, second = toy.antennas.T // 3
    return first == second


def calibrated(toy: Toy, losses: np.ndarray, drop: bool = False, **settings):
    data = make_uvdata(lossy(toy, losses), n_times=1)
    if drop:
        flag_cube(data)[:, within(toy)] = True
    return run_calibrator(Skycal.model_validate(settings), data, sky_of(data, toy.foregrounds))


def relative(uvd, toy: Toy, rows: np.ndarray) -> float:
    """The rms of a residual over that of the foregrounds."""
    return float(np.linalg.norm(to_cube(uvd)[0, rows, :, 0]) / np.linalg.norm(toy.foregrounds[rows]))


def test_losses_are_found_relative_to_the_smallest_of_each_board(toy, losses):
    result = calibrated(toy, losses, boards=BOARDS)
    ratio = to_cube(result.model)[0, :, ::CHANNELS, 0] / toy.foregrounds[:, ::CHANNELS]
    relative_loss = np.log(1 - losses) - np.log(1 - losses).max(axis=1, keepdims=True)
    first, second = toy.antennas.T // 3
    expected = np.where(within(toy)[:, None], 0, relative_loss[first] + relative_loss[second])
    # The logarithm of a gain is known to 1e-4 / sqrt(2 * 9), 2e-5, in a channel, for three antennas of a board, and
    # smooth gains of some 16 of 64 modes leave few channels of a step: 2e-5 each, ten times for the worst of hundreds.
    np.testing.assert_allclose(np.log(ratio.real), expected, atol=4e-4)
    assert result.solutions[0].diagnostics["largest_loss"] == pytest.approx(1 - np.exp(relative_loss.min()), abs=4e-4)


def test_the_correction_leaves_within_boards_what_is_smooth_and_changes_nothing_between_them(toy, losses):
    between, inside = ~within(toy), within(toy)
    plain, dropped, corrected = (
        calibrated(toy, losses, **settings) for settings in ({}, {"drop": True}, {"boards": BOARDS})
    )
    np.testing.assert_allclose(
        to_cube(corrected.residual)[:, between], to_cube(dropped.residual)[:, between], rtol=1e-4, atol=1e-6
    )
    assert relative(corrected.residual, toy, between) < 1.1 * NOISE < relative(plain.residual, toy, between)
    # What all blocks of a board lose is left: the steps are gone. Neighbours at the edges of blocks tell.
    edges = np.arange(CHANNELS, FREQUENCIES.size, CHANNELS)
    steps = [
        np.abs(np.diff(to_cube(uvd)[0, inside, :, 0] / toy.foregrounds[inside], axis=1)[:, edges - 1]).mean()
        for uvd in (plain.residual, corrected.residual)
    ]
    assert steps[1] < steps[0] / 20


@pytest.fixture(scope="module", params=[1e-3, 0.05])
def without_noise(toy, request):
    """The toy without noise, its data with losses by the effect, and these losses, (Nboards, Nblocks)."""
    quiet = replace(toy, noise=np.zeros(toy.noise.shape))
    uvd = make_uvdata(quiet, n_times=1)
    effect = Decoherence(loss=request.param, block="6.4 MHz", seed=3)
    observation = Observation(uvd)
    truth = draw_truth(effect, observation)
    cube = np.array(quiet.visibilities[None, :, :, None])
    return quiet, from_cube(uvd, apply_effect(effect, cube, observation, truth)), truth["p"]


def test_without_noise_the_estimate_is_the_loss_as_far_as_gains_are_smooth(without_noise):
    quiet, data, losses = without_noise
    result = run_calibrator(Skycal(boards=Boards(**BOARDS)), data, sky_of(data, quiet.foregrounds))
    found = to_cube(result.model)[0, :, ::CHANNELS, 0] / quiet.foregrounds[:, ::CHANNELS]
    # hera_cal's estimator by itself, of the gains between boards as they must be.
    blocks = np.arange(FREQUENCIES.size) // CHANNELS
    gains = {(a, "Jee"): (quiet.gains[a] * (1 - losses[a // 3])[blocks])[None] for a in range(12)}
    by_itself, _ = estimate_SNAP_decoherence(
        gains,
        {key: np.ones(gain.shape) for key, gain in gains.items()},
        {a: a // 3 for a in range(12)},
        FREQUENCIES,
        nchans_per_block=CHANNELS,
        gain_smoothing_scale=100e-9,
        detection_sigma=0.0,
        full_sigma=0.0,
        band_split_freq=0.0,
    )
    kept = np.log(1 - losses)
    relative_loss = kept - kept.max(axis=1, keepdims=True)
    estimate = np.log(1 - np.concatenate([by_itself[board] for board in range(4)]))
    # What logarithms of cubic gains of 10 % have beyond 100 ns, whatever the loss.
    np.testing.assert_allclose(estimate, relative_loss, atol=2e-5)
    first, second = quiet.antennas.T // 3
    expected = np.where(within(quiet)[:, None], 0, relative_loss[first] + relative_loss[second])
    np.testing.assert_allclose(np.log(found.real), expected, atol=4e-5)


def test_without_noise_sky_based_calibration_leaves_what_another_fit_leaves(without_noise):
    """The minimum over antennas' factors of the sky's weighted misfit, by Newton steps for each channel by itself."""
    quiet, data, losses = without_noise
    solver = GaussNewtonSettings(tolerance=1e-10, max_steps=50, precision="double")
    result = run_calibrator(SkyBased(weights=FlagWeights(), solver=solver), data, sky_of(data, quiet.foregrounds))
    calibrated = to_cube(data)[0, :, :, 0] / gain_products(result.gains.gain_array[:, :, 0, 0], quiet.antennas)
    left = (to_cube(data)[0, :, :, 0] / quiet.visibilities).real
    size = np.abs(quiet.visibilities)
    ends = np.zeros((len(left), 12))
    for column in quiet.antennas.T:
        ends[np.arange(len(left)), column] = 1
    expected = np.empty(left.shape)
    for channel in range(FREQUENCIES.size):
        logarithms = np.zeros(12)
        for _ in range(8):
            product = np.exp(ends @ logarithms)
            step = np.linalg.lstsq(
                ends * (size[:, channel] * product)[:, None], size[:, channel] * (left[:, channel] - product)
            )
            logarithms += step[0]
        expected[:, channel] = left[:, channel] / np.exp(ends @ logarithms)
    np.testing.assert_allclose(calibrated / quiet.foregrounds, expected, rtol=1e-7)
    # Too large by 1 / (1 - p)^2 within boards, but for what the fit gives way.
    excess = np.sqrt(np.mean((expected[within(quiet)] - 1) ** 2))
    full = np.sqrt(np.mean(((1 - losses) ** -2 - 1) ** 2))
    assert 0.5 * full < excess < full


def test_gains_without_losses_stay_as_they_are(toy):
    nothing = np.zeros((4, 4))
    with_boards = calibrated(toy, nothing, boards=BOARDS)
    # Errors of a step, as above.
    assert with_boards.solutions[0].diagnostics["largest_loss"] < 4e-4
    assert relative(with_boards.residual, toy, within(toy)) < 4e-4


def test_gains_are_smooth_once_the_losses_are_out(toy, losses):
    """Smoothing with the losses in the gains makes all baselines wrong, without them none."""
    smoothed = {"smooth_gains": DpssSmoothing(kind="dpss", frequency_scale="10 MHz")}
    plain, corrected = calibrated(toy, losses, **smoothed), calibrated(toy, losses, boards=BOARDS, **smoothed)
    between = ~within(toy)
    assert relative(plain.residual, toy, between) > 5 * NOISE
    assert relative(corrected.residual, toy, between) < 1.5 * NOISE


def test_too_few_boards_are_refused(toy):
    message = r"boards.per_board: 12 antennas are on 2 boards, and 3 are needed; .* most 5$"
    with pytest.raises(InputError, match=message):
        calibrated(toy, np.zeros((4, 4)), boards={"per_board": 6})


class Closing(Calibrator):
    """Unity gains, and a factor of 2i for the first baseline."""

    shape: tuple[int, ...] | None = None

    def calibrate(self, observation, assumed, progress=None):
        closure = np.ones(self.shape or observation.shape, complex)
        closure[:, 0] = 2j
        gains = np.ones((observation.n_antennas, observation.n_channels, observation.n_times, 1), complex)
        return Calibration(gains=gains, outcomes=Solve(status="converged", message="done"), closure=closure)


def test_closure_factors_multiply_the_model_and_divide_the_data(toy):
    uvd = make_uvdata(toy, n_times=1)
    sky = sky_of(uvd, toy.foregrounds)
    result = run_calibrator(Closing(), uvd, sky)
    data, model = to_cube(uvd), Observation(sky).visibilities
    expected = data - model
    expected[:, 0] = data[:, 0] / 2j - model[:, 0]
    np.testing.assert_allclose(to_cube(result.residual), expected, rtol=1e-12)
    np.testing.assert_allclose(to_cube(result.model)[:, 0], 2j * model[:, 0], rtol=1e-12)
    np.testing.assert_allclose(to_cube(result.model)[:, 1:], model[:, 1:], rtol=1e-12)
    with pytest.raises(ValueError, match=r"closure factors of shape \(1, 2, 3\), expected numbers that are finite and"):
        run_calibrator(Closing(shape=(1, 2, 3)), uvd, sky)
