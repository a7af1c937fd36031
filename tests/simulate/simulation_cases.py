"""Small observations, skies and beams for the simulators."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import AltAz, SkyCoord
from astropy.time import Time
from pyradiosky import SkyModel

from calstudy.base.visibilities import subset_template
from calstudy.instrument import settings as instrument
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.telescope import make_template
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import FftvisEngine, MatvisEngine, PyuvsimEngine, missing_package

needs_engines = pytest.mark.skipif(any(map(missing_package, ("matvis", "fftvis"))), reason="needs the extra [engines]")
FAST_ENGINES = [
    pytest.param(DenseEngine(), id="dense"),
    pytest.param(MatvisEngine(), id="matvis", marks=needs_engines),
    pytest.param(FftvisEngine(), id="fftvis", marks=needs_engines),
]
"""All but pyuvsim, the reference."""
ALL_ENGINES = [*FAST_ENGINES, pytest.param(PyuvsimEngine(), id="pyuvsim")]


def observe(count=5, channels=3, width="4 MHz", times=3, integration="56 s", polarizations=("xx", "yy")):
    """Return the template of a few MWA tiles, at their real heights, over the paper's band and time."""
    template = make_template(
        instrument.InstrumentSettings(
            layout=MwaLayout(count=count),
            channels=instrument.Channels(first="170 MHz", width=width, count=max(8, channels)),
            times=instrument.Times(count=times, integration=integration),
            polarizations=polarizations,
        )
    )
    return subset_template(template, template.time_array[:: template.Nbls], template.freq_array[:channels])


def point_sky(coordinates, flux, spectral_index=None, polarization=(0, 0, 0)):
    """Return points with the flux densities (Jy) at 180 MHz, and Q, U and V as fractions of these."""
    count = len(flux)
    stokes = np.zeros((4, 1, count))
    stokes[:, 0] = np.outer([1, *polarization], flux)
    spectrum = {"spectral_type": "flat"}
    if spectral_index is not None:
        spectrum = {
            "spectral_type": "spectral_index",
            "spectral_index": np.asarray(spectral_index),
            "reference_frequency": np.full(count, 180e6) * units.Hz,
        }
    names = [f"source {number}" for number in range(count)]
    return SkyModel(name=names, skycoord=coordinates, stokes=stokes * units.Jy, **spectrum)


def local_coordinates(template, altitude, azimuth):
    """Return ICRS coordinates of directions (rad) at the middle of an observation."""
    middle = Time(np.median(template.time_array), format="jd", location=template.telescope.location)
    frame = AltAz(obstime=middle, location=template.telescope.location)
    return SkyCoord(azimuth * units.rad, altitude * units.rad, frame=frame).icrs


def random_sky(template, count=120, seed=5):
    """Return sources all over the sky with spectral indices, some at the horizon and some that rise or set."""
    rng = np.random.default_rng(seed)
    altitude = np.arcsin(rng.uniform(-0.3, 1, count))
    # The Earth turns by 0.47 degrees in 112 s.
    altitude[: count // 3] = np.deg2rad(rng.uniform(-0.4, 0.4, count // 3))
    coordinates = local_coordinates(template, altitude, rng.uniform(0, 2 * np.pi, count))
    return point_sky(coordinates, rng.exponential(1, count), rng.normal(-0.8, 0.3, count))


def healpix_sky(frequencies, nside=8, seed=6):
    """Return independent brightness temperatures (K) for every pixel and channel."""
    rng = np.random.default_rng(seed)
    pixels = np.arange(12 * nside**2)
    stokes = np.zeros((4, len(frequencies), len(pixels)))
    stokes[0] = rng.normal(0, 3, stokes.shape[1:])
    return SkyModel(
        component_type="healpix",
        nside=nside,
        hpx_order="ring",
        hpx_inds=pixels,
        frame="icrs",
        stokes=stokes * units.K,
        spectral_type="full",
        freq_array=frequencies * units.Hz,
        run_check=False,  # It warns that brightness differences are negative.
    )


def relative_error(cube, reference):
    """Return the largest difference over the rms of the reference."""
    return np.abs(cube - reference).max() / np.sqrt(np.mean(np.abs(reference) ** 2))
