"""One quantity in frequency and in delay, as in the calibration figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from calstudy.power.delay import channel_width, delay_transform, delays, make_taper

TAPER = "blackman-harris"
FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)


@dataclass(frozen=True)
class TwoDomains:
    """One or more complex spectra, (..., Nfreqs), in both domains.

    `frequency` are the channel centres, (Nfreqs,), Hz, and `delay` is ascending, (Nfreqs,), s. `transform` are
    Blackman-Harris delay transforms in the unit of `values`: a constant spectrum has its own value at zero delay.
    """

    frequency: np.ndarray
    delay: np.ndarray
    values: np.ndarray
    transform: np.ndarray

    @property
    def real(self) -> np.ndarray:
        """Real parts of the spectra for a plot against frequency, NaN where they are zero, that is flagged."""
        return np.where(self.values == 0, np.nan, self.values.real)


def in_two_domains(frequency: np.ndarray, values: np.ndarray) -> TwoDomains:
    """Transform spectra (..., Nfreqs) on channels `frequency` (Nfreqs,) Hz to delay.

    Raises ValueError if the channels are not equally spaced and ascending or do not match the spectra.
    """
    values = np.asarray(values)
    width = channel_width(frequency)
    integral = width * make_taper(TAPER, frequency.size).sum()
    transform = delay_transform(values, frequency, TAPER) / integral
    return TwoDomains(frequency, delays(frequency.size, width), values, transform)
