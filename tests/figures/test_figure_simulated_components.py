"""The simulated components: P(k) of a simulated EoR is its input's, foregrounds stay where they were put."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.cosmology import Planck15

from calstudy.base.visibilities import baseline_vectors, from_cube
from calstudy.experiment.files import validate
from calstudy.figures.simulated_sky import draw_components, measure_components
from calstudy.instrument.beams import make_beam
from calstudy.instrument.telescope import make_template
from calstudy.power.cosmology import input_power
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.sky.eor import EorField
from calstudy.sky.settings import Eor

SETTINGS = {
    "name": "look",
    "instrument": {
        # Multipoles to 160, below the 191 to which the maps of a power law go.
        "layout": {"kind": "golomb", "count": 6, "spacing": "2.5 m"},
        "beam": {"kind": "gaussian"},
        "channels": {"first": "170 MHz", "width": "240 kHz", "count": 64},
        "times": {"count": 1},
    },
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 200}, "eor": {"nside": 64}},
    "simulation": {"chunks": 1},
}


@pytest.mark.parametrize("spectrum", [{"spectrum": "flat"}, {"spectrum": "power-law", "index": -1.0}])
def test_power_of_a_simulated_eor_is_its_input(spectrum):
    experiment = validate({**SETTINGS, "sky": {"eor": {"nside": 64, **spectrum}}}, Path())
    template = make_template(experiment.instrument)
    sky = EorField(experiment.sky.eor, template.freq_array, Planck15).sky(slice(None))
    beam = make_beam(experiment.instrument.beam, experiment.instrument.channels)
    eor = from_cube(template, DenseEngine().simulate(sky, beam, template))
    delay = 9 / (64 * 240e3)
    tone = 1e3 * np.exp(2j * np.pi * delay * template.freq_array)
    foregrounds = from_cube(template, np.broadcast_to(tone[:, None], eor.data_array.reshape(1, -1, 64, 1).shape))
    components = measure_components(foregrounds, eor, experiment)
    # Within the first bins a power law is not a constant.
    ratio, error = components.ratio(0.2, np.inf)
    assert error < 0.06
    assert abs(ratio - 1) < 3 * error
    assert np.isnan(components.ratio(1e3, 1e4)).all()
    np.testing.assert_allclose(components.wedge.delay[np.abs(components.wedge.power).argmax(axis=1)], delay)
    lengths = np.linalg.norm(baseline_vectors(template), axis=1)
    assert [item.length for item in components.baselines] == pytest.approx(
        [lengths.min(), np.median(lengths), lengths.max()]
    )
    for item in components.baselines:
        assert np.sqrt(np.mean(item.eor**2)) < 1e-2 * item.foregrounds.max()
    assert len(draw_components(components).subfigs) == 2


def test_input_power_is_in_little_h_and_millikelvin():
    h = Planck15.h
    k = np.array([0.1, 0.4]) / h
    flat = input_power(Eor(amplitude="100 K2 Mpc3"), k, "Planck15")
    np.testing.assert_allclose(flat, 1e8 * h**3)
    steep = input_power(Eor(spectrum="power-law", index=-2.0, amplitude="100 K2 Mpc3"), k, "Planck15")
    np.testing.assert_allclose(steep, 1e8 * h**3 * np.array([1, 1 / 16]))
