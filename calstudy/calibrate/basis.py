"""The foreground basis: discrete prolate spheroidal sequences in frequency, shared by baselines of like length.

Paper Eq. FGMODEL models each intrinsic visibility as a sum of DPSS (Slepian 1978) whose delays reach the horizon of its
baseline. Half-widths are rounded up to a step, so that baselines fall into buckets with one basis each and no basis is
padded with zeros.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.constants import speed_of_light
from scipy.signal.windows import dpss

from calstudy.calibrate.settings import BasisSettings

# Sequences asked for beyond the Shannon number 2NW; concentrations fall to 1e-14 well within these.
EXTRA_SEQUENCES = 40


@dataclass(frozen=True, eq=False)
class Bucket:
    """Models that share one basis.

    Attributes
    ----------
    half_width
        Largest modelled delay, in s.
    members
        Indices of the models in this bucket, shape (Nmembers,).
    vectors
        Orthonormal sequences, shape (Nfreqs, Nvec), float64.
    """

    half_width: float
    members: np.ndarray
    vectors: np.ndarray


@dataclass(frozen=True, eq=False)
class ForegroundBasis:
    """The bases of all foreground models (one model per baseline, or one per redundant group).

    Attributes
    ----------
    buckets
        Every model is a member of exactly one bucket.
    n_models, n_frequencies
        Number of models and of channels.
    """

    buckets: tuple[Bucket, ...]
    n_models: int
    n_frequencies: int

    @property
    def n_coefficients(self) -> int:
        """Number of complex coefficients of all models together."""
        return sum(bucket.members.size * bucket.vectors.shape[1] for bucket in self.buckets)


def delay_half_widths(lengths: np.ndarray, settings: BasisSettings) -> np.ndarray:
    """Return the largest modelled delay of each baseline, shape (Nmodels,), in s, for `lengths` in m.

    It is ``max(horizon * length / c, min_delay) + buffer``, rounded up to a multiple of `delay_step`; autocorrelations
    have length zero.
    """
    reach = np.maximum(settings.horizon * np.asarray(lengths, float) / speed_of_light, settings.min_delay)
    # Without the inner rounding, binary dust would push exact multiples up by a whole step.
    return np.ceil(np.round((reach + settings.buffer) / settings.delay_step, 6)) * settings.delay_step


@lru_cache(maxsize=256)
def dpss_vectors(n_frequencies: int, half_bandwidth: float, eigenvalue_cutoff: float) -> np.ndarray:
    """Return the DPSS concentrated within `half_bandwidth` better than the cutoff, shape (n_frequencies, Nvec).

    Parameters
    ----------
    n_frequencies
        Length of the sequences.
    half_bandwidth
        The product NW of the number of channels, the channel width and the delay half-width.
    eigenvalue_cutoff
        Sequences with a smaller spectral concentration are left out.
    """
    n_asked = min(n_frequencies, int(2 * half_bandwidth) + EXTRA_SEQUENCES)
    vectors, concentrations = dpss(n_frequencies, half_bandwidth, Kmax=n_asked, return_ratios=True)
    # Concentrations fall monotonically until rounding; what follows the first below the cutoff is noise.
    below = concentrations < eigenvalue_cutoff
    n_kept = int(np.argmax(below)) if below.any() else n_asked
    basis = np.ascontiguousarray(vectors[:n_kept].T)
    basis.flags.writeable = False
    return basis


def channel_width(frequencies: np.ndarray) -> float:
    """Return the spacing of evenly spaced channels in Hz; ValueError if they are not evenly spaced or just one."""
    spacings = np.diff(frequencies)
    if spacings.size == 0 or not np.allclose(spacings, spacings[0], rtol=1e-3, atol=0):
        raise ValueError(
            "frequencies: the DPSS foreground basis needs at least two evenly spaced channels; "
            "fill gaps with flagged channels"
        )
    return float(abs(spacings.mean()))


def make_basis(lengths: np.ndarray, frequencies: np.ndarray, settings: BasisSettings) -> ForegroundBasis:
    """Build the foreground basis of models with the given baseline lengths (paper Eq. FGMODEL).

    Parameters
    ----------
    lengths
        Baseline length of each model in m, shape (Nmodels,); zero for autocorrelations.
    frequencies
        Channel centres in Hz, evenly spaced, shape (Nfreqs,).
    settings
        Delays that are modelled, and the eigenvalue cutoff.

    Raises
    ------
    ValueError
        If channels are not evenly spaced, a half-width is zero, or a basis would leave no channel's worth of freedom
        to the data.
    """
    n_frequencies = len(frequencies)
    width = channel_width(np.asarray(frequencies, float))
    half_widths = delay_half_widths(lengths, settings)
    buckets = []
    for half_width in np.unique(half_widths):
        if half_width <= 0:
            raise ValueError("calibration.basis: the delay half-width is 0 s; set min_delay or buffer above zero")
        product = half_width * width
        vectors = None
        if product < 0.5:
            vectors = dpss_vectors(n_frequencies, n_frequencies * product, settings.eigenvalue_cutoff)
        if vectors is None or vectors.shape[1] >= n_frequencies:
            raise ValueError(
                f"calibration.basis: a delay half-width of {half_width * 1e9:.0f} ns fills all {n_frequencies} "
                f"channels of {width / 1e3:.4g} kHz, so that foregrounds would fit any data; "
                "use shorter baselines, a smaller buffer, or more or narrower channels"
            )
        buckets.append(Bucket(float(half_width), np.flatnonzero(half_widths == half_width), vectors))
    return ForegroundBasis(tuple(buckets), len(half_widths), n_frequencies)
