"""Fits of known error are measured to have that error, and are not charged with what no fit can know."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calstudy.calibrate.agreement import Baselines, Fit, Truth, as_json, compare_with_truth, from_json
from calstudy.calibrate.degeneracy import align
from calstudy.calibrate.problem import gain_products

FREQUENCY = 167e6 + 80e3 * np.arange(384)
ENU = 30.0 * np.array([[0, 0], [1, 0], [0, 1], [2, 1], [1, 3], [3, 0]])
PAIRS = np.column_stack(np.triu_indices(len(ENU), 1))
LENGTHS = np.linalg.norm(ENU[PAIRS[:, 1]] - ENU[PAIRS[:, 0]], axis=1)
BASELINES = Baselines(PAIRS, LENGTHS, FREQUENCY, 100e-9)
N_TIMES = 6


def complex_normal(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def smooth(rng, n_spectra, spread):
    """Sums of tones within `spread` (n_spectra,) s of zero delay, of unit rms."""
    delay = spread[:, None, None] * rng.uniform(-1, 1, (n_spectra, 8, 1))
    tones = complex_normal(rng, n_spectra, 8, 1) * np.exp(2j * np.pi * delay * FREQUENCY)
    values = tones.sum(axis=1)
    return values / np.sqrt(np.mean(np.abs(values) ** 2, axis=1, keepdims=True))


@pytest.fixture(params=["constant", "drifting"])
def truth(request) -> Truth:
    """A measurement whose gains are constant, or change by half their value and by radians during the run."""
    rng = np.random.default_rng(41)
    gains = np.repeat(1 + 0.1 * np.sqrt(2) * complex_normal(rng, 1, len(ENU), FREQUENCY.size), N_TIMES, axis=0)
    if request.param == "drifting":
        gains *= np.exp(np.cumsum(complex_normal(np.random.default_rng(40), N_TIMES, len(ENU), 1), axis=0) / 3)
    horizon = LENGTHS / 299792458.0
    foregrounds = np.stack([10 * smooth(rng, len(PAIRS), 0.8 * horizon) for _ in range(N_TIMES)])
    noise = 0.01 * complex_normal(rng, *foregrounds.shape)
    return Truth(gains, foregrounds, noise, gain_products(gains, BASELINES.antennas) * (foregrounds + noise))


def fit(truth: Truth, gains: np.ndarray | None = None, model: np.ndarray | None = None) -> Fit:
    """A fit with R = V / (g g*) - F for the given gains (Ntimes, Nants, Nfreqs) and model, the true ones by default."""
    gains = truth.gains if gains is None else gains
    model = truth.foregrounds if model is None else model
    return Fit(gains, model, truth.data / gain_products(gains, BASELINES.antennas) - model)


def values(truth: Truth, found: Fit) -> dict[str, float]:
    return {name: item.value for name, item in compare_with_truth(truth, found, BASELINES).items()}


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 10))
@settings(max_examples=30, deadline=None)
def test_alignment_undoes_any_phase_per_channel_and_scale(seed, scale):
    rng = np.random.default_rng(seed)
    gains = 1 + 0.2 * complex_normal(rng, 7, 12)
    turned = gains * np.exp(2j * np.pi * rng.uniform(size=12)) / scale
    kept = turned.copy()
    aligned, found = align(turned, gains)
    np.testing.assert_allclose(aligned, gains, atol=1e-12)
    assert found == pytest.approx(scale)
    np.testing.assert_array_equal(turned, kept)
    products = aligned[0] * aligned[1].conj() / found**2
    np.testing.assert_allclose(products, turned[0] * turned[1].conj(), atol=1e-12 / scale**2)


def test_alignment_is_the_closest_member_of_the_family():
    rng = np.random.default_rng(42)
    reference = 1 + 0.2 * complex_normal(rng, 9, 20)
    aligned, _ = align(reference + 0.1 * complex_normal(rng, 9, 20), reference)
    best = np.sum(np.abs(aligned - reference) ** 2)
    for _ in range(50):
        phases = np.exp(1j * 0.1 * rng.normal(size=20))
        other = aligned * phases * (1 + 0.05 * rng.normal())
        assert np.sum(np.abs(other - reference) ** 2) >= best


def test_the_truth_agrees_with_itself_down_to_the_noise(truth):
    found = values(truth, fit(truth))
    for name in ("gains_aligned", "gains_raw", "gains_worst_delay", "model_aligned", "model_raw"):
        assert found[name] == pytest.approx(0, abs=1e-12), name
    for name in ("product_over_noise", "product_worst_delay", "residual_over_noise_outside"):
        assert found[name] == pytest.approx(1), name
    assert found["product_over_data"] == pytest.approx(1e-3, rel=0.1)
    assert found["correction_over_noise_outside"] == pytest.approx(0, abs=1e-9)


def test_phase_and_scale_of_a_fit_count_as_fitted_but_not_when_aligned(truth):
    rng = np.random.default_rng(43)
    turned = truth.gains * np.exp(1j * rng.uniform(0, 6, FREQUENCY.size)) * 1.2
    found = values(truth, fit(truth, turned, truth.foregrounds / 1.44))
    assert found["gains_raw"] > 0.5
    # By delay, too, gains as fitted differ by a phase that no data know, and aligned ones do not.
    assert found["gains_raw_by_delay"] > 0.5
    assert found["gains_raw_worst_delay"] >= found["gains_raw_by_delay"]
    assert found["gains_by_delay"] == pytest.approx(0, abs=1e-10)
    assert found["model_raw"] == pytest.approx(1 - 1 / 1.44)
    assert found["gains_aligned"] == pytest.approx(0, abs=1e-12)
    assert found["model_aligned"] == pytest.approx(0, abs=1e-12)
    assert found["product_over_noise"] == pytest.approx(1)


def test_white_gain_errors_are_measured_at_their_size_and_fill_the_correction(truth):
    rng = np.random.default_rng(44)
    gains = truth.gains * (1 + 0.05 * complex_normal(rng, *truth.gains.shape))
    found = values(truth, fit(truth, gains))
    assert found["gains_aligned"] == pytest.approx(0.05, rel=0.1)
    # g g*/(ĝ ĝ*) - 1 = -(eta_a + eta_b*): sqrt(2) x 0.05, over a relative noise of 1e-3.
    assert found["correction_over_noise_outside"] == pytest.approx(np.sqrt(2) * 0.05 / 1e-3, rel=0.1)
    assert found["product_over_noise"] > 30


def test_gaps_do_not_change_what_is_measured(truth):
    """Flagged channels and integrations of an antenna are zero in all that is compared."""
    known = np.ones(truth.gains.shape, bool)
    known[:, :, [7, 100, 101, 250]] = False
    known[2, 3] = False
    used = known[:, PAIRS[:, 0]] & known[:, PAIRS[:, 1]]
    gaps = Truth(known * truth.gains, used * truth.foregrounds, used * truth.noise, used * truth.data)
    rng = np.random.default_rng(44)
    gains = known * truth.gains * (1 + 0.05 * complex_normal(rng, *truth.gains.shape))
    products = gain_products(gains, BASELINES.antennas)
    residual = np.divide(gaps.data, products, out=np.zeros_like(gaps.data), where=used) - gaps.foregrounds
    found = values(gaps, Fit(gains, gaps.foregrounds, residual))
    assert np.isfinite(list(found.values())).all()
    assert found["gains_aligned"] == pytest.approx(0.05, rel=0.1)
    assert found["correction_over_noise_outside"] == pytest.approx(np.sqrt(2) * 0.05 / 1e-3, rel=0.1)
    assert found["model_raw"] == 0


def test_gains_that_stay_as_they_were_at_first_are_charged_with_the_drift():
    """A phase of 0.1 t of every second antenna, seen against fits that know only the gains at the first time."""
    rng = np.random.default_rng(46)
    foregrounds, noise = complex_normal(rng, 2, N_TIMES, len(PAIRS), FREQUENCY.size)
    turns = np.exp(0.1j * np.arange(N_TIMES)[:, None] * (-1.0) ** np.arange(len(ENU)))
    gains = turns[..., None] * np.ones(FREQUENCY.size)
    drifting = Truth(gains, foregrounds, noise, gain_products(gains, BASELINES.antennas) * (foregrounds + noise))
    constant = Fit(np.ones_like(gains), foregrounds, noise)
    # Every antenna is 0.1 t off the common phase, and the best real scale is cos(0.1 t).
    expected = np.abs(np.cos(0.1 * np.arange(N_TIMES)) - np.exp(0.1j * np.arange(N_TIMES)))
    assert values(drifting, constant)["gains_aligned"] == pytest.approx(np.median(expected), rel=1e-6)


def test_smooth_errors_common_to_gains_and_model_cancel_in_the_product(truth):
    """The paper's degeneracy: 10 % errors of gains and model, none of their product."""
    rng = np.random.default_rng(45)
    error = 1 + 0.1 * smooth(rng, len(ENU), np.full(len(ENU), 30e-9)).real
    model = truth.foregrounds / gain_products(error, BASELINES.antennas)
    found = values(truth, fit(truth, truth.gains * error, model))
    assert 0.05 < found["gains_aligned"] < 0.15
    assert 0.05 < found["model_aligned"] < 0.3
    assert found["product_over_noise"] == pytest.approx(1)
    assert found["correction_over_noise_outside"] < 0.1


