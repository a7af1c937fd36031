"""Radiometer noise against correlated voltages, against the autocorrelations of a uniform sky, and against numbers."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument
from plugin_files import make
from scipy.constants import Boltzmann, speed_of_light
from tiny import tiny

from calstudy.base.errors import ExperimentError
from calstudy.base.gain_files import read_gains
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_pairs, to_cube
from calstudy.calibrate.settings import AutoWeights
from calstudy.calibrate.weights import make_weights
from calstudy.corrupt.levels import Levels, radiometer_std
from calstudy.corrupt.noise import SystemTemperature, autocorrelations, effective_area, thermal_noise
from calstudy.corrupt.settings import CorruptionSettings
from calstudy.experiment.files import override, validate
from calstudy.experiment.model import Variant
from calstudy.instrument.beams import make_beam
from calstudy.power.settings import PowerSettings
from calstudy.products import corruption
from calstudy.products.calibration import calibration, with_autocorrelations
from calstudy.products.files import read_json, read_visibilities
from calstudy.products.graph import Graph
from calstudy.realdata.noise import radiometer_variance
from calstudy.validation.steps.estimator import noise_power


def radiometer(**settings: object):
    return CorruptionSettings.model_validate({"noise": {"kind": "radiometer", **settings}}).noise


def test_the_noise_of_a_tile_of_the_mwa_is_that_of_the_radiometer_equation():
    instrument = small_instrument(
        channels={"first": "180 MHz", "width": "80 kHz", "count": 8}, times={"count": 1, "integration": "2 s"}
    )
    noise = radiometer(receiver="50 K", sky="180 K", effective_area="21.5 m2")
    # 1.38e-23 x 230 / 21.5 / 1e-26 = 14.8 kJy, over the root of 160,000 samples.
    expected = 1.380649e-23 * 230 / 21.5 / 1e-26 / 400
    assert expected == pytest.approx(36.9, rel=1e-3)
    found = radiometer_std(noise, instrument)
    assert found.shape == (8, 1)
    assert found[0, 0] == pytest.approx(expected, rel=1e-12)
    assert found[3, 0] / found[0, 0] == pytest.approx((50 + 180 * (180.24 / 180) ** -2.6) / 230, rel=1e-12)
    assert radiometer_std(radiometer(effective_area="21.5 m2", nights=4), instrument)[0, 0] == pytest.approx(
        expected / 2
    )


def test_correlated_voltages_scatter_by_it():
    """Two antennas with noise of their own: the scatter of correlations over as many samples as width x time."""
    rng, samples, trials = np.random.default_rng(1), 500, 4000
    temperature = SystemTemperature(receiver="100 K", sky="0 K")
    (auto,) = temperature.autocorrelations(np.array([150e6]), 10.0)
    parts = rng.normal(size=(2, 2, trials, samples)) * np.sqrt(auto / 2)
    voltages = parts[0] + 1j * parts[1]
    correlations = np.mean(voltages[0] * voltages[1].conj(), axis=-1)
    instrument = small_instrument(
        channels={"first": "150 MHz", "width": "500 Hz", "count": 8}, times={"count": 1, "integration": "1 s"}
    )
    noise = radiometer(receiver="100 K", sky="0 K", effective_area="10 m2")
    # 4000 trials: the rms is known to 1 / sqrt(2 x 4000) = 1.1 %, its ratio is tested to four times that.
    found = np.sqrt(np.mean(abs(correlations) ** 2)) / radiometer_std(noise, instrument)[0, 0]
    assert found == pytest.approx(1, abs=0.045)


def test_autocorrelations_are_those_of_a_uniform_sky_in_the_beam():
    """V_xx = 1/2 int A I with I = 2 k T / lambda^2, integrated over the beam here."""
    instrument = small_instrument(beam={"kind": "airy", "diameter": "6 m"})
    frequencies = instrument.channels.first + instrument.channels.width * np.arange(instrument.channels.count)
    beam = make_beam(instrument.beam, instrument.channels)
    zenith_angle = (np.arange(4000) + 0.5) * np.pi / 8000
    jones = beam.at(frequencies[:1]).efield_eval(
        az_array=np.zeros(4000), za_array=zenith_angle, freq_array=frequencies[:1]
    )
    power = np.sum(abs(jones[:, 0, 0]) ** 2, axis=0)
    brightness = 2 * Boltzmann * 300 * (frequencies[0] / speed_of_light) ** 2 * 1e26
    auto = 0.5 * brightness * np.sum(power * 2 * np.pi * np.sin(zenith_angle)) * np.pi / 8000
    area = effective_area(frequencies, beam.solid_angles(frequencies, "xx")[0])
    found = SystemTemperature(receiver="300 K", sky="0 K").autocorrelations(frequencies, area)[0]
    assert found == pytest.approx(auto, rel=1e-3)


def test_a_spectrum_of_noise_has_its_level_in_every_channel():
    std = np.array([[1.0], [4.0], [9.0]])
    noise = thermal_noise((4000, 5, 3, 1), std, seed=1)
    assert np.std(noise, axis=(0, 1)) == pytest.approx(std, rel=0.02)


def test_noise_of_autocorrelations_is_independent_of_that_of_cross_correlations_of_the_same_seed():
    autos, noise = autocorrelations((10_000,), 1.0, 100.0, seed=7), thermal_noise((10_000,), 1.0, seed=7)
    # Correlations of 10,000 independent pairs of numbers scatter by 0.01.
    assert np.corrcoef([autos, noise.real, noise.imag])[0, 1:] == pytest.approx(np.zeros(2), abs=0.04)


@pytest.mark.chain
def test_a_run_has_the_noise_of_its_beam_in_every_channel(tmp_path):
    settings = {"kind": "radiometer", "nights": 10_000}
    graph = Graph(validate(override(tiny(tmp_path), "corruption.noise", settings), tmp_path))
    task = corruption.data(graph, Variant(components=("noise",)), "even")
    products = make([task], tmp_path)
    noise = to_cube(read_visibilities(products[task.key].path / "data.uvh5"))
    expected = radiometer_std(graph.experiment.corruption.noise, graph.experiment.instrument)
    # 42 samples of each of 32 channels; their mean is known to 1 / sqrt(2 x 42 x 32) = 2 %.
    ratio = np.sqrt(np.mean(abs(noise) ** 2, axis=(0, 1))) / expected
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.06)


def test_the_theory_of_the_noise_power_takes_a_spectrum_of_noise():
    """A spectrum that is flat is a single number, and one that rises weighs channels by the taper."""
    instrument, power = small_instrument(), PowerSettings()
    levels = {"foreground_rms": 1.0, "eor_rms": 1.0, "eor_factor": 1.0}
    flat = Levels(**levels, noise_std=2.0)
    same = Levels(**levels, noise_std=2.0, noise_spectrum=[[2.0]] * 16)
    assert noise_power(instrument, power, same) == pytest.approx(noise_power(instrument, power, flat), rel=1e-12)
    edges = [[50.0]] + [[2.0]] * 14 + [[50.0]]
    # The Blackman-Harris taper is 6e-5 at the ends of the band.
    rising = Levels(**levels, noise_std=2.0, noise_spectrum=edges)
    assert noise_power(instrument, power, rising) == pytest.approx(noise_power(instrument, power, flat), rel=1e-3)


@pytest.mark.parametrize(("noise", "nights"), [({}, 1), ({"kind": "radiometer", "nights": 100}, 100)])
def test_autocorrelations_of_a_run_say_what_the_noise_of_its_baselines_is(noise, nights, tmp_path):
    """The radiometer equation, from autocorrelations after the gains, gives the variance |g_a g_b|^2 sigma^2."""
    noisy = Variant(components=("noise",), effects=True)
    settings = override(tiny(tmp_path), "calibration.weights", "autos")
    graph = Graph(validate(override(settings, "corruption.noise", noise) if noise else settings, tmp_path))
    tasks = corruption.data(graph, noisy, "even"), corruption.autocorrelations(graph, noisy, "even")
    levels, true = corruption.levels(graph), corruption.gains(graph)
    products = make([*tasks, levels, true], tmp_path)
    data, autos = (read_visibilities(products[task.key].path / "data.uvh5") for task in tasks)
    joined = with_autocorrelations(data, autos)
    pairs = antenna_pairs(data)
    sigma = np.ravel(Levels(**read_json(products[levels.key].path / "levels.json")).noise)
    gains = read_gains(products[true.key].path / "gains.calh5", "test").gain_array[:, :, 0, 0]
    expected = (sigma * np.abs(gains[pairs[:, 0]] * gains[pairs[:, 1]])) ** 2
    found = radiometer_variance(joined, pairs, 0)
    # Noise of 1 / sqrt(400 kHz x 10 s) = 0.05 % in each autocorrelation of a night.
    assert np.std(found / expected) == pytest.approx(np.sqrt(2 / 4e6 / nights), rel=0.1)
    assert np.mean(found / expected) == pytest.approx(1, abs=1e-4)
    # 1344 samples: their mean square is known to 1 / sqrt(1344) = 2.7 %.
    ratio = np.abs(to_cube(joined)[:, : len(pairs), :, 0]) ** 2 / found
    assert np.mean(ratio) == pytest.approx(1, abs=0.1)
    weights = make_weights(Observation(joined), ~Observation(joined).autos, AutoWeights(kind="autos"))[..., 0]
    product = weights * expected
    assert np.std(product / product.mean()) < 1e-3


@pytest.mark.chain
def test_a_run_calibrates_with_weights_from_autocorrelations(tmp_path):
    graph = Graph(validate(override(tiny(tmp_path), "calibration.weights", "autos"), tmp_path))
    variant = Variant(components=("foregrounds", "noise"), effects=True, calibrate=True)
    task = calibration(graph, variant, "even")
    product = make([task], tmp_path)[task.key]
    # Seven antennas in 32 channels stop above the minimum with any weights.
    assert set(read_json(product.path / "solution.json")["by_status"]) <= {"converged", "stalled"}
    residual = read_visibilities(product.path / "residual.uvh5")
    assert residual.Nbls == 7 * 6 // 2
    assert not residual.flag_array.any()


def test_weights_from_autocorrelations_need_noise(tmp_path):
    data = override(tiny(tmp_path), "calibration.weights", "autos")
    data = override(data, "variants", {"eor": {"components": ["eor"]}})
    with pytest.raises(ExperimentError, match=r"calibration\.weights: is 'autos', and without"):
        validate(override(data, "corruption.noise", "none"), tmp_path)
