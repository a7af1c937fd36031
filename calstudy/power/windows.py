"""The power spectrum of a calibrated signal without its loss, for a signal of any slope.

Of a small signal s a calibration leaves M s, which is linear in s (`calstudy.calibrate.expected_loss`). Modes of
different k mix, so that the power in a bin b of k outside the wedge is on average

    P^R_b = sum_c W_bc P_c,

where W_bc is the power in b of what is left of a signal with a power of one in bin c, inside the wedge and outside, and
none elsewhere. Rows of W are the window functions. Their sum is T of a flat spectrum, by which P^R is right for a flat
spectrum only. W^-1 P^R is right for every spectrum that is flat within each bin.

Signals are random, white within a bin, independent from one delay to the next, and the same on redundant baselines.
Power at k above the last bin counts in the last, and below the first in the first. Bins without modes outside the
wedge, or of whose own power less than `LEAST` is left, have no result: what is measured there is the power of their
neighbours. They count as having the power of the nearest bin that has a result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
from calstudy.power.spectra import BaselineModes, bins_of_k, sum_in_bins

LEAST = 0.1
"""Smallest W_bb with which a bin b has a result."""
FINER = 2
"""Signals have this many delays for each one of the band, so that they are not periodic in it."""


@dataclass(frozen=True)
class UnbiasedSpectrum:
    """A calibrated power spectrum and the same without its loss, outside the wedge; NaN in bins without a result.

    Attributes
    ----------
    k, bin_edges : centres (Nk,) and edges (Nk + 1,), h/Mpc
    window : W, (Nk, Nk)
    measured, measured_error : P^R, free of the flux scale of the calibration, and its standard deviation, (Nk,)
    power, error : W^-1 P^R and its standard deviation, (Nk,)
    signal : power of the signal itself in the same modes, (Nk,); NaN if it is not known
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    window: np.ndarray = field(metadata={"unit": ""})
    measured: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    measured_error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    signal: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})

    @property
    def flat_transfer(self) -> np.ndarray:
        """T of a flat spectrum, the sums of the window functions, (Nk,)."""
        return self.window.sum(axis=1)


def draw_in_bins(
    frequency: np.ndarray,
    lengths: np.ndarray,
    groups: tuple[np.ndarray, np.ndarray],
    edges: np.ndarray,
    cosmology: str,
    rng: np.random.Generator,
) -> Iterator[np.ndarray]:
    """Yield a signal for each bin, complex, (Nbls, Nfreqs): parts of one with a mean square of one per channel.

    Channel centres are in Hz, evenly spaced, baseline lengths in m, (Nbls,), and edges of the bins of k in h/Mpc.
    `groups` are the number of the redundant group of each baseline, and whether it is reversed in it, (Nbls,) each.
    """
    (group, conjugated), n_delays, n_bins = groups, FINER * frequency.size, edges.size - 1
    astropy, centre = make_cosmology(cosmology), float(frequency.mean())
    delay = np.fft.fftfreq(n_delays, float(np.diff(frequency).mean()))
    k = np.hypot(k_perpendicular(astropy, lengths, centre)[:, None], k_parallel(astropy, delay, centre))
    bins = np.clip(np.searchsorted(edges, k, side="left") - 1, 0, n_bins - 1)
    real, imaginary = rng.standard_normal((2, group.max() + 1, n_delays)) / np.sqrt(2 * n_delays)
    amplitudes = (real + 1j * imaginary)[group]
    for number in range(n_bins):
        signal = np.fft.ifft(np.where(bins == number, amplitudes, 0), axis=1, norm="forward")[:, : frequency.size]
        yield np.where(conjugated[:, None], signal.conj(), signal)


def window_matrix(
    modes: BaselineModes, left: tuple[np.ndarray, np.ndarray], put_in: np.ndarray, edges: np.ndarray, buffer: float
) -> np.ndarray:
    """Return W, (Nk, Nk), NaN in rows of bins without modes outside the wedge.

    `left` are amplitudes of what two fits, to data with independent noise, leave of the signals of each bin, complex,
    (Ndraws, Nk, Nbls, Ndelays). They are measured against `put_in`, the power of the amplitudes of the signals
    themselves, of all bins together, mean over draws, (Nbls, Ndelays): free of the sample variance of the signals.
    `edges` and `buffer` are as in `calstudy.power.transfer.bin_response`.
    """
    n_bins, bins = edges.size - 1, bins_of_k(modes, edges, buffer)
    even, odd = left
    power = np.mean((even.conj() * odd).real, axis=0)
    whole = sum_in_bins(put_in, bins, n_bins)
    sums = np.array([sum_in_bins(part, bins, n_bins) for part in power]).T
    return sums / np.where(whole > 0, whole, np.nan)[:, None]


def deconvolved(window: np.ndarray, power: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return W^-1 P^R and its standard deviation, (Nk,) each, for bins with independent errors.

    `window` is W, (Nk, Nk); `power` and `error` are those of P^R, (Nk,). The result is NaN where there is none.
    """
    kept = np.flatnonzero(np.isfinite(power) & np.isfinite(error) & (np.nan_to_num(window).diagonal() > LEAST))
    found, errors = np.full(power.size, np.nan), np.full(power.size, np.nan)
    if kept.size:
        nearest = np.abs(np.arange(power.size)[:, None] - kept).argmin(axis=1)
        folded = np.zeros((kept.size, kept.size))
        np.add.at(folded.T, nearest, window[kept].T)
        inverse = np.linalg.inv(folded)
        found[kept], errors[kept] = inverse @ power[kept], np.sqrt(inverse**2 @ error[kept] ** 2)
    return found, errors
