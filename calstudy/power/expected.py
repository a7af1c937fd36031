"""The expected transfer function of a fit, in the bins in which injected signals are measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from calstudy.power.spectra import BaselineModes, bins_of_k, outside_wedge


@dataclass(frozen=True)
class ExpectedBins:
    """Expected T, each baseline counting the same.

    Attributes
    ----------
    k, bin_edges : centres (Nk,) and edges (Nk + 1,), h/Mpc
    outside, outside_error
        T outside the wedge and its standard deviation from random probes, (Nk,); NaN in bins without modes.
    length_edges : lower and upper edge of each bin of baseline length, m, (Nb, 2)
    delay : from zero up, s, (Nd,)
    by_length : T per length and delay, both signs of the delay together, (Nb, Nd)
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    outside: np.ndarray = field(metadata={"unit": ""})
    outside_error: np.ndarray = field(metadata={"unit": ""})
    length_edges: np.ndarray = field(metadata={"unit": "m"})
    delay: np.ndarray = field(metadata={"unit": "s"})
    by_length: np.ndarray = field(metadata={"unit": ""})


def bin_expected(
    modes: BaselineModes,
    transfer: np.ndarray,
    error: np.ndarray,
    edges: ArrayLike,
    buffer: float,
    length_bin: float,
) -> ExpectedBins:
    """Average the expected transfer function, (Nbls, Ndelays), and its error over bins; NaN without data.

    `edges` and `buffer` are as in `calstudy.power.clusters.clusters_in_k`. `length_bin` is the width of the bins of
    baseline length, m.
    """
    limits = np.asarray(edges, float)
    known = np.isfinite(transfer)
    bins, used = bins_outside(modes, limits, buffer)
    used &= known
    count = np.bincount(bins[used], minlength=limits.size - 1)
    total = np.bincount(bins[used], transfer[used], limits.size - 1)
    square = np.bincount(bins[used], error[used] ** 2, limits.size - 1)
    filled = np.where(count > 0, count, np.nan)
    rows, row = np.unique(np.floor(modes.length / length_bin).astype(int), return_inverse=True)
    spacing = modes.delay[1] - modes.delay[0]
    column = np.abs(np.rint(modes.delay / spacing).astype(int))
    cell = (row[:, None] * (column.max() + 1) + column)[known]
    shape = (rows.size, column.max() + 1)
    members, sums = (np.bincount(cell, weights, shape[0] * shape[1]) for weights in (None, transfer[known]))
    return ExpectedBins(
        k=(limits[1:] + limits[:-1]) / 2,
        bin_edges=limits,
        outside=total / filled,
        outside_error=np.sqrt(square) / filled,
        length_edges=np.column_stack([rows, rows + 1]) * length_bin,
        delay=spacing * np.arange(shape[1]),
        by_length=(sums / np.where(members > 0, members, np.nan)).reshape(shape),
    )


def bin_response(
    modes: BaselineModes,
    signal: np.ndarray,
    responses: tuple[np.ndarray, np.ndarray],
    edges: ArrayLike,
    buffer: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return T = Re <D* D'> / P^S and C = Re <S* (D + D')> / 2 P^S outside the wedge, (Nk,) each; NaN without signal.

    `signal` holds the amplitudes of the signal S, and `responses` those of the parts D and D' that two fits leave of
    it, (Nbls, Ndelays), complex; `edges` and `buffer` are as in `bin_expected`.
    """
    limits = np.asarray(edges, float)
    bins, used = bins_outside(modes, limits, buffer)
    first, second = responses
    left, crossed, put_in = (
        np.bincount(bins[used], np.real(one.conj() * other)[used], limits.size - 1)
        for one, other in ((first, second), (signal, (first + second) / 2), (signal, signal))
    )
    put_in = np.where(put_in > 0, put_in, np.nan)
    return left / put_in, crossed / put_in


def bins_outside(modes: BaselineModes, limits: np.ndarray, buffer: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bin of |k| of each mode, and a mask of the modes that are in a bin and outside the wedge."""
    bins = bins_of_k(modes, limits)
    return bins, outside_wedge(modes, buffer) & (bins >= 0)
