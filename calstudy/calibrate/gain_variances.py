"""Variances of gains: the diagonal of the inverse of the Gauss-Newton matrix H, aligned and within spans.

All variances are those of relative changes of the gains in units of the noise (`calstudy.calibrate.gain_errors`),
(2, Nants, Nfreqs), of real parts and of imaginary ones.

Known foregrounds couple no channels, and H is inverted channel by channel. Otherwise H is inverted as a whole, or,
where that is too large, antenna by antenna: the block of an antenna has what foregrounds couple, its channels. The
couplings between antennas are of the order of 1/N of it for N antennas. They change variances by a factor that hardly
depends on what foregrounds absorb, and that is taken from the matrix of each channel with known foregrounds. Errors
agree with those of the whole matrix to 1 or 2 % (rms). The exception are phases beside channels that are flagged for
one antenna alone: these are relative to a mean that it does not determine there, and get too small an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calstudy.calibrate.problem import CalibrationProblem, sum_by_antenna
from calstudy.calibrate.tangent_space import TangentSpace

RESOLVED = 1e-9
"""Added to eigenvalues of H relative to its diagonal. Directions with less, as of two arrays without a baseline between
them, get enormous errors."""
AT_ONCE = 2**20
"""Elements of the matrices of several channels that are inverted together."""


class Alignment(NamedTuple):
    """The alignment of a change: |g|^2 over its sum over antennas, (Nants, Nfreqs), and over that over channels too.

    The latter is None where data determine the scale. `n_aligned` is the number of numbers that are aligned.
    """

    of_channel: np.ndarray
    of_all: np.ndarray | None
    n_aligned: int

    @classmethod
    def at(cls, problem: CalibrationProblem, gains: np.ndarray, has_data: np.ndarray) -> Alignment:
        """Return the alignment of gains (Nants, Nfreqs) where they have data."""
        power = np.where(has_data, np.abs(gains) ** 2, 0)
        total = power.sum(axis=0)
        known = problem.frozen or (problem.prior == "none" and problem.structure.prior != "none")
        of_channel = power / np.where(total > 0, total, 1)
        return cls(of_channel, None if known else power / power.sum(), int((total > 0).sum()) + (not known))

    def align(self, change: np.ndarray) -> np.ndarray:
        """Take the phase of each channel and the scale out of changes (2, Nants, Nfreqs, ...), real and imaginary."""
        real, imaginary = change
        imaginary = imaginary - np.einsum("af,af...->f...", self.of_channel, imaginary)
        if self.of_all is not None:
            real = real - np.einsum("af,af...->...", self.of_all, real)
        return np.stack([real, imaginary])

    def independent(self, variances: np.ndarray) -> np.ndarray:
        """Return the variances of aligned phases, (Nants, Nfreqs), for independent phases with these variances."""
        shares = self.of_channel
        return (1 - 2 * shares) * variances + np.sum(shares**2 * variances, axis=0)


def by_channel(tangent: TangentSpace, antennas: np.ndarray, alignment: Alignment) -> np.ndarray:
    """Return the diagonal of H^-1 for known foregrounds, which couple neither channels nor amplitudes and phases."""
    power, shares = np.abs(tangent.slope) ** 2, alignment.of_channel
    found, n_antennas = np.empty((2, *shares.shape)), len(shares)
    step = max(1, AT_ONCE // n_antennas**2)
    for start in range(0, shares.shape[1], step):
        channels = slice(start, start + step)
        rows = shares[:, channels].T[:, None, :]
        # The difference of two phases and the sum of two amplitudes: the graph's Laplacian, and that without signs.
        matrices = np.zeros((2, n_antennas, n_antennas, len(rows)))
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            for part, sign in enumerate((1, 1 if a == b else -1)):
                np.add.at(matrices[part], (antennas[:, a], antennas[:, b]), sign * power[:, channels])
        scaled, scale = _scaled(np.moveaxis(matrices, 3, 1))
        # The common phase, which no data determine, and which the alignment removes.
        common = np.sqrt(np.einsum("faa->fa", scale[1]))
        scaled[1] += common[:, :, None] * common[:, None, :] / np.maximum(np.sum(common**2, axis=1), 1)[:, None, None]
        inverse = np.linalg.inv(scaled) / scale
        phases = inverse[1] - rows @ inverse[1]
        inverse[1] = phases - phases @ np.swapaxes(rows, 1, 2)
        found[:, :, channels] = np.einsum("cfaa->caf", inverse)
    return np.maximum(found, 0)


def as_a_whole(
    tangent: TangentSpace, antennas: np.ndarray, alignment: Alignment, spans: list[np.ndarray]
) -> np.ndarray:
    """Return the diagonal of H^-1 within the spans, (2, Nants, Nfreqs)."""
    shape, edges = (2, *alignment.of_channel.shape), np.cumsum([0, *(span.shape[1] for span in spans)])
    matrix, whole = _curvature(tangent, antennas, spans), np.zeros((*shape, 2 * edges[-1]))
    for part, offset in enumerate((0, edges[-1])):
        for antenna, span in enumerate(spans):
            whole[part, antenna, :, offset + edges[antenna] : offset + edges[antenna + 1]] = span
    aligned = alignment.align(whole)
    scaled, scale = _scaled(matrix)
    rows = aligned.reshape(-1, len(matrix)) / np.sqrt(np.diag(scale))
    return np.sum(_half(scaled, rows) ** 2, axis=0).reshape(shape)


def by_antenna(
    tangent: TangentSpace, antennas: np.ndarray, alignment: Alignment, spans: list[np.ndarray], known: np.ndarray
) -> np.ndarray:
    """Return the diagonal of H^-1 within the spans, from the blocks of antennas and the coupling in channels.

    `known` is the diagonal for known foregrounds, of `by_channel`.
    """
    shape = alignment.of_channel.shape
    degrees = sum_by_antenna(np.abs(tangent.slope) ** 2, antennas, len(spans))
    alone, with_scale = np.zeros((2, *shape)), np.zeros(shape)
    for antenna, block in enumerate(_blocks(tangent, antennas, degrees, spans)):
        if block.size:
            scaled, scale = _scaled(block)
            half = _half(scaled, np.kron(np.eye(2), spans[antenna]) / np.sqrt(np.diag(scale)))
            alone[:, antenna] = np.sum(half**2, axis=0).reshape(2, -1)
            if alignment.of_all is not None:
                real = half[:, : shape[1]]
                with_scale[antenna] = real.T @ (real @ alignment.of_all[antenna])
    uncoupled = np.divide(1, degrees, out=np.zeros(shape), where=degrees > 0)
    uncoupled = np.stack([uncoupled, alignment.independent(uncoupled)])
    found = known * np.stack([alone[0], alignment.independent(alone[1])])
    found = np.divide(found, uncoupled, out=np.zeros(found.shape), where=uncoupled > 0)
    if alignment.of_all is not None:
        found[0] += np.sum(alignment.of_all * with_scale) - 2 * with_scale
    return np.maximum(found, 0)


def _blocks(
    tangent: TangentSpace, antennas: np.ndarray, degrees: np.ndarray, spans: list[np.ndarray]
) -> list[np.ndarray]:
    """Return the block of H of each antenna, with the sums of |slope|^2 of its baselines, (Nants, Nfreqs)."""
    found = [np.kron(np.eye(2), (span.T * power) @ span) for span, power in zip(spans, degrees, strict=True)]
    for absorbed in _absorbed(tangent, antennas):
        for item in absorbed:
            columns = item.columns(spans[item.antenna])
            found[item.antenna] -= columns @ columns.T
    return found


def _half(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return L^-1 rows^T for a matrix L L^T: the inverse within the rows is its product with itself."""
    from scipy.linalg import solve_triangular

    return solve_triangular(np.linalg.cholesky(matrix), rows.T, lower=True, check_finite=False)


