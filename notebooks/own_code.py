"""A calibrator and a sky that are not calstudy's, used in own-calibrator.ipynb: functions of standard objects only."""

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from pyradiosky import SkyModel

from calstudy.gains import make_uvcal


def sky_based(data, sky_model, rounds=30, fault=0.0):
    """Solve each channel for gains that turn the sky model into the data (StefCal, Salvini & Wijnholds 2014).

    `fault` makes the sky model imperfect: this fraction of the model of each baseline is added to it again at the edge
    of the wedge, like the error of a catalogue that lacks sources near the horizon.
    """
    lengths = np.linalg.norm(data.uvw_array, axis=1)
    late = np.exp(2j * np.pi * np.outer(lengths / 299792458.0, data.freq_array))
    sky_model.data_array = sky_model.data_array * (1 + fault * late[:, :, None])
    names = data.telescope.antenna_numbers
    first, second = (np.searchsorted(names, numbers) for numbers in (data.ant_1_array, data.ant_2_array))
    time = np.unique(data.time_array, return_inverse=True)[1]
    shape = (names.size, names.size, data.Nfreqs, data.Ntimes, data.Npols)
    measured, expected = np.zeros(shape, complex), np.zeros(shape, complex)
    for matrix, cube in ((measured, data.data_array), (expected, sky_model.data_array)):
        matrix[first, second, :, time] = cube
        matrix[second, first, :, time] = cube.conj()
    gains = np.ones(shape[1:], complex)
    for step in range(rounds):
        # With the gains of the other antennas held, those of each antenna are a linear fit.
        model = expected * gains.conj()[None]
        fitted = (measured * model.conj()).sum(axis=1) / (abs(model) ** 2).sum(axis=1)
        gains = fitted if step % 2 == 0 else (gains + fitted) / 2
    return make_uvcal(data, gains), sky_model


def few_bright(frequencies, count=50, seed=1):
    """Scatter `count` sources over the sky, 100 Jy and less at the middle of the band, with spectral index -0.8."""
    random = np.random.default_rng(seed)
    middle = frequencies.mean()
    stokes = np.zeros((4, 1, count)) * units.Jy
    stokes[0, 0] = 100 * (1 + np.arange(count)) ** -0.7 * units.Jy
    return SkyModel(
        name=[f"source{number}" for number in range(count)],
        skycoord=SkyCoord(
            random.uniform(0, 360, count), np.degrees(np.arcsin(random.uniform(-1, 1, count))), unit="deg"
        ),
        stokes=stokes,
        spectral_type="spectral_index",
        spectral_index=np.full(count, -0.8),
        reference_frequency=np.full(count, middle) * units.Hz,
        component_type="point",
    )
