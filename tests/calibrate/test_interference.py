"""Interference that is put into data is found, and little else."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyuvdata import UVData
from toy import make_toy, scattered
from toy_data import make_uvdata

from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, flag_cube, to_cube
from calstudy.realdata.interference import flag_interference, quiet_band
from calstudy.realdata.noise import uncorrelated
from calstudy.realdata.reading import prepare, read_visibilities
from calstudy.realdata.selection import Selection
from calstudy.realdata.settings import Interference, find_data

N_TIMES, NOISE = 24, 0.05
ALWAYS, SOMETIMES = 20, (9, 30)
"""Channels of a station that is on all the time, and of one that is on in some integrations."""
INTEGRATIONS = (4, 5, 13)
SHORT = (7, 15)
"""Channels and integration of what is seen once, in a narrow band."""


@pytest.fixture(scope="module")
def clean() -> UVData:
    """Noise, and foregrounds that are smooth in frequency, as data are under a smooth bandpass."""
    toy = make_toy(scattered(8))
    uvd = make_uvdata(replace(toy, gains=np.ones_like(toy.gains)), N_TIMES)
    draws = np.random.default_rng(5).normal(size=(2, *uvd.data_array.shape))
    scale = np.sqrt(np.mean(np.abs(uvd.data_array) ** 2))
    uvd.data_array += NOISE * scale * (draws[0] + 1j * draws[1]) / np.sqrt(2)
    return uvd


def spoiled(clean: UVData) -> tuple[UVData, np.ndarray]:
    """Return data with interference of as much as the data, and where it is, (Ntimes, Nfreqs)."""
    data, where = clean.copy(), np.zeros((N_TIMES, clean.Nfreqs), bool)
    where[:, ALWAYS] = True
    where[np.ix_(INTEGRATIONS, SOMETIMES)] = True
    where[SHORT[1], SHORT[0]] = True
    phases = np.random.default_rng(6).uniform(0, 2 * np.pi, (N_TIMES, clean.Nbls, clean.Nfreqs))
    scale = np.sqrt(np.mean(np.abs(clean.data_array) ** 2))
    to_cube(data)[..., 0] += 3 * scale * where[:, None] * np.exp(1j * phases)
    return data, where


def test_interference_is_flagged_in_all_baselines_and_little_else(clean):
    data, where = spoiled(clean)
    told = flag_interference(data, Interference())
    flags = flag_cube(data)[..., 0]
    assert (flags == flags[:, :1]).all()
    assert flags[:, 0][where].all()
    # Neighbours are flagged if they stand out by 2 sigma, and channels as a whole.
    places = np.array([ALWAYS, *SOMETIMES, SHORT[0]])
    far = np.abs(np.arange(clean.Nfreqs)[:, None] - places).min(axis=1) > 1
    assert flags[:, 0, far].mean() < 0.005
    assert f"{clean.freq_array[ALWAYS] / 1e6:.3f}" in told
    assert told.startswith(f"Interference: {100 * flags.mean():.1f} % of the samples")


def test_noise_is_not_interference(clean):
    data = clean.copy()
    flag_interference(data, Interference())
    assert data.flag_array.mean() < 0.005


def flagged_before(name: str, antennas: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Flags as data have them, (Ntimes, Nbls, Nfreqs)."""
    flags = np.zeros(shape, bool)
    of_antenna = (antennas == antennas[0, 0]).any(axis=1)
    if name == "a dead antenna":
        flags[:, of_antenna] = True
    elif name == "a gap":
        flags[:, :, 40:52] = True
    elif name == "half of the integrations":
        flags[1::2] = True
    elif name == "edges of coarse channels":
        flags[:, :, ::8] = flags[:, :, 7::8] = True
    else:
        flags[:, of_antenna, 33:48] = True
    return flags