def test_noise_taken_up_inside_the_wedge_is_seen_there_only(truth):
    spectra = np.fft.fft(truth.noise, axis=-1)
    delay = np.abs(np.fft.fftfreq(FREQUENCY.size, 80e3))
    taken = np.fft.ifft(np.where(delay < (LENGTHS / 299792458.0 + 50e-9)[:, None], spectra, 0), axis=-1)
    found = values(truth, fit(truth, model=truth.foregrounds + taken))
    assert found["residual_over_noise_inside"] < 0.3
    assert found["residual_over_noise_outside"] == pytest.approx(1, abs=0.02)
    assert found["data_over_noise_outside"] > 50


@pytest.mark.parametrize("channels", [16, 24, 64])
def test_delays_without_power_of_the_true_gains_are_left_out(truth, channels):
    """The transform of gains of unity has a zero, or rounding in its place, at the largest delay."""
    unity = np.ones_like(truth.gains[..., :channels])
    kept = Truth(unity, *(values[..., :channels] for values in (truth.foregrounds, truth.noise, truth.data)))
    wrong = 1.01 * unity
    baselines = Baselines(PAIRS, LENGTHS, FREQUENCY[:channels], 100e-9)
    found = compare_with_truth(kept, Fit(wrong, kept.foregrounds, kept.noise), baselines)
    assert found["gains_raw_worst_delay"].value == pytest.approx(0.01, rel=1e-6)


def test_measurements_keep_through_json(truth):
    found = compare_with_truth(truth, fit(truth), BASELINES)
    assert from_json(as_json(found)) == found
    assert found["model_aligned"].count == len(PAIRS)


def test_without_delays_outside_the_wedge_nothing_is_said_of_them(truth):
    wide = Baselines(PAIRS, LENGTHS, FREQUENCY, buffer=1.0)
    found = compare_with_truth(truth, fit(truth), wide)
    assert "residual_over_noise_outside" not in found
    assert "residual_over_noise_inside" in found
