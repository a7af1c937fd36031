"""The noise that a finite prior is weighed against is that of the data, by their autocorrelations and by chi^2."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import make
from tiny import tiny

from calstudy.base.gain_files import read_gains
from calstudy.base.observation import Observation
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.preparation import make_problem, prepare
from calstudy.experiment.files import validate
from calstudy.experiment.model import Variant
from calstudy.products import corruption
from calstudy.products.calibration import calibration_inputs, with_autocorrelations
from calstudy.products.corruption import LEVELS
from calstudy.products.files import DATA, GAINS, VISIBILITIES, read_json, read_visibilities
from calstudy.products.graph import Graph
from calstudy.realdata.noise import sample_noise

NOISE = Variant(components=("noise",), effects=True)
DRIFT = {"kind": "random-walk", "amplitude": 0.3, "time": "10 s"}
EFFECTS = {
    "white": [{"kind": "per-channel-gains", "sigma": 0.5}],
    "drifting": [{"kind": "bandpass", "sigma": 0.1, "drift": DRIFT}],
    "coarse": [{"kind": "coarse-channels"}],
    "flagged": [{"kind": "per-channel-gains", "sigma": 0.5}, {"kind": "rfi", "channels": 0.3, "duty_cycle": 0.5}],
}


NIGHTS = {"kind": "radiometer", "nights": 100}


@pytest.mark.parametrize(
    ("noise", "effects"),
    [*(({"kind": "times-eor"}, effects) for effects in EFFECTS.values()), (NIGHTS, EFFECTS["flagged"])],
    ids=[*EFFECTS, "nights"],
)
def test_a_finite_prior_is_weighed_against_the_noise_of_the_data(noise, effects, tmp_path):
    """Measured data tell their noise by their autocorrelations; and chi^2 at the true gains is one."""
    settings = {"corruption": {"noise": noise, "effects": effects}, "calibration": {"calibrator": "delay-weighted"}}
    graph = Graph(validate({**tiny(tmp_path), **settings}, tmp_path))
    inputs = calibration_inputs(graph, NOISE, "even")
    autos, true = corruption.autocorrelations(graph, NOISE, "even"), corruption.gains(graph)
    made = make([*filter(None, inputs.values()), autos, true], tmp_path)
    data = read_visibilities(made[inputs["data"].key].path / DATA)
    level = read_json(made[inputs["levels"].key].path / LEVELS)["noise_std"]
    joined = with_autocorrelations(data, read_visibilities(made[autos.key].path / DATA))
    # An autocorrelation of 400 kHz and 10 s has noise of 0.05 %.
    assert level == pytest.approx(sample_noise(joined), rel=1e-3)

    sky = Observation(read_visibilities(made[inputs["sky_model"].key].path / VISIBILITIES))
    calibrator = graph.experiment.calibration
    prepared = prepare(Observation(data), calibrator, Assumed(sky, noise=level))
    gains = read_gains(made[true.key].path / GAINS, "true gains").gain_array[..., 0]
    squares = []
    for time in range(data.Ntimes):
        problem = make_problem(prepared, calibrator, slice(time, time + 1), 0)
        problem = problem.weighted_by(gains[..., min(time, gains.shape[2] - 1)])
        squares.append((problem.weights * np.abs(problem.visibilities) ** 2)[problem.weights > 0])
    values = np.concatenate(squares)
    # The variance of each is one. Of 940 to 1344 samples, the mean is known to 3 %.
    assert values.mean() == pytest.approx(1, abs=4 / np.sqrt(values.size))
