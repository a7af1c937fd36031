r"""The power that errors of gains add to a power spectrum, to second order in the variance of the errors.

The errors e_a = g_a - 1 have real and imaginary parts that are independent, of variance v each, with the correlation C
in frequency and R in time; antennas have the part c of the variance in common. Data that are not calibrated keep the
residual V_ab (e_a + e_b* + e_a e_b*) of the foregrounds V_ab. Besides its mean, which is smooth in frequency, the
factor of V_ab has the covariance

- 4 v C R + 4 v^2 C^2 R^2 in one baseline, whatever c: a common error adds 2 Re e, of the variance of e_a + e_b*;
- 4 v c C R + 4 v^2 c^2 C^2 R^2 between two baselines of a redundant group, also if they have an antenna in common: it
  is the first of one and the second of the other, and e and e* of circular errors have no correlation.

The expected power is that of the foregrounds convolved in delay with the delay spectrum of this covariance. Both noise
realizations have the same gains, and each power has the same expectation, so that averaging powers over baselines and
blocks of time reduces nothing. The coherent average over a block multiplies R by its mean over pairs of integrations.
This takes the foregrounds, fringe-stopped, for constant during a block.

Spectra at as many delays as channels hold the correlation of the foregrounds at a separation together with that at the
rest of the band, of which the taper leaves a few per cent at half the band. The covariance must have fallen by there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from calstudy.power.clusters import clusters_in_k

if TYPE_CHECKING:
    from calstudy.power.spectra import DelaySpectra


@dataclass(frozen=True)
class ErrorCovariance:
    """Second moments of errors of gains, over the variance of their real part.

    `channels` is C at separations of 0, 1, ... N - 1 channels, (N,), for as many channels as delays; `times` is R
    between the integrations of a block, (n, n), and `common` is c, from 0 to 1.
    """

    channels: np.ndarray
    times: np.ndarray
    common: float = 0.0


@dataclass(frozen=True)
class GainBias:
    """What is expected of errors of gains in Nk bands of k, if nothing is calibrated.

    Attributes
    ----------
    sigma : rms of the real part of the errors
    length, time, common : correlation length and time (NaN: constant), and the part that antennas share
    form : of the correlation in frequency
    bin_edges : of the bands, (Nk + 1,)
    bias : over the EoR, (Nk,); NaN for errors that are correlated over the band
    terms : factors of sigma^2 and sigma^4 in it, (2, Nk)
    lengths : other correlation lengths, ascending, (Nl,)
    terms_at : the same factors for these, (Nl, 2, Nk)
    """

    sigma: float = field(metadata={"unit": ""})
    length: float = field(metadata={"unit": "Hz"})
    time: float = field(metadata={"unit": "s"})
    common: float = field(metadata={"unit": ""})
    form: str = field(metadata={"unit": ""})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bias: np.ndarray = field(metadata={"unit": ""})
    terms: np.ndarray = field(metadata={"unit": ""})
    lengths: np.ndarray = field(metadata={"unit": "Hz"})
    terms_at: np.ndarray = field(metadata={"unit": ""})


FALLEN = 1e-4
"""Largest covariance of smooth errors, over the variance, at a separation of half the band."""


def exponential(count: int, integration: float, time: float | None) -> np.ndarray:
    """Return R = exp(-t / time) between `count` integrations, (count, count); 1 if `time` is None. Both are in s."""
    if time is None:
        return np.ones((count, count))
    place = np.arange(count)
    return np.exp(-np.abs(place[:, None] - place) * integration / time)


def added_power(foregrounds: DelaySpectra, errors: ErrorCovariance) -> np.ndarray:
    """Return the factors of v and v^2 in the expected power, (2, Nu, Nd), in the unit of the foregrounds' power."""
    n = foregrounds.delay.size
    lag = np.arange(n)
    channels = errors.channels[np.minimum(lag, n - lag)]
    # In the order of the delays, zero is in the middle.
    lags = np.fft.fft(np.fft.ifftshift(foregrounds.power.real, axes=1), axis=1)
    found = []
    for order in (1, 2):
        part = np.where(foregrounds.n_pairs > 1, errors.common**order, 1.0)
        scale = 4 * np.mean(errors.times**order) * part[:, None]
        convolved = np.fft.ifft(lags * channels**order, axis=1).real
        found.append(scale * np.fft.fftshift(convolved, axes=1))
    return np.stack(found)


def bias_terms(
    foregrounds: DelaySpectra, signal: DelaySpectra, errors: ErrorCovariance, edges: ArrayLike, buffer: float
) -> np.ndarray:
    """Return the factors of v and v^2 in the bias P / P^S outside the wedge, in bins of |k|, (2, Nk).

    `edges` and `buffer` are as in `calstudy.power.clusters.clusters_in_k`; foregrounds and signal have the same units.
    """
    clusters = clusters_in_k(signal, np.asarray(edges, dtype=float), buffer, inside=False)
    total = clusters.powers(signal).total
    unknown = np.zeros_like(foregrounds.share_power)
    terms = [replace(foregrounds, power=power, share_power=unknown) for power in added_power(foregrounds, errors)]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([clusters.powers(term).total / total for term in terms])


def tolerated_sigma(terms: np.ndarray, limit: float) -> np.ndarray:
    """Return the rms at which the bias is `limit`, by `terms` (2, ...) of `bias_terms`; infinite if it never is."""
    first, second = np.maximum(terms, 0)
    root = first + np.sqrt(first**2 + 4 * limit * second)
    return np.sqrt(np.divide(2 * limit, root, out=np.full(np.shape(root), np.inf), where=root > 0))
