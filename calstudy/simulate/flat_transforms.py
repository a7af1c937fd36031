"""Sums over sources of the visibilities of all baselines of a flat array, by non-uniform Fourier transforms.

Where antennas have no heights, a visibility is V(u) = sum_s w_s exp(2 pi i u.l_s) with the horizontal direction cosines
l_s, exactly and for patches of any size. FINUFFT (Barnett et al. 2019) computes it at all baselines with a cost that
grows with sources and baselines separately, not with their product: for more than about a hundred antennas it takes
less time than matrix products (`calstudy.simulate.matrix_products`). Baselines on a lattice are modes of one regular
grid, which is a transform of type 1; others need one of type 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import finufft
import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.simulate.matrix_products import angles
from calstudy.simulate.patterns import Pattern

TOLERANCE = 3e-7
"""Tolerance of the transforms, relative to the root of the sum of squares of the sources."""
POSITIONS = 1e-8
"""Heights, and distances from a lattice, below which an array is flat or regular (m): a phase of 1e-7 at 500 MHz."""
NEAREST = 1e-3
"""Baselines that differ by less are the same in the search for a lattice, and no lattice is finer than this (m)."""
OVERSAMPLING = 1.25
LARGEST_GRID = 4e6
"""Largest number of modes of a lattice; an array whose lattice has more is computed by transforms of type 3."""


@dataclass(frozen=True)
class FlatArray:
    """Baselines without heights: `delays` are their east and north components over the speed of light, (Nbls, 2), s."""

    delays: np.ndarray

    @cached_property
    def lattice(self) -> Lattice | None:
        """The regular grid of the baselines, or None."""
        basis = lattice_basis(self.delays * SPEED_OF_LIGHT)
        return None if basis is None else Lattice.of(self.delays, basis / SPEED_OF_LIGHT)

    def seconds(self, frequency: float, sources: float, radius: float) -> float:
        """Estimate the time of the transform of a patch at a frequency (Hz), without its beam; `radius` is in rad."""
        if self.lattice:
            cells, each = OVERSAMPLING**2 * self.lattice.shape[0] * self.lattice.shape[1], 1e-8
        else:
            turns = frequency * np.abs(self.delays).max(axis=0) * min(radius, 1.0)
            cells, each = float(np.prod(4 * OVERSAMPLING**2 * turns + 16)), 3e-7
        return 2e-7 * sources + 2.5e-8 * cells + each * len(self.delays)


def flat_array(delays: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]) -> FlatArray | None:
    """Return the baselines of antennas with the given delays, (Nants, 3) in s, or None if the antennas have heights."""
    if np.ptp(delays[:, 2]) * SPEED_OF_LIGHT > POSITIONS:
        return None
    return FlatArray((delays[pairs[1]] - delays[pairs[0]])[:, :2])


@dataclass(frozen=True)
class FlatSums:
    """Visibilities of a flat array with one beam `pattern` at `frequencies`, (Nfreqs,), Hz, summed over sources."""

    array: FlatArray
    frequencies: np.ndarray
    pattern: Pattern

    def at(self, vectors: np.ndarray, centre: np.ndarray, flux: np.ndarray) -> np.ndarray:
        """Sum the visibilities of sources to `TOLERANCE`; see `calstudy.simulate.matrix_products.PairSums.at`."""
        shape = (len(self.frequencies), self.pattern.n_feeds, len(self.array.delays))
        sums = np.zeros(shape, dtype=np.complex128)
        if not vectors.shape[1]:
            return sums
        weights = self.pattern.at(*angles(vectors)) * (0.5 * flux)
        offsets = np.ascontiguousarray((vectors - centre[:, None])[:2])
        for channel, frequency in enumerate(self.frequencies):
            strengths = np.ascontiguousarray(weights[:, channel], dtype=np.complex128)
            sums[channel] = self._transform(2 * np.pi * frequency, offsets, strengths)
        return sums

    def _transform(self, wavenumber: float, offsets: np.ndarray, strengths: np.ndarray) -> np.ndarray:
        """Return the visibilities of sources at one frequency, (Nfeeds, Nbls)."""
        if self.array.lattice:
            phases = wavenumber * (self.array.lattice.basis @ offsets)
            self._plan.setpts(*(phases - 2 * np.pi * np.round(phases / (2 * np.pi))))
            return self._plan.execute(strengths).reshape(len(strengths), -1)[:, self.array.lattice.modes]
        targets = np.ascontiguousarray(wavenumber * self.array.delays.T)
        self._plan.setpts(*offsets, s=targets[0], t=targets[1])
        return self._plan.execute(strengths).reshape(len(strengths), -1)

    @cached_property
    def _plan(self) -> finufft.Plan:
        kind, grid = (1, self.array.lattice.shape) if self.array.lattice else (3, 2)
        return finufft.Plan(kind, grid, self.pattern.n_feeds, TOLERANCE, isign=1, nthreads=1, upsampfac=OVERSAMPLING)


@dataclass(frozen=True)
class Lattice:
    """Baselines as modes of a regular grid.

    The rows of `basis` (2, 2) are the steps of the grid, s. The middle of the grid is a baseline of zero. `modes` are
    the flat indices of the baselines in the grid, (Nbls,).
    """

    basis: np.ndarray
    shape: tuple[int, int]
    modes: np.ndarray

    @classmethod
    def of(cls, delays: np.ndarray, basis: np.ndarray) -> Lattice | None:
        """Return the smallest grid that holds baselines, (Nbls, 2) in s, or None if it is too large."""
        steps = np.round(delays @ np.linalg.inv(basis)).astype(int)
        half = np.abs(steps).max(axis=0) + 1
        shape = (2 * int(half[0]), 2 * int(half[1]))
        if shape[0] * shape[1] > LARGEST_GRID:
            return None
        return cls(basis, shape, np.ravel_multi_index((steps + half).T, shape))


def lattice_basis(vectors: np.ndarray) -> np.ndarray | None:
    """Find a short basis of the lattice that vectors (N, 2), in m, generate in a plane, in rows, (2, 2).

    It is None if the vectors are on a line, or not on a lattice to within `POSITIONS`.
    """
    basis = _two_shortest(vectors)
    while basis is not None:
        steps = np.round(vectors @ np.linalg.inv(basis))
        left = vectors - steps @ basis
        lengths = np.hypot(*left.T)
        new = lengths > NEAREST
        if not new.any():
            fitted = np.linalg.lstsq(steps, vectors, rcond=None)[0]
            return fitted if np.abs(vectors - steps @ fitted).max() < POSITIONS else None
        # The remainder of a vector is in the lattice as well, and shorter than the basis: a finer basis, as in
        # Euclid's algorithm. Vectors on no lattice leave ever shorter remainders.
        shortest = left[new][np.argmin(lengths[new])]
        basis = _two_shortest(np.vstack([basis, shortest])) if lengths[new].min() > 10 * NEAREST else None
    return None


def _two_shortest(vectors: np.ndarray) -> np.ndarray | None:
    """Return the shortest vector and the shortest one in another direction, reduced by it, (2, 2), or None."""
    lengths = np.hypot(*vectors.T)
    order = np.argsort(lengths, kind="stable")[np.count_nonzero(lengths < NEAREST) :]
    ordered = vectors[order]
    if not len(ordered):
        return None
    across = np.abs(ordered[0, 0] * ordered[:, 1] - ordered[0, 1] * ordered[:, 0]) / lengths[order[0]]
    other = np.flatnonzero(across > NEAREST)
    if not len(other):
        return None
    first, second = ordered[0], ordered[other[0]]
    return np.stack([first, second - np.round(second @ first / (first @ first)) * first])