def _scaled(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (..., n, n) with a unit diagonal and no negative eigenvalue, and by what they were divided."""
    diagonal = np.einsum("...aa->...a", matrices)
    roots = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    scale = roots[..., :, None] * roots[..., None, :]
    return matrices / scale + RESOLVED * np.eye(matrices.shape[-1]), scale


def _curvature(tangent: TangentSpace, antennas: np.ndarray, spans: list[np.ndarray]) -> np.ndarray:
    """Return H of the coefficients of the spans, (n, n): of Re of all antennas, then Im."""
    widths = [span.shape[1] for span in spans]
    size, edges = sum(widths), np.cumsum([0, *widths])
    places = [np.arange(*ends) for ends in pairwise(edges)]
    matrix = np.zeros((2 * size, 2 * size))
    for ends, power in zip(antennas, np.abs(tangent.slope) ** 2, strict=True):
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            block = (spans[ends[a]] * power[:, None]).T @ spans[ends[b]]
            for part, sign in ((0, 1), (size, 1 if a == b else -1)):
                matrix[np.ix_(part + places[ends[a]], part + places[ends[b]])] += sign * block
    for absorbed in _absorbed(tangent, antennas):
        columns = np.concatenate([item.columns(spans[item.antenna]) for item in absorbed])
        rows = np.concatenate([part + places[item.antenna] for item in absorbed for part in (0, size)])
        matrix[np.ix_(rows, rows)] -= columns @ columns.T
    return matrix


def _absorbed(tangent: TangentSpace, antennas: np.ndarray) -> Iterator[list[Absorbed]]:
    """Yield what foregrounds of some baselines take from H, for one after the other."""
    for response in tangent.responses:
        yield _pulled(tangent, antennas, response.members, response.common)
        for place, own in enumerate(() if response.own is None else response.own):
            yield _pulled(tangent, antennas, response.members[place : place + 1], own[None])


class Absorbed(NamedTuple):
    """J^T q on one antenna, complex, (Nfreqs, Nvec), for sequences q: `along` + `against`.

    For i q it is i (`along` - `against`), because the second antenna of a baseline has the conjugate.
    """

    antenna: int
    along: np.ndarray | None
    against: np.ndarray | None

    def columns(self, span: np.ndarray) -> np.ndarray:
        """Return J^T q, then J^T i q, within a span (Nfreqs, N): real parts above imaginary ones, (2 N, 2 Nvec)."""
        along, against = (0 if part is None else _within(span, part) for part in (self.along, self.against))
        both = np.concatenate([along + against, 1j * (along - against)], axis=1)
        return np.concatenate([both.real, both.imag])


def _within(span: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return span^T part of a complex part, as one product of real matrices."""
    return (span.T @ np.ascontiguousarray(part).view(float)).view(complex)


def _pulled(tangent: TangentSpace, antennas: np.ndarray, members: np.ndarray, sequences: np.ndarray) -> list[Absorbed]:
    """Return J^T q on each antenna of some baselines for sequences q of these, real, (Nmembers, Nfreqs, Nvec)."""
    found: dict[int, list[np.ndarray | None]] = {}
    for member, own in zip(members, sequences, strict=True):
        gradient = tangent.slope[member].conj()[:, None] * own
        for side, antenna in enumerate(antennas[member].tolist()):
            parts = found.setdefault(antenna, [None, None])
            place, turned = int(side != tangent.conjugated[member]), gradient.conj() if side else gradient
            before = parts[place]
            parts[place] = turned if before is None else before + turned
    return [Absorbed(antenna, *parts) for antenna, parts in found.items()]
