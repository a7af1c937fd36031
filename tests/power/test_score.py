"""Differences of calibrations of the same data: what is common to both is not in their error."""

import itertools

import numpy as np
import pytest

from calstudy.base.gains import make_uvcal
from calstudy.instrument.array_layouts.geometric import HexLayout
from calstudy.power.delay import delays
from calstudy.power.score import CalibratedSpectra, difference, score
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra
from calstudy.products.files import GAINS
from calstudy.products.score import MeasureScore

ANTENNAS = 16
PAIRS = np.array(list(itertools.combinations(range(ANTENNAS), 2)))
CHANNELS, DELAYS = 1e5, 8
EDGES, BUFFER = (0.0, 100.0), -1.0
DRAWS = 200


def spectra(visibilities: np.ndarray, others: np.ndarray | None = None) -> DelaySpectra:
    """Spectra of each baseline with itself, of (Nbls, Nd) complex amplitudes in delay, or of these times others."""
    power = (visibilities.conj() * (visibilities if others is None else others)).real
    units = np.repeat(np.arange(len(PAIRS)), 2)
    return DelaySpectra(
        power=power.astype(complex),
        vectors=np.column_stack([PAIRS, np.zeros(len(PAIRS))]).astype(float),
        n_pairs=np.ones(len(PAIRS), int),
        n_polarizations=1,
        delay=delays(DELAYS, CHANNELS),
        k_perp=np.full(len(PAIRS), 0.1),
        k_parallel=np.linspace(0.1, 1, DELAYS),
        frequency=180e6,
        omega_pp=0.1,
        taper="none",
        share_unit=units,
        share_antenna=PAIRS.ravel(),
        share_pairs=np.ones(units.size, int),
        share_power=power[units].astype(complex),
    )


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def calibrated(signal: np.ndarray, antennas: np.ndarray, left: np.ndarray) -> CalibratedSpectra:
    """What a calibration leaves that multiplies the EoR by errors of the antennas, and leaves foregrounds besides."""
    response = signal * (antennas[PAIRS[:, 0]] * antennas[PAIRS[:, 1]])[:, None]
    powers = (spectra(part) for part in (response + left, left))
    return CalibratedSpectra(spectra(signal), spectra(response), spectra(signal, response), *powers)


def of_draw(seed: int, apart: float) -> tuple[CalibratedSpectra, CalibratedSpectra]:
    """Two calibrations of one draw of the sky, whose errors are the same but for a part `apart` of them."""
    rng = np.random.default_rng(seed)
    signal, left = (complex_normal(rng, len(PAIRS), DELAYS) for _ in range(2))
    errors = 0.3 * rng.normal(size=ANTENNAS)
    others = [apart * 0.3 * rng.normal(size=ANTENNAS) for _ in range(2)]
    first, second = (
        calibrated(signal, 1 + errors + other, left * (1 + other[PAIRS].sum(axis=1))[:, None]) for other in others
    )
    return first, second


def less(pair, scales=(1.0, 1.0)):
    """Differences of the scores of two calibrations, by name."""
    return difference(pair, EDGES, BUFFER, scales)


def test_a_calibration_does_not_differ_from_itself():
    one, _ = of_draw(0, 0.1)
    found = less((one, one), (1.02, 1.02))
    assert all(value == 0 for value in found.values())


def test_scores_of_a_response_that_is_a_part_of_the_signal_are_this_part_on_the_true_flux_scale():
    """An amplitude over the scale 1.1: T has the square of both, C each of them once."""
    rng, part, scale = np.random.default_rng(4), 0.8, 1.1
    signal, left = (complex_normal(rng, len(PAIRS), DELAYS) for _ in range(2))
    one = calibrated(signal, np.full(ANTENNAS, np.sqrt(part / scale)), 0 * left)
    found = score(one, EDGES, BUFFER, scale)
    assert (found.cross_transfer, found.transfer) == (pytest.approx(part), pytest.approx(part**2))


