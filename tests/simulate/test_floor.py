"""The delay floor of visibilities whose floor is known."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import observe, random_sky

from calstudy.base.visibilities import baseline_vectors, from_cube
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.floor import delay_floor


@pytest.fixture(scope="module")
def template():
    return observe(count=6, channels=384, width="80 kHz", times=2, integration="8 s", polarizations=("xx",))


def tones(template, level, delay):
    """Return unit visibilities at zero delay with a tone of relative amplitude `level` at a delay."""
    spectrum = 1 + level * np.exp(2j * np.pi * delay * template.freq_array)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    return from_cube(template, np.broadcast_to(spectrum[:, None], shape))


@pytest.mark.parametrize("taper", ["blackman-harris", "dolph-chebyshev"])
def test_a_tone_beyond_the_horizon_is_found_at_its_level(template, taper):
    resolution = 1 / (template.Nfreqs * 80e3)
    floor = delay_floor(tones(template, 1e-4, 60 * resolution), buffer=400e-9, taper=taper)
    filled = np.isfinite(floor.max_db)
    np.testing.assert_allclose(floor.max_db[filled], -40, atol=0.05)
    assert (floor.rms_db[filled] < floor.max_db[filled]).all()


def test_a_tone_within_the_horizon_and_buffer_does_not_count(template):
    floor = delay_floor(tones(template, 1e-2, 250e-9), buffer=600e-9, taper="dolph-chebyshev")
    assert floor.worst_db < -70


def test_smooth_foregrounds_reach_the_sidelobes_of_the_taper_and_no_more(template, gaussian_beam):
    sky = random_sky(template)
    foregrounds = from_cube(template, DenseEngine().simulate(sky, gaussian_beam, template))
    blackman_harris = delay_floor(foregrounds, buffer=200e-9)
    assert -55 < blackman_harris.worst_db < -43
    assert delay_floor(foregrounds, buffer=300e-9, taper="dolph-chebyshev").worst_db < -70
    lengths = np.linalg.norm(baseline_vectors(template), axis=1)
    assert np.isfinite(blackman_harris.max_db).sum() == len(np.unique(np.digitize(lengths, blackman_harris.edges)))


def test_channels_too_wide_for_the_buffer_are_an_error(template):
    with pytest.raises(ValueError, match="channels are too wide"):
        delay_floor(tones(template, 0.1, 1e-7), buffer=1e-5)
