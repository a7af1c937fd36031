r"""Window functions of a calibrated power spectrum, and the spectrum without what the calibration did to it.

To first order a fit leaves D = M S of the EoR S (`calstudy.calibrate.expected_loss`). M mixes delays: near the wedge it
takes some modes, and moves power between bins of k. T = P^D / P^S then depends on the slope of P(k) (a T of one EoR
corrects no other), and what is lost of one bin cannot be told from what came from another.

S is cut into parts S_j by |k|, inside the wedge and outside: a mode between the centres k_j and k_j+1 of two bins has a
share of its power in the parts of both, so that P(k) is linear between the centres; below the first and above the last
it is constant. Different modes are independent. For such a P(k), the same at all modes of one |k|, on average

    P^S = A p,   P^D = B p,   A_ij = P_i(S_j),   B_ij = P_i(M S_j),

with P_i(X) the power of X in bin i outside the wedge, and p_j the P(k_j) over that of the simulated EoR. A has the
windows of the taper, B those of taper and calibration. The estimate

    P = U P^R,   U = A B^-1,

has the windows of A: it is what the spectrum would be without calibration. Deconvolving the taper as well, B^-1 P^R,
would multiply the noise by the condition of A for little: the windows of A are a bin wide.

B is the mean of Re (M S_j)* (M' S_j) over the modes of a bin, where M and M' are those of the fits of two realizations
of the noise, as P^R is even times odd. A and B come from one simulated EoR with another seed than that of the data. It
is flat, so that P(k) itself is taken to be linear within a bin. For P(k) of k^-2.5 that leaves some per cent next to the
wedge at k of 0.1 h/Mpc, where P(k) bends within a bin and T changes there.

Bins stay out of which less than `LEAST_KEPT` is left, and those where the fits do not follow their linear response
(`follows`). Neighbouring bins of the estimate are correlated, since U mixes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from calstudy.power.spectra import BaselineModes, SphericalSpectrum

LEAST_KEPT = 0.5
"""B_ii / A_ii below which bin i is not estimated."""
LARGEST_DIFFERENCE = 0.1
"""Of T of the linear response from the measured one, as a part of it, where a bin is estimated. Both are of the EoR in
the data, whose sample variance they share. The difference is a part of the error."""


@dataclass(frozen=True)
class Windows:
    """The windows of a calibrated spectrum in Nk bins of |k|, of which some are estimated.

    Attributes
    ----------
    k, bin_edges
        Centres (Nk,) and edges (Nk + 1,), h/Mpc.
    estimated
        Whether the power of a bin is estimated, (Nk,) bool.
    undo
        U, (Nk, Nk), from P^R to the power without calibration; rows and columns of other bins are zero.
    before, after
        Windows without calibration and after it: the part of the power in a bin i that is from part j, for a flat P(k),
        (Nk, Nk); NaN in bins without modes.
    transfer
        T of a flat P(k) to first order, (Nk,).
    linear, measured
        T of the EoR in the data, to first order and as injection measures it, both free of the flux scale, (Nk,).
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    estimated: np.ndarray = field(metadata={"unit": ""})
    undo: np.ndarray = field(metadata={"unit": ""})
    before: np.ndarray = field(metadata={"unit": ""})
    after: np.ndarray = field(metadata={"unit": ""})
    transfer: np.ndarray = field(metadata={"unit": ""})
    linear: np.ndarray = field(metadata={"unit": ""})
    measured: np.ndarray = field(metadata={"unit": ""})


@dataclass(frozen=True)
class UnbiasedSpectrum:
    """U P^R and what it is compared with, in Nk bins of |k| outside the wedge; NaN where it is not estimated.

    Attributes
    ----------
    k, bin_edges
        Centres (Nk,) and edges (Nk + 1,), h/Mpc.
    power, error
        U P^R on the true flux scale, and its standard deviation about P^S, (Nk,).
    signal
        P^S, (Nk,).
    divided
        P^R / T with T of a flat P(k), on the true flux scale, (Nk,).
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    signal: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    divided: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})


@dataclass(frozen=True)
class Responses:
    """What calibrations leave of the parts of a simulated EoR, and of the EoR in the data.

    Attributes
    ----------
    put_in, left
        A and B, by bin and part, (Nk, Nk + 1); the last part is the EoR in the data. NaN in bins without modes.
    level
        Power of the simulated EoR at the modes of each bin, inside the wedge and outside, (Nk,).
    """

    put_in: np.ndarray
    left: np.ndarray
    level: np.ndarray


def bins_of(modes: BaselineModes, edges: np.ndarray) -> np.ndarray:
    """Return the bin of |k| of each mode, (Nbls, Ndelays): -1 below the first edge, Nk above the last."""
    return np.searchsorted(edges, np.hypot(modes.k_perp[:, None], modes.k_parallel), side="left") - 1


def parts_in_k(signal: np.ndarray, k: np.ndarray, centres: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the parts of a signal, one for each node of k, whose powers add up to that of the signal.

    A mode between two nodes has a share of its power in the parts of both; one beyond the last is in its part.

    Parameters
    ----------
    signal
        Visibilities on evenly spaced channels, (Nbls, Nfreqs), complex.
    k
        Of each mode at ascending delays, (Nbls, Nfreqs).
    centres
        The nodes, evenly spaced, (Nk,).
    """
    modes = np.fft.fftshift(np.fft.ifft(signal, axis=1), axes=1)
    place = np.clip((k - centres[0]) / (centres[1] - centres[0]), 0, centres.size - 1)
    for number in range(centres.size):
        share = np.clip(1 - np.abs(place - number), 0, None)
        yield np.fft.fft(np.fft.ifftshift(np.sqrt(share) * modes, axes=1), axis=1)