def test_a_difference_is_that_of_the_scores_free_of_either_flux_scale():
    pair, scales = of_draw(1, 0.5), (1.02, 0.97)
    alone = [score(one, EDGES, BUFFER, scale) for one, scale in zip(pair, scales, strict=True)]
    found = less(pair, scales)
    for name in ("transfer", "bias"):
        expected = getattr(alone[0], name) - getattr(alone[1], name)
        assert found[name] == pytest.approx(expected, rel=1e-9)


def test_against_a_perfect_calibration_the_error_is_that_of_the_score():
    """T of 1 has no error, nor has a bias of 0: nothing is common."""
    one, _ = of_draw(2, 0.5)
    signal = one.signal
    nothing = spectra(np.zeros((len(PAIRS), DELAYS)))
    found, alone = (
        less((one, CalibratedSpectra(signal, signal, signal, signal, nothing))),
        score(one, EDGES, BUFFER, 1.0),
    )
    assert found["transfer_error"] == pytest.approx(alone.transfer_error, rel=1e-9)
    assert found["bias_error"] == pytest.approx(alone.bias_error, rel=1e-9)


@pytest.mark.chain
@pytest.mark.parametrize("apart", [0.03, 1.0])
def test_paired_errors_are_the_scatter_of_draws_and_far_below_those_of_scores_that_differ_little(apart):
    draws = [of_draw(seed, apart) for seed in range(DRAWS)]
    found = [less(pair) for pair in draws]
    alone = [score(one, EDGES, BUFFER, 1.0) for one in draws[0]]
    for name in ("transfer", "bias"):
        values, errors = (np.array([one[f"{name}{kind}"][0] for one in found]) for kind in ("", "_error"))
        # The scatter of 200 draws is known to 5 %; limits are four times that, as for the errors of a single score.
        assert np.sqrt(np.mean(errors**2)) / values.std(ddof=1) == pytest.approx(1.0, abs=0.2)
        in_quadrature = np.hypot(*(getattr(one, f"{name}_error")[0] for one in alone))
        assert errors[0] < (10 * apart * in_quadrature if apart < 0.1 else 1.5 * in_quadrature)


def test_a_difference_is_of_the_baselines_that_both_have():
    first, second = of_draw(3, 0.5)
    kept = np.flatnonzero((PAIRS != 5).all(axis=1))
    names = ("response", "cross", "residual", "residual_without_eor")
    fewer = CalibratedSpectra(second.signal, *(getattr(second, name).of_units(kept) for name in names))
    both = [
        CalibratedSpectra(*(getattr(one, name).of_units(kept) for name in ("signal", *names)))
        for one in (first, second)
    ]
    found, expected = less((first, fewer)), less((both[0], both[1]))
    assert found["transfer"] == pytest.approx(expected["transfer"], rel=1e-12)
    assert found["transfer_error"] == pytest.approx(expected["transfer_error"], rel=1e-12)


def test_errors_of_gains_are_those_of_all_polarizations(tmp_path, observe):
    """Of a polarization that was fitted well, and one whose gains are all off by a fifth."""
    template = observe(HexLayout(kind="hex", side=2), n_channels=16, polarizations=("xx", "yy"))
    rng = np.random.default_rng(8)
    true = 1 + 0.1 * rng.standard_normal((7, 16, 1, 2)) + 0.1j * rng.standard_normal((7, 16, 1, 2))
    wrong = np.where(np.arange(2) == 1, 1.2, 1.0) * true
    folders = {}
    for name, gains in (("true", true), ("fitted", wrong)):
        folders[name] = tmp_path / name
        folders[name].mkdir()
        make_uvcal(template, gains).write_calh5(folders[name] / GAINS)
    task = dict.fromkeys(("signal", "response", "cross", "scale", "residual", "residual_without_eor"), tmp_path)
    measured = MeasureScore(
        "score",
        **task,
        power=PowerSettings(),
        polarizations=2,
        calibration={"even": folders["fitted"]},
        data={},
        calibration_without_eor={},
        gains=folders["true"],
    )
    # Half of the antennas' errors are zero, and half a fifth.
    assert measured._gain_errors()["gain_error_as_fitted"] == pytest.approx(0.1)
