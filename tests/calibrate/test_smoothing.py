"""Gains that are smoothed: what is smooth stays, what is white shrinks as its modes do, flags do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import tiny
from toy import FREQUENCIES, complex_normal, make_toy, scattered
from toy_data import make_uvdata, sky_of

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.execution import run_calibrator, smooth, smoothly_turned
from calstudy.calibrate.interface import DpssSmoothing, PolynomialSmoothing, SmoothCal
from calstudy.experiment.files import checked, validate
from calstudy.products.calibration import calibration
from calstudy.products.graph import Graph

N_TIMES = 12
NOWHERE = np.zeros((40, FREQUENCIES.size, N_TIMES, 1), bool)
WAYS = {
    "dpss": DpssSmoothing(kind="dpss", frequency_scale="4 MHz", time_scale="12 s"),
    "dpss in frequency": DpssSmoothing(kind="dpss", frequency_scale="4 MHz"),
    "dpss in time": DpssSmoothing(kind="dpss", time_scale="12 s"),
    "polynomial": PolynomialSmoothing(kind="polynomial", frequency_degree=5, time_degree=2),
    "smooth-cal": SmoothCal(kind="smooth-cal", frequency_scale="4 MHz", time_scale="12 s"),
}


@pytest.fixture(scope="module")
def observation() -> Observation:
    """64 channels and 12 integrations of 2 s; of its antennas only the number is used."""
    return Observation(make_uvdata(make_toy(scattered(3)), n_times=N_TIMES))


@pytest.fixture(params=list(WAYS))
def way(request):
    return WAYS[request.param]


def smoothed(way, gains, observation, flags=NOWHERE):
    return smooth(gains, flags, observation, way)


def low(n: int, rng: np.random.Generator) -> np.ndarray:
    """Slow functions: parabolas of both signs."""
    x = np.linspace(-1, 1, n)
    return rng.standard_normal((40, 3)) @ [np.ones(n), x, x**2]


def modes(way, observation) -> float:
    """The part of all modes that are left: the trace of the projection, from its response to single samples."""
    n_f, n_t = FREQUENCIES.size, N_TIMES
    total = 0.0
    for f, t in np.random.default_rng(1).integers(0, (n_f, n_t), (300, 2)):
        impulse = np.zeros((1, n_f, n_t, 1), complex)
        impulse[0, f, t] = 1
        total += smoothed(way, impulse, observation, NOWHERE[:1])[0, f, t, 0].real
    return total / 300


@pytest.mark.chain
def test_smooth_gains_stay_as_they_are(way, observation):
    rng = np.random.default_rng(2)
    gains = (3 + 0.1 * low(FREQUENCIES.size, rng))[:, :, None] + 0.1j * low(N_TIMES, rng)[:, None, :]
    flags = rng.random(NOWHERE.shape) < 0.05
    flags[:, 30:33] = True
    flags[:, :, 5] = True
    spoiled = np.where(flags, 1e3, gains[..., None])
    # Julian dates have 1e-5 of an integration. Sequences hold a parabola only as far as their number goes; smooth-cal
    # turns by a mean delay that it measures.
    limit = 1e-5 if way.kind == "polynomial" else 2e-3
    for flagged, given in ((NOWHERE, gains[..., None]), (flags, spoiled)):
        found = smoothed(way, given, observation, flagged)
        np.testing.assert_array_equal(found[flagged], given[flagged])
        assert np.abs(found - given)[~flagged].max() < limit


@pytest.mark.parametrize("name", [name for name in WAYS if name != "smooth-cal"])
def test_what_was_smoothed_stays_as_it_is(name, observation):
    """To rounding: the fit is a projection, with flags as well."""
    rng = np.random.default_rng(3)
    white = complex_normal(rng, NOWHERE.shape)
    once = smoothed(WAYS[name], white, observation)
    assert np.abs(smoothed(WAYS[name], once, observation) - once).max() < 1e-12
    flags = rng.random(NOWHERE.shape) < 0.05
    spoiled = np.where(flags, 1e3, once)
    assert np.abs(smoothed(WAYS[name], spoiled, observation, flags) - once)[~flags].max() < 1e-8


def test_white_errors_shrink_with_the_number_of_modes(observation):
    rng = np.random.default_rng(4)
    white = complex_normal(rng, NOWHERE.shape)
    n_f, n_t = 64, 12
    expected = {
        # Polynomials of degree n have n + 1 modes; a band of 25.6 MHz has 2 x 25.6 / 4 delays within 1 / 4 MHz, and
        # some more at the edge of the cutoff.
        "polynomial": (6 * 3 / (n_f * n_t), 1e-3),
        "dpss in frequency": (19 / n_f, 3.5 / n_f),
    }
    for name, way in WAYS.items():
        if name == "smooth-cal":
            continue
        variance = np.mean(np.abs(smoothed(way, white, observation)) ** 2)
        # 40 x 768 samples of which a tenth are independent: 2 % of the variance.
        assert variance == pytest.approx(modes(way, observation), rel=0.1)
        if name in expected:
            value, allowed = expected[name]
            assert variance == pytest.approx(value, rel=0.05, abs=allowed)


def test_smooth_cal_has_the_modes_of_dpss(observation):
    """Around gains of one, where there is no delay to take out, both fit the same sequences."""
    gains = 1 + 1e-3 * complex_normal(np.random.default_rng(5), NOWHERE.shape)
    ours, theirs = (smoothed(WAYS[name], gains, observation) - 1 for name in ("dpss", "smooth-cal"))
    assert np.sqrt(np.mean(np.abs(theirs) ** 2) / np.mean(np.abs(ours) ** 2)) == pytest.approx(1, abs=0.1)
    assert np.abs(theirs - ours).max() < 0.5 * np.abs(ours).max()


def test_a_reference_antenna_takes_the_phase_that_is_common_out(observation):
    """Calibrations leave the phase of each channel open: it is white, and must not be smoothed."""
    rng = np.random.default_rng(6)
    smooth_gains = (1 + 0.1j * low(FREQUENCIES.size, rng))[:, :, None, None] * np.ones((1, 1, N_TIMES, 1))
    phase = np.exp(2j * np.pi * rng.random((1, FREQUENCIES.size, N_TIMES, 1)))
    way = PolynomialSmoothing(kind="polynomial", frequency_degree=12, reference_antenna=10)
    found = smoothed(way, smooth_gains * phase, observation)
    products = found[:1] * found.conj()
    assert np.abs(products - smooth_gains[:1] * smooth_gains.conj()).max() < 1e-3
    without = smoothed(way.model_copy(update={"reference_antenna": None}), smooth_gains * phase, observation)
    assert np.abs(without).mean() < 0.7
    with pytest.raises(InputError, match="smooth_gains: reference_antenna: there is no antenna 99 in the data"):
        smoothed(way.model_copy(update={"reference_antenna": 99}), smooth_gains, observation)


@pytest.mark.parametrize("initial", ["unity", "delays"])
def test_cables_of_different_lengths_do_not_spoil_smooth_gains(initial):
    """Exact data. Where cables differ by 100 ns the sum of gains over antennas, real in a fit from unity, has zeros."""
    toy = make_toy(scattered(9), noise=0.0)
    rng = np.random.default_rng(8)
    delays, first = rng.uniform(-100e-9, 100e-9, 9), rng.uniform(0, 2 * np.pi, 9)
    cables = np.exp(1j * (2 * np.pi * delays[:, None] * FREQUENCIES + first[:, None]))
    toy = replace(toy, gains=cables)
    uvd = make_uvdata(toy, n_times=2)
    settings = SkyBased(smooth_gains=WAYS["dpss in frequency"], initial_gains={"kind": initial})
    result = run_calibrator(settings, uvd, sky_of(uvd, toy.foregrounds))
    left = np.sqrt(np.mean(np.abs(to_cube(result.residual)) ** 2) / np.mean(np.abs(toy.foregrounds) ** 2))
    # Sequences of a scale of 4 MHz hold 250 ns, but for the last parts in a thousand.
    assert left < 1e-3


def test_the_phase_of_channels_and_integrations_is_turned_to_that_of_their_neighbours():
    """What is common to all antennas is lost, and nothing else; unknown gains are left as they are."""
    rng = np.random.default_rng(9)
    smooth_gains = (1 + 0.1j * low(FREQUENCIES.size, rng))[:, :, None, None] * np.ones((1, 1, N_TIMES, 1))
    gains = smooth_gains * np.exp(2j * np.pi * rng.random((1, FREQUENCIES.size, N_TIMES, 1)))
    gains[:, 20:24] = gains[3] = gains[:, :, 4] = 0
    turned, known = smoothly_turned(gains), gains != 0
    assert np.array_equal(turned == 0, ~known)
    np.testing.assert_allclose(turned[:1] * turned.conj(), gains[:1] * gains.conj(), atol=1e-12)
    phase = np.angle(turned[1:2] * np.exp(-1j * np.angle(smooth_gains[1:2])))[known[1:2]]
    # One phase, and the little by which those of 40 antennas do not cancel.
    assert np.ptp(np.unwrap(phase)) < 0.1


def test_data_are_calibrated_with_the_smooth_gains():
    toy = make_toy(scattered(6), noise=1e-2)
    uvd = make_uvdata(toy, n_times=2)
    sky = from_cube(uvd, np.broadcast_to(toy.foregrounds[None, :, :, None], to_cube(uvd).shape))
    way = {"kind": "polynomial", "frequency_degree": 3, "reference_antenna": 10}
    rough, fine = (run_calibrator(SkyBased.model_validate({"smooth_gains": given}), uvd, sky) for given in (None, way))
    observed = Observation(uvd)
    rows = np.isin(rough.gains.ant_array, observed.numbers)
    expected = smooth(
        rough.gains.gain_array[rows],
        rough.gains.flag_array[rows],
        observed,
        PolynomialSmoothing.model_validate(way),
    )
    np.testing.assert_allclose(fine.gains.gain_array[rows], expected, atol=1e-12)
    first, second = observed.antennas.T
    products = (expected[first] * expected[second].conj()).transpose(2, 0, 1, 3)
    np.testing.assert_allclose(
        to_cube(fine.residual), observed.visibilities / products - to_cube(fine.model), atol=1e-9
    )


def test_gains_that_are_smoothed_in_time_are_not_cut_in_pieces(tmp_path):
    def pieces(given) -> int:
        experiment = validate({**tiny(tmp_path), "calibration": {"chunks": 2, "smooth_gains": given}}, tmp_path)
        return len(calibration(Graph(experiment), experiment.variants["residual"], "even").needs)

    assert pieces(None) == pieces({"frequency_scale": "4 MHz"}) == 2
    assert pieces({"time_scale": "30 s"}) == pieces("smooth-cal") == 1


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "needs a frequency_scale, a time_scale, or both"),
        ({"kind": "polynomial"}, "needs a frequency_degree"),
        ({"kind": "median"}, "kind"),
        ({"frequency_scale": 4}, "has no unit"),
    ],
)
def test_what_smooths_nothing_is_refused(given, told):
    with pytest.raises(ExperimentError, match=told):
        checked(SkyBased, {"smooth_gains": given}, Path())


def test_a_single_integration_has_no_time_to_smooth():
    single = Observation(make_uvdata(make_toy(scattered(3)), n_times=1))
    gains = np.ones((3, FREQUENCIES.size, 1, 1), complex)
    with pytest.raises(InputError, match="there is a single integration"):
        smoothed(WAYS["smooth-cal"], gains, single, np.zeros(gains.shape, bool))
    np.testing.assert_allclose(smoothed(WAYS["dpss"], gains, single, np.zeros(gains.shape, bool)), 1, atol=1e-3)
