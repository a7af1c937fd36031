"""Small observations, a Gaussian beam and simulated delay spectra for the tests of calstudy.power."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import quad


@dataclass(frozen=True)
class GaussianPowerBeam:
    """A(theta) = exp(-theta^2 / (2 sigma^2)) with sigma proportional to wavelength; integrals by quadrature."""

    sigma: float = 0.15
    reference: float = 180e6

    def power(self, theta: np.ndarray, frequency: float) -> np.ndarray:
        return np.exp(-0.5 * (theta * frequency / (self.sigma * self.reference)) ** 2)

    def solid_angles(self, frequencies: np.ndarray, pol: str) -> tuple[np.ndarray, np.ndarray]:
        assert pol in ("xx", "yy")

        def integral(frequency: float, exponent: int) -> float:
            return 2 * np.pi * quad(lambda t: self.power(t, frequency) ** exponent * np.sin(t), 0, np.pi / 2)[0]

        return tuple(np.array([integral(f, exponent) for f in frequencies]) for exponent in (1, 2))


@dataclass(frozen=True)
class TabulatedBeam:
    """The same solid angles at every call, for tests that call often."""

    angles: tuple[np.ndarray, np.ndarray]

    def solid_angles(self, frequencies: np.ndarray, pol: str) -> tuple[np.ndarray, np.ndarray]:
        return self.angles


@pytest.fixture(scope="session")
def tabulate():
    """Return a function that fixes a beam's solid angles at some frequencies."""
    return lambda beam, frequencies: TabulatedBeam(beam.solid_angles(frequencies, "xx"))


@pytest.fixture(scope="session")
def beam() -> GaussianPowerBeam:
    return GaussianPowerBeam()


@pytest.fixture(scope="session")
def observe():
    """Return a function that makes the metadata of a small observation."""
    from calstudy.instrument.settings import Channels, InstrumentSettings, Times
    from calstudy.instrument.telescope import make_template

    def make(layout, n_channels=32, n_times=1, polarizations=("xx",), width=80e3, integration=2.0):
        return make_template(
            InstrumentSettings(
                layout=layout,
                channels=Channels(first="180 MHz", width=f"{width} Hz", count=n_channels),
                times=Times(count=n_times, integration=f"{integration} s"),
                polarizations=polarizations,
            )
        )

    return make


@pytest.fixture(scope="session")
def white():
    """Return a function that fills an observation with white complex noise of a standard deviation in Jy."""
    from calstudy.base.visibilities import from_cube

    def fill(template, rng, sigma=1.0):
        shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
        noise = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        return from_cube(template, sigma / np.sqrt(2) * noise)

    return fill


@pytest.fixture(scope="session")
def drifting_source():
    """Return a function that fills an observation with a source of 1 Jy that drifts over it."""
    from astropy import constants
    from astropy.coordinates import AltAz
    from astropy.time import Time

    from calstudy.base.visibilities import baseline_vectors, from_cube

    def visibilities(template, position):
        """Visibilities exp(2 pi i nu b.s / c) of a source of 1 Jy at `position`, without a beam."""
        vectors = baseline_vectors(template)
        times = np.unique(template.time_array)
        horizontal = position.transform_to(
            AltAz(obstime=Time(times, format="jd"), location=template.telescope.location)
        )
        east = np.cos(horizontal.alt) * np.sin(horizontal.az)
        north = np.cos(horizontal.alt) * np.cos(horizontal.az)
        directions = np.stack([east, north, np.sin(horizontal.alt)], axis=1).value
        delays = directions @ vectors.T / constants.c.value
        return from_cube(template, np.exp(2j * np.pi * delays[..., None, None] * template.freq_array[:, None]))

    return visibilities
