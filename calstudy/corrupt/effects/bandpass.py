"""Gains that are smooth in frequency."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from calstudy.base.schema import Section, choice
from calstudy.base.units import Delay
from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class _Shape(Section, ABC):
    @abstractmethod
    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return functions of frequency, float64, (Nfreqs, Ncomponents), whose squares add up to 1 in the band's mean.

        Parameters
        ----------
        frequencies
            Channel centres, Hz, (Nfreqs,).
        """


class Polynomial(_Shape):
    """Legendre polynomials over the band, up to an order, of equal rms."""

    kind: Literal["polynomial"]
    order: int = Field(3, ge=0, le=20, description="Highest order; 0: one number for all channels.")

    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the polynomials, of equal rms over the channels."""
        middle = (frequencies.max() + frequencies.min()) / 2
        place = (frequencies - middle) / max(np.ptp(frequencies) / 2, 1.0)
        values = np.polynomial.legendre.legvander(place, self.order)
        return values / np.sqrt(np.mean(values**2, axis=0) * values.shape[1])


class Delays(_Shape):
    """A Gaussian process with a flat delay spectrum up to a delay, hence a sum of DPSS with their concentrations."""

    kind: Literal["delays"]
    max_delay: Delay = Field(100e-9, gt=0, description="Largest delay of the structure.")

    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the symmetric root of the covariance sin(2 pi tau nu) / (2 pi tau nu) between channels."""
        covariance = np.sinc(2 * self.max_delay * (frequencies[:, None] - frequencies))
        values, vectors = np.linalg.eigh(covariance)
        # Unlike the eigenvectors, whose signs and order are arbitrary, the root is unique.
        return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


Shape = Annotated[Polynomial | Delays, Field(discriminator="kind"), choice("kind", "polynomial")]


class Bandpass(GainEffect):
    """g = 1 + sigma (x + i y), with x and y smooth in frequency, of unit variance, independent for every antenna."""

    version: ClassVar[int] = 2

    sigma: float = Field(
        0.1,
        ge=0,
        le=1,
        description="rms over the band of the real and of the imaginary part of g - 1, each; the default is a "
        "choice of this project.",
    )
    shape: Shape = Polynomial(kind="polynomial")
    seed: int = Field(11, ge=0, description="Seed of x and y.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1, Npols), with an independent draw for every polarization."""
        components = self.shape.components(observation.frequencies)
        shape = observation.n_antennas, observation.n_polarizations, components.shape[1]
        real, imaginary = random.standard_normal((2, *shape)) @ components.T
        return np.moveaxis(1 + self.sigma * (real + 1j * imaginary), 2, 1)[:, :, None]
