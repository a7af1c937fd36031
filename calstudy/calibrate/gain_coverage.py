"""Whether errors of gains cover: deviations from the true gains in units of their errors, and fractions of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.constants import SIGMAS_95

if TYPE_CHECKING:
    from calstudy.calibrate.gain_errors import GainErrors

EXPECTED = np.arange(1, 100) / 100
"""Fractions of a normal distribution within limits around zero, with which those of the deviations are compared."""
LIMITS = (1.0, SIGMAS_95)
"""Limits in units of the error, within which there are 68.3 and 95 %."""


def pulls(errors: GainErrors, gains: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return deviations from the true gains over their errors, of amplitudes and phases, (2, Nants, Nfreqs).

    Gains are complex, (Nants, Nfreqs). What errors leave out is taken out of the deviations. NaN for gains without
    error.
    """
    known = np.isfinite(errors.phase)
    ratio = np.divide(gains, true, out=np.ones(gains.shape, complex), where=known)
    # The common phase of a channel may be anywhere, and logarithms are of what is close to one.
    common = np.sum(np.where(known, np.abs(gains) ** 2 * ratio / np.abs(ratio), 0), axis=0)
    change = errors.determined(np.log(ratio * np.exp(-1j * np.angle(common))))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([change.real * np.abs(gains) / errors.amplitude, change.imag / errors.phase])


@dataclass(frozen=True)
class GainCoverage:
    """Fractions of the pulls of several solves.

    Attributes
    ----------
    observed : of amplitudes and of phases within the limits of the fractions `EXPECTED`, (Nsolves, 2, Nexpected)
    within : the same of each antenna within `LIMITS`, (Nsolves, 2, Nants, 2); NaN for antennas without errors
    """

    observed: np.ndarray
    within: np.ndarray

    @classmethod
    def of(cls, found: list[np.ndarray]) -> GainCoverage:
        """Return the fractions of the pulls of each solve, (2, Nants, Nfreqs)."""
        from scipy.stats import norm

        limits = norm.ppf((1 + EXPECTED) / 2)
        return cls(
            np.array([[_fractions(part.ravel(), limits) for part in solve] for solve in found]),
            np.array([[[_fractions(row, np.array(LIMITS)) for row in part] for part in solve] for solve in found]),
        )


def _fractions(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the fractions of the known values whose size is below each limit; NaN if none is known."""
    known = np.sort(np.abs(values[np.isfinite(values)]))
    return np.searchsorted(known, limits) / known.size if known.size else np.full(limits.shape, np.nan)
