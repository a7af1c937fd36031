"""One delay and one gain per antenna as a start: what was put in comes out, and whatever is wrong with the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.constants import speed_of_light
from toy import FREQUENCIES, complex_normal, make_toy, scattered
from toy_data import ONE_SOLVE, make_uvdata

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.delay_start import _DelaySearch, delay_start
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.preparation import prepare
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import DelayStart, GaussNewtonSettings

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")

ANTENNAS = 10
CABLES = 500e-9
TURNS = 2j * np.pi * (FREQUENCIES - FREQUENCIES.mean())
START, PER_CHANNEL = DelayStart(kind="delays"), DelayStart(kind="delays", per_channel=True)
WITH_DELAYS = ONE_SOLVE.model_copy(update={"initial_gains": START})


@pytest.fixture(scope="module")
def cables():
    """Ten antennas at random, no two baselines alike, with cables of up to 500 ns either way, and their delays."""
    toy = make_toy(scattered(ANTENNAS))
    delays = np.random.default_rng(8).uniform(-CABLES, CABLES, ANTENNAS)
    return replace(toy, gains=toy.gains * np.exp(delays[:, None] * TURNS)), delays


def start_of(toy, sky=None, change=None, select=None, settings=START):
    """Return the starting gains, (Nants, Nfreqs), after a change to the data, or to data and sky model alike."""
    data = make_uvdata(toy, 1)
    if change is not None:
        change(data)
    model = None if sky is None else from_cube(data, sky[None, :, :, None])
    for uvd in (data, model):
        if select is not None and uvd is not None:
            select(uvd)
    observed = Observation(data)
    weights = (~observed.flags).astype(float)
    known = None if sky is None else Observation(model).visibilities
    return delay_start(observed, weights, settings, known)[:, :, 0, 0]


def delays_of(gains, frequencies=FREQUENCIES):
    """Return the delay of each antenna of smooth gains, s."""
    steps = np.angle(np.mean(gains[:, 1:] * gains[:, :-1].conj(), axis=1))
    return steps / (2 * np.pi * np.diff(frequencies)[0])


def errors(toy, found, delays, kept=None):
    """Return how far differences of delays are off, s, for each baseline, apart from a gradient over the array."""
    first, second = toy.antennas.T
    used = np.isin(toy.antennas, np.arange(ANTENNAS) if kept is None else kept).all(axis=1)
    difference = ((found - delays)[first] - (found - delays)[second])[used]
    vectors = toy.vectors[used, :2]
    return difference - vectors @ np.linalg.lstsq(vectors, difference, rcond=None)[0]


def rms(values):
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


def test_with_the_sky_one_delay_and_one_gain_per_antenna_are_found_exactly():
    """Amplitudes from 0.3 to 3 and any phase; what is left is the interpolation between delays of the grid."""
    rng = np.random.default_rng(2)
    toy = make_toy(scattered(ANTENNAS), noise=0.0)
    delays = rng.uniform(-CABLES, CABLES, ANTENNAS)
    constant = np.exp(rng.uniform(-1, 1, ANTENNAS) + 2j * np.pi * rng.random(ANTENNAS))
    toy = replace(toy, gains=constant[:, None] * np.exp(delays[:, None] * TURNS))
    start = start_of(toy, toy.foregrounds)
    ratio = gain_products(start / toy.gains, toy.antennas)
    assert rms(ratio - 1) < 0.02


@pytest.mark.parametrize("known", [1.0, 0.8])
def test_noise_in_frequency_and_a_wrong_sky_leave_phases_within_reach(cables, known):
    """A fifth of the sky model is another sky."""
    toy, _ = cables
    other = make_toy(scattered(ANTENNAS), seed=33).foregrounds
    start = start_of(toy, known * toy.foregrounds + (1 - known) * other)
    ratio = gain_products(start / toy.gains, toy.antennas)
    left = np.angle(np.mean(ratio, axis=1))
    assert rms(left) < (0.05 if known == 1 else 0.5)
    assert rms(np.angle(ratio)) < (0.25 if known == 1 else 0.6)


def test_without_the_sky_delays_are_right_but_for_a_gradient(cables):
    """To within a twentieth of the delays over which the foregrounds of the longest baseline may spread."""
    toy, delays = cables
    start = start_of(toy)
    horizon = np.linalg.norm(toy.vectors, axis=1).max() / speed_of_light
    assert rms(errors(toy, delays_of(start), delays)) < 0.05 * horizon
    assert rms(errors(toy, np.zeros(ANTENNAS), delays)) > horizon
    assert np.allclose(np.abs(start), 1)


def one_source(extent, cables, direction=(0.15, -0.1)):
    """Return antennas under a single source at these direction cosines, with cables up to so long, and their delays."""
    positions = extent / 20 * scattered(ANTENNAS)
    toy = make_toy(positions, noise=0.0)
    fringe = np.exp(-2j * np.pi * FREQUENCIES * (toy.vectors[:, :2] @ np.array(direction))[:, None] / speed_of_light)
    delays = np.random.default_rng(8).uniform(-cables, cables, ANTENNAS)
    return replace(toy, foregrounds=fringe, noise=0 * fringe, gains=np.exp(delays[:, None] * TURNS)), delays


def test_on_a_large_array_a_gradient_is_the_sky():
    """A kilometre: the source is 0.6 us from the zenith on long baselines, and cables have scattered by 10 ns."""
    toy, delays = one_source(1000, 10e-9)
    found = delays_of(start_of(toy))
    first, second = toy.antennas.T
    assert rms((found - delays)[first] - (found - delays)[second]) < 30e-9
    assert rms(toy.vectors[:, :2] @ [0.15, -0.1] / speed_of_light) > 200e-9


def test_on_a_small_array_a_gradient_is_left_to_the_cables():
    """Twenty metres and cables of 500 ns: corrected data have the source at the zenith, wherever it is."""
    low = (0.7, -0.5)
    toy, _ = one_source(20, CABLES, low)
    corrected = toy.visibilities / gain_products(start_of(toy), toy.antennas)
    assert rms(delays_of(corrected)) < 0.25 * rms(toy.vectors[:, :2] @ low / speed_of_light)


@pytest.mark.parametrize("with_sky", [True, False])
def test_noise_of_twice_the_signal_leaves_the_delays(cables, with_sky):
    toy, delays = cables
    noise = 2 * rms(toy.foregrounds) * complex_normal(np.random.default_rng(5), toy.foregrounds.shape)
    noisy = replace(toy, noise=noise)
    start = start_of(noisy, toy.foregrounds if with_sky else None)
    # A quarter of the delay resolution, 1 / 25.6 MHz: phases are off by less than a radian at the ends of the band.
    assert rms(errors(noisy, delays_of(start), delays)) < 10e-9


@pytest.mark.parametrize("seed", range(10))
def test_no_antenna_alone_can_raise_the_sum_of_scores(seed):
    """Scores of noise alone have many maxima: what is found is one of them."""
    n_antennas, n_delays = 9, 64
    antennas = np.column_stack(np.triu_indices(n_antennas, 1))
    scores = np.random.default_rng(seed).standard_normal((len(antennas), n_delays))
    search = _DelaySearch(scores, antennas, n_antennas)
    search.place()
    while search.improve():
        pass

    def total(delays):
        return scores[np.arange(len(antennas)), (delays[antennas[:, 0]] - delays[antennas[:, 1]]) % n_delays].sum()

    for antenna in range(n_antennas):
        alone = np.arange(n_antennas) == antenna
        moved = [total(np.where(alone, delay, search.delays)) for delay in range(n_delays)]
        assert max(moved) == pytest.approx(total(search.delays), rel=1e-12)


def test_channels_in_descending_order(cables):
    toy, _ = cables
    down = start_of(toy, toy.foregrounds, select=lambda uvd: uvd.reorder_freqs(channel_order="-freq", run_check=False))
    assert np.allclose(down[:, ::-1], start_of(toy, toy.foregrounds))


@pytest.mark.parametrize("with_sky", [True, False])
def test_a_gap_in_the_band(cables, with_sky):
    toy, delays = cables
    gap = np.r_[0:25, 36:64]
    sky = toy.foregrounds if with_sky else None
    start = start_of(toy, sky, select=lambda uvd: uvd.select(freq_chans=gap, run_check=False))
    assert rms(errors(toy, delays_of(start[:, :25]), delays)) < 5e-9


def flag_many(data):
    data.flag_array[np.random.default_rng(3).random(data.flag_array.shape) < 0.3] = True


def interfere(data):
    data.data_array[:, 17] = 1e3 * np.abs(data.data_array).max() * complex_normal(np.random.default_rng(4), (45, 1))


def baselines_of_the_third(data):
    return (data.ant_1_array == 14) | (data.ant_2_array == 14)


def silence(data):
    data.data_array[baselines_of_the_third(data)] = 0


def only_noise(data):
    rows = baselines_of_the_third(data)
    data.data_array[rows] = 1e-3 * complex_normal(np.random.default_rng(5), data.data_array[rows].shape)


def flag_antenna(data):
    data.flag_array[baselines_of_the_third(data)] = True


FAULTS = {
    "30 % flags": flag_many,
    "interference": interfere,
    "no signal": silence,
    "noise alone": only_noise,
    "flagged": flag_antenna,
}


@pytest.mark.parametrize("with_sky", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_data_do_not_touch_the_delays_of_sound_antennas(cables, fault, with_sky):
    toy, delays = cables
    start = start_of(toy, toy.foregrounds if with_sky else None, FAULTS[fault])
    assert np.isfinite(start).all()
    assert (start != 0).all()
    sound = np.delete(np.arange(ANTENNAS), 2) if fault in ("no signal", "noise alone", "flagged") else np.arange(10)
    assert rms(errors(toy, delays_of(start), delays, sound)) < 5e-9


@pytest.mark.parametrize("with_sky", [True, False])
def test_flagged_samples_have_no_influence(cables, with_sky):
    toy, _ = cables

    def spoil(data):
        flag_many(data)
        data.data_array[data.flag_array] = np.nan

    sky = toy.foregrounds if with_sky else None
    assert np.array_equal(start_of(toy, sky, flag_many), start_of(toy, sky, spoil))


def test_parts_that_no_baseline_connects_are_fitted_each(cables):
    toy, _ = cables
    halves = (toy.antennas < 5).all(axis=1) | (toy.antennas >= 5).all(axis=1)
    start = start_of(
        toy, toy.foregrounds, lambda data: data.flag_array.__setitem__(slice(None), ~halves[:, None, None])
    )
    ratio = gain_products(start / toy.gains, toy.antennas)[halves]
    assert rms(np.angle(np.mean(ratio, axis=1))) < 0.05


@pytest.mark.parametrize("with_sky", [True, False])
@pytest.mark.chain
def test_long_cables_are_as_easy_as_none_from_there_and_out_of_reach_from_unity(cables, with_sky):
    """Within 1 % of the loss that is reached from the true gains."""
    toy, _ = cables
    data = make_uvdata(toy, 1)
    sky = from_cube(data, toy.foregrounds[None, :, :, None]) if with_sky else None
    truth = make_uvcal(data, toy.gains[:, :, None, None])
    floor = run_calibrator(ONE_SOLVE, data, sky, truth).solutions[0]
    found, unity = (run_calibrator(settings, data, sky).solutions[0] for settings in (WITH_DELAYS, ONE_SOLVE))
    assert found.status == "converged"
    assert found.loss_history[-1] < 1.01 * floor.loss_history[-1]
    assert unity.loss_history[-1] > 1.2 * floor.loss_history[-1]
    assert unity.status != "converged"


def test_gains_per_channel_are_those_of_sky_based_calibration(cables):
    """Both minimize w |V - g_a g_b* m|^2; of noise alone, as of all else."""
    toy, _ = cables
    data = make_uvdata(toy, 1)
    sky = from_cube(data, toy.foregrounds[None, :, :, None])
    start = start_of(toy, toy.foregrounds, settings=PER_CHANNEL)
    result = run_calibrator(SkyBased(initial_gains=START, solver=GaussNewtonSettings(tolerance=1e-6)), data, sky)
    fitted = result.gains.gain_array[:, :, 0, 0]
    noise = rms(toy.noise) / rms(toy.foregrounds)
    assert rms(gain_products(start / fitted, toy.antennas) - 1) < 0.1 * noise
    assert rms(gain_products(fitted / toy.gains, toy.antennas) - 1) > 0.3 * noise


@pytest.mark.chain
def test_gain_errors_of_order_one_are_within_reach_with_gains_per_channel():
    """Within 1 % of the loss that is reached from the true gains, with a quarter of another sky in the sky model.

    The solver's default tolerance leaves up to 2 % in slow directions.
    """
    rng = np.random.default_rng(6)
    toy = make_toy(scattered(14))
    toy = replace(toy, gains=toy.gains + complex_normal(rng, toy.gains.shape))
    data = make_uvdata(toy, 1)
    wrong = toy.foregrounds + 0.25 * make_toy(toy.positions, seed=33).foregrounds
    sky = from_cube(data, wrong[None, :, :, None])
    closer = ONE_SOLVE.model_copy(update={"solver": GaussNewtonSettings(tolerance=1e-4)})
    floor = run_calibrator(closer, data, sky, make_uvcal(data, toy.gains[:, :, None, None])).solutions[0]
    found = run_calibrator(closer.model_copy(update={"initial_gains": PER_CHANNEL}), data, sky).solutions[0]
    assert found.status == "converged"
    assert found.loss_history[0] < 0.1 * np.mean(np.abs(toy.visibilities) ** 2)
    assert found.loss_history[-1] < 1.01 * floor.loss_history[-1]


@pytest.mark.parametrize("with_sky", [True, False])
def test_gains_that_are_noise_in_frequency_are_fitted_as_from_unity(toy, with_sky):
    data = make_uvdata(toy, 1)
    sky = from_cube(data, toy.foregrounds[None, :, :, None]) if with_sky else None
    found, unity = (run_calibrator(settings, data, sky).solutions[0] for settings in (WITH_DELAYS, ONE_SOLVE))
    assert found.status == unity.status == "converged"
    assert found.loss_history[-1] < 1.01 * unity.loss_history[-1]


def test_sky_based_calibration_starts_where_phases_are_right(cables):
    toy, _ = cables
    data = make_uvdata(toy, 1)
    sky = from_cube(data, toy.foregrounds[None, :, :, None])
    settings = SkyBased(initial_gains=START)
    solution = run_calibrator(settings, data, sky).solutions[0]
    assert solution.status == "converged"
    noise = np.mean(np.abs(gain_products(toy.gains, toy.antennas) * toy.noise) ** 2)
    assert solution.loss_history[-1] < noise


def test_what_cannot_work_is_refused_in_a_sentence(cables):
    toy, _ = cables
    with pytest.raises(InputError, match="sky model, which is zero wherever"):
        start_of(toy, 0 * toy.foregrounds)
    far = replace(toy, positions=1000 * toy.positions)
    with pytest.raises(InputError, match=r"per_channel: gains in every channel need a sky model"):
        start_of(toy, settings=PER_CHANNEL)
    with pytest.raises(InputError, match="needs a sky model where the shortest baseline has"):
        start_of(far)


def test_an_experiment_says_so_by_name(cables):
    settings = type(ONE_SOLVE).model_validate({"initial_gains": "delays"})
    toy, delays = cables
    prepared = prepare(Observation(make_uvdata(toy, 2)), settings, Assumed())
    assert prepared.start.shape == (ANTENNAS, FREQUENCIES.size, 2, 1)
    for time in (0, 1):
        assert rms(errors(toy, delays_of(prepared.start[:, :, time, 0]), delays)) < 5e-9


def test_integrations_that_are_solved_together_start_where_there_are_data(cables):
    toy, _ = cables
    settings = WITH_DELAYS.model_copy(update={"integrations_per_solve": 3})
    uvd = make_uvdata(toy, n_times=3)
    sky = from_cube(uvd, np.broadcast_to(toy.foregrounds[None, :, :, None], (3, *toy.foregrounds.shape, 1)).copy())
    first = []
    for flagged in (False, True):
        if flagged:
            uvd.flag_array[uvd.time_array == uvd.time_array.min()] = True
        (solve,) = run_calibrator(settings, uvd, sky).solutions
        first.append(solve.loss_history[0])
    assert solve.usable
    # Two thirds of the data, from the same start.
    assert first[1] == pytest.approx(first[0] * 2 / 3, rel=0.05)