@pytest.mark.chain
@pytest.mark.parametrize(
    "name",
    ["a dead antenna", "a gap", "half of the integrations", "edges of coarse channels", "channels of an antenna"],
)
def test_flagged_samples_do_not_take_part_and_stay_flagged(clean, name):
    shape = (N_TIMES, clean.Nbls, clean.Nfreqs)
    before = flagged_before(name, antenna_pairs(clean), shape)
    data = clean.copy()
    flag_cube(data)[..., 0] = before
    to_cube(data)[before] = np.nan
    flag_interference(data, Interference())
    flags = flag_cube(data)[..., 0]
    assert flags[before].all()
    assert flags[~before].mean() < 0.01
    # What is there besides is found as without these flags.
    data, where = spoiled(clean)
    flag_cube(data)[..., 0] = before
    to_cube(data)[before] = 0
    flag_interference(data, Interference())
    assert flag_cube(data)[..., 0][:, clean.Nbls // 2][where].all()


def test_the_unit_of_the_data_does_not_matter(clean):
    found = []
    for scale in (1.0, 1e-9):
        data, _ = spoiled(clean)
        data.data_array = (scale * data.data_array).astype(np.complex64)
        flag_interference(data, Interference())
        found.append(data.flag_array)
    np.testing.assert_array_equal(*found)


def test_a_burst_in_one_of_many_integrations_leaves_its_channel(clean):
    """Of 24 integrations one is less than a twentieth, and the channel stays."""
    data = clean.copy()
    to_cube(data)[7, :, 15] *= 50
    flag_interference(data, Interference())
    flags = flag_cube(data)[:, 0, :, 0]
    assert flags[7, 15]
    assert flags.sum() < 6


@pytest.mark.parametrize(("times", "told"), [(1, "the data have 1 and 64"), (2, "the data have 2 and 64")])
def test_too_few_integrations_are_refused(clean, times, told):
    data = clean.select(times=np.unique(clean.time_array)[:times], inplace=False)
    with pytest.raises(InputError, match=told):
        flag_interference(data, Interference())


def test_the_fractions_are_of_samples_that_are_not_flagged(clean):
    """A station in a tenth of the baselines: its channel is flagged, also if most integrations are flagged before."""
    data = clean.copy()
    to_cube(data)[:, :3, ALWAYS] *= 50
    flag_cube(data)[6:] = True
    flag_interference(data, Interference())
    flags = flag_cube(data)[:6, 0, :, 0]
    assert flags[:, ALWAYS].all()
    assert flags.mean() < 0.05


def test_three_integrations_of_noise_are_enough(clean):
    data = clean.select(times=np.unique(clean.time_array)[:3], inplace=False)
    flag_interference(data, Interference())
    assert data.flag_array.mean() < 0.01


def test_the_stations_that_hera_sees_are_found():
    """Satellites at 137.5, 149.9 and 157.8 MHz; a hundredth of the band is interference at this site and time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = read_visibilities([find_data("hera_qm:data/zen.2457698.40355.xx.HH.uvh5", Path())])
        data, _ = prepare(data, Selection())
    told = flag_interference(data, Interference())
    channels = np.ravel(data.freq_array)[flag_cube(data).all(axis=(0, 1, 3))] / 1e6
    assert all(np.abs(channels - place).min() < 0.05 for place in (137.5, 149.9, 157.8))
    assert 0.005 < data.flag_array.mean() < 0.03
    assert "in more than half of the integrations at 137.500" in told


def test_autocorrelations_alone_are_refused(clean):
    autos = clean.copy()
    autos.ant_2_array = autos.ant_1_array.copy()
    with pytest.raises(InputError, match="is for cross-correlations, and the data hold none"):
        flag_interference(autos, Interference())


def test_the_quiet_band_is_the_longest_without_interference_or_flags(clean):
    assert quiet_band(clean.copy()) is None
    data, _ = spoiled(clean)
    assert quiet_band(data.copy()) == (data.freq_array[SOMETIMES[1] + 1], data.freq_array[-1])
    data = clean.copy()
    data.flag_array[:, 40:45] = True
    assert quiet_band(data) == (data.freq_array[0], data.freq_array[39])


def test_antennas_without_a_signal_are_named_unless_they_are_half(clean):
    assert uncorrelated(clean) == []
    data = clean.copy()
    data.data_array[(data.ant_1_array == 12) | (data.ant_2_array == 12)] = 0
    data.flag_array[(data.ant_1_array == 16) | (data.ant_2_array == 16)] = True
    assert uncorrelated(data) == [12, 16]
    data.flag_array[data.ant_2_array > 16] = True
    assert uncorrelated(data) == []


def test_an_antenna_of_noise_is_named_without_autocorrelations_as_well(clean):
    data = clean.copy()
    dead = (data.ant_1_array == 12) | (data.ant_2_array == 12)
    # Of an amplifier whose antenna is not connected: 2 % of the noise of the others.
    data.data_array[dead] *= 1e-3
    assert uncorrelated(data) == [12]
    # Cross-hands of noise in all antennas say nothing.
    crossed = clean.copy()
    crossed.polarization_array = np.array([-7])
    crossed.data_array[:] = 1e-3 * np.random.default_rng(3).normal(size=crossed.data_array.shape)
    both = data.copy()
    both.fast_concat(crossed, "polarization", inplace=True)
    assert uncorrelated(both) == [12]
    # Antennas that differ in gain by ten see the sky.
    data.data_array[dead] = clean.data_array[dead] / 10
    assert uncorrelated(data) == []


def test_zeros_of_an_antenna_are_not_interference(clean):
    data, _ = spoiled(clean)
    zero = (data.ant_1_array == 12) | (data.ant_2_array == 12)
    left = data.select(blt_inds=np.flatnonzero(~zero), inplace=False)
    data.data_array[zero] = 0
    for each in (data, left):
        flag_interference(each, Interference())
    assert np.array_equal(flag_cube(data)[:, 0], flag_cube(left)[:, 0])


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        # Antennas 65 and 93 correlate with none, and 116 with its neighbour alone; of all three the power is far lower.
        ("zen.2459122.49827.sum.downselected.uvh5", [65, 93, 116]),
        ("zen.2457698.40355.xx.HH.uvh5", [81]),
    ],
)
def test_antennas_of_hera_that_see_no_sky_are_named(name, lost):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data, _ = prepare(read_visibilities([find_data(f"hera_qm:data/{name}", Path())]))
    assert uncorrelated(data) == lost
