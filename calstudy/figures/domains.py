"""One quantity in frequency and in delay, as the calibration figures show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.constants import c

from calstudy.power.delay import channel_width, delay_transform, delays, make_taper

TAPER = "blackman-harris"


@dataclass(frozen=True)
class TwoDomains:
    """One or more spectra in both domains.

    Attributes
    ----------
    frequency
        Channel centres, (Nfreqs,), Hz.
    delay
        Ascending delays, (Nfreqs,), s.
    values
        The spectra, (..., Nfreqs) complex.
    transform
        Their Blackman-Harris delay transforms, (..., Nfreqs) complex, in the unit of `values`: a constant spectrum has
        the transform of its own value at zero delay.
    """

    frequency: np.ndarray
    delay: np.ndarray
    values: np.ndarray
    transform: np.ndarray


def in_two_domains(frequency: np.ndarray, values: np.ndarray) -> TwoDomains:
    """Transform spectra (..., Nfreqs) on equally spaced channels `frequency` (Nfreqs,) Hz to delay.

    Raises
    ------
    ValueError
        If the channels are not equally spaced and ascending or do not match the spectra.
    """
    values = np.asarray(values)
    width = channel_width(frequency)
    integral = width * make_taper(TAPER, frequency.size).sum()
    transform = delay_transform(values, frequency, TAPER) / integral
    return TwoDomains(frequency, delays(frequency.size, width), values, transform)


def horizon_delay(baseline_length: np.ndarray | float) -> np.ndarray | float:
    """Return the delay of the horizon |b|/c, in s, for lengths in m."""
    return baseline_length / c.si.value