def power_in_bins(even: np.ndarray, odd: np.ndarray, bins: np.ndarray, n_bins: int) -> np.ndarray:
    """Return the mean over modes of Re(even* odd) in each bin, (Nk, Nparts), from (..., Nparts, Nmodes); NaN if empty.

    `bins` are those of the modes, (Nmodes,).
    """
    product = np.real(even.conj() * odd)
    parts = product.reshape(-1, *product.shape[-2:]).mean(axis=0)
    count = np.bincount(bins, minlength=n_bins).astype(float)
    count[count == 0] = np.nan
    return np.stack([np.bincount(bins, part, n_bins) / count for part in parts], axis=1)


def follows(linear: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return whether a measured T is that of the linear response to the same EoR, (Nk,) bool."""
    return np.abs(measured - linear) <= LARGEST_DIFFERENCE * measured


def windows(edges: np.ndarray, responses: Responses, measured: np.ndarray) -> Windows:
    """Return the windows; `edges` of the bins are in h/Mpc, (Nk + 1,), and T is `measured` on the true flux scale."""
    n_bins = edges.size - 1
    put_in, left, level = responses.put_in[:, :-1], responses.left[:, :-1], responses.level
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = responses.left[:, -1] / responses.put_in[:, -1]
        estimated = follows(linear, measured) & (np.diag(left) > LEAST_KEPT * np.diag(put_in))
        flat_in, flat_left = (np.where(level > 0, power / level, 0) for power in (put_in, left))
        total_in, total_left = flat_in.sum(axis=1), flat_left.sum(axis=1)
        transfer = total_left / total_in
        before, after = flat_in / total_in[:, None], flat_left / total_left[:, None]
    undo, kept = np.zeros((n_bins, n_bins)), np.flatnonzero(estimated)
    if kept.size:
        joined = _interpolation(kept, n_bins).T
        undo[np.ix_(kept, kept)] = np.linalg.solve((left[kept] @ joined).T, (put_in[kept] @ joined).T).T
    centres = (edges[1:] + edges[:-1]) / 2
    return Windows(centres, edges, estimated, undo, before, after, transfer, linear, measured)


def _interpolation(kept: np.ndarray, n_bins: int) -> np.ndarray:
    """Return P(k) at all nodes as a linear function of that at the kept ones, (Nkept, Nk).

    It is on the line of the first two below these, since P(k) of the EoR is steep there, and constant beyond the last.
    """
    found = np.stack([np.interp(np.arange(n_bins), kept, unit) for unit in np.eye(kept.size)])
    if kept.size > 1:
        slope = (kept[0] - np.arange(kept[0])) / (kept[1] - kept[0])
        found[:2, : kept[0]] = 1 + slope, -slope
    return found


def unbiased(
    found: Windows, residual: SphericalSpectrum, signal: SphericalSpectrum, transfer_error: np.ndarray, scale: float
) -> UnbiasedSpectrum:
    """Return U P^R of a spectrum outside the wedge in the same bins, and after them.

    Its error adds three parts. Noise passes through the fit as the EoR does, and has fewer modes afterwards: the error
    of P^R about P^S, for the noise of the data, is multiplied by the root of T, and goes through U. What the fit leaves
    of one EoR differs by chance, as T does. And the fit may leave something else than its linear response does.

    Parameters
    ----------
    residual, signal
        P^R and P^S; the latter is what P is compared with.
    transfer_error
        Relative standard deviation of T in each bin, of P^R and P^S of the same EoR, (at least Nk,).
    scale
        Flux scale of the calibration, s: fitted gain products over the true ones. Its error is not included.
    """
    n_bins = found.k.size
    power = residual.power.real[:n_bins] * scale**2
    usable = found.estimated & np.isfinite(power)
    # A bin without power takes those with it that U mixes with it.
    known = found.estimated & (np.abs(found.undo) @ (found.estimated & ~usable) == 0)
    estimate = found.undo @ np.where(usable, power, 0.0)
    kept = np.where(usable, found.transfer, 0.0)
    noise = kept * np.where(usable, residual.difference_error[:n_bins], 0.0) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        chance = np.diag(found.undo) * kept * transfer_error[:n_bins]
        path = found.measured / found.linear - 1
        divided = np.where(known, power / kept, np.nan)
    error = np.sqrt(found.undo**2 @ noise + estimate**2 * (chance**2 + path**2))
    return UnbiasedSpectrum(
        k=found.k,
        bin_edges=found.bin_edges,
        power=np.where(known, estimate, np.nan),
        error=np.where(known, error, np.nan),
        signal=signal.power.real[:n_bins],
        divided=divided,
    )
