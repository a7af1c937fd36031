"""Slow checks: the whole sky, all 36 tiles."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import observe, relative_error

from calstudy.base.visibilities import subset_template
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import PyuvsimEngine
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources


@pytest.mark.slow
def test_the_dense_engine_agrees_with_pyuvsim_on_the_whole_default_sky(embedded_beam):
    template = observe(count=36, channels=2, width="10 MHz", times=2, integration="110 s", polarizations=("xx",))
    sky = make_foregrounds(SyntheticSources(), template.freq_array).sky
    assert sky.Ncomponents > 200_000
    for time, frequency in zip(template.time_array[:: template.Nbls], template.freq_array, strict=True):
        slot = subset_template(template, np.array([time]), np.array([frequency]))
        expected = PyuvsimEngine().simulate(sky, embedded_beam, slot)
        assert relative_error(DenseEngine().simulate(sky, embedded_beam, slot), expected) < 1e-10
