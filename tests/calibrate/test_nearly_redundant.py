"""One model per group on an array that is nearly redundant: harmful with equal weights on gains that are not smooth."""

import numpy as np
import pytest
from scipy.constants import speed_of_light

from calstudy.base.visibilities import antenna_indices, from_cube, to_cube
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.power.delay import delay_transform

INSTRUMENT = {
    "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
    "beam": "gaussian",
    "channels": {"first": "167.075 MHz", "width": "240 kHz", "count": 96},
    "times": {"integration": "2 s", "count": 1},
}
NOISE = 1e-4


def point_sources(rng):
    """Return directions, (200, 3), and fluxes of sources."""
    directions = rng.uniform(-0.6, 0.6, (200, 2))
    return np.column_stack([directions, np.sqrt(1 - (directions**2).sum(axis=1))]), rng.pareto(1.5, 200)


def foregrounds_of(positions, template, sources):
    """Return the visibilities of sources with an rms of one, (Nbls, Nfreqs)."""
    first, second = antenna_indices(template).T
    directions, fluxes = sources
    lags = (positions[second] - positions[first]) @ directions.T / speed_of_light
    foregrounds = np.exp(-2j * np.pi * lags[:, None] * template.freq_array[:, None]) @ fluxes
    return foregrounds / np.sqrt(np.mean(np.abs(foregrounds) ** 2))


@pytest.fixture(scope="module")
def window_rms():
    """Return the rms of the calibrated residual far outside the wedge, over that of the noise."""
    instrument = InstrumentSettings.model_validate(INSTRUMENT)
    template = make_template(instrument)
    first, second = antenna_indices(template).T
    frequencies = template.freq_array
    positions = make_layout(instrument.layout).enu
    rng = np.random.default_rng(0)
    sources = point_sources(rng)
    offsets = 0.015 * rng.standard_normal(positions.shape)
    rough = 1 + 0.1 * (rng.standard_normal((len(positions), 96)) + 1j * rng.standard_normal((len(positions), 96)))
    shape = (template.Nbls, 96)
    noise = NOISE * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    def measure(displaced: bool, chromatic: bool, calibrator: str, weights: str) -> float:
        foregrounds = foregrounds_of(positions + displaced * offsets, template, sources)
        gains = rough if chromatic else np.ones_like(rough)
        measured = gains[first] * gains[second].conj() * (foregrounds + noise)
        data, sky = (from_cube(template, cube[None, :, :, None]) for cube in (measured, foregrounds))
        residual = run_calibrator(CALIBRATORS.make({"calibrator": calibrator, "weights": weights}), data, sky).residual
        far = np.abs(np.arange(96) - 48) > 24
        left, thermal = (
            delay_transform(cube, frequencies, "blackman-harris")[:, far]
            for cube in (to_cube(residual)[0, :, :, 0], noise)
        )
        return float(np.sqrt(np.mean(np.abs(left) ** 2) / np.mean(np.abs(thermal) ** 2)))

    return measure


@pytest.mark.parametrize("weights", ["gains", "flags"])
@pytest.mark.parametrize(("displaced", "chromatic"), [(False, True), (True, False)])
def test_rough_gains_or_displaced_antennas_alone_leave_noise(window_rms, displaced, chromatic, weights):
    assert window_rms(displaced, chromatic, "calamity-redundant", weights) < 1.3


def test_with_equal_weights_together_they_carry_the_misfit_of_the_groups_out_of_the_wedge(window_rms):
    assert window_rms(True, True, "calamity-redundant", "flags") > 3


def test_with_weights_from_the_gains_the_misfit_of_the_groups_stays_in_the_wedge(window_rms):
    assert window_rms(True, True, "calamity-redundant", "gains") < 1.3


@pytest.mark.chain
@pytest.mark.parametrize("weights", ["gains", "flags"])
def test_one_model_per_baseline_does_not_care(window_rms, weights):
    assert window_rms(True, True, "calamity", weights) < 1.3


@pytest.mark.chain
def test_weights_of_own_gains_settle_where_few_baselines_are_redundant():
    """With antenna blocks of each channel as preconditioner throughout, they still change after ten passes."""
    channels = {"first": "167.075 MHz", "width": "375 kHz", "count": 64}
    settings = INSTRUMENT | {"layout": {"kind": "mwa-compact-minredundant"}, "channels": channels}
    instrument = InstrumentSettings.model_validate(settings)
    template, rng = make_template(instrument), np.random.default_rng(0)
    first, second = antenna_indices(template).T
    foregrounds = foregrounds_of(make_layout(instrument.layout).enu, template, point_sources(rng))
    gains = 1 + 0.1 * rng.standard_normal((36, 64, 2)).view(complex)[..., 0]
    noise = NOISE * rng.standard_normal((*foregrounds.shape, 2)).view(complex)[..., 0]
    cubes = gains[first] * gains[second].conj() * (foregrounds + noise), foregrounds
    data, sky = (from_cube(template, cube[None, :, :, None]) for cube in cubes)
    calibrator = CALIBRATORS.make({"calibrator": "calamity-redundant", "weights": "gains"})
    (solve,) = run_calibrator(calibrator, data, sky).solutions
    assert solve.status == "converged"
    assert solve.diagnostics["weight_change"] < calibrator.weights.tolerance
