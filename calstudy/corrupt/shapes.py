"""Random functions of frequency that are smooth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from calstudy.base.schema import Section, choice
from calstudy.base.units import Delay


class _Shape(Section, ABC):
    @abstractmethod
    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return functions of frequency (Hz), float64, (Nfreqs, Ncomponents); their squares sum to a band mean of 1."""


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


Shape = Annotated[Polynomial | Delays, choice("kind", "polynomial")]
