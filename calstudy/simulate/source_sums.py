"""Sums over sources of the visibilities of all baselines, by matrix products or, for flat arrays, by transforms.

**Matrix products.**
V_ab = sum_s w_s conj(E_as) E_bs with E = exp(2 pi i nu x.s / c) and w = A I / 2: the factorization of matvis
(Kittiwisit et al. 2025). The visibilities of all pairs are Hermitian and have as many real numbers as one real matrix.
With C = Re E and S = Im E,

    Z_ab = sum_s w (C_a - S_a) C_b + w (C_a + S_a) S_b = Re V_ab + Im V_ab,
    Re V = (Z + Z^T) / 2,    Im V = (Z - Z^T) / 2,

half the arithmetic of the complex product. Where antennas have different beams, each antenna's factor includes its
field: V_ab = sum_s sum_c w conj(X_asc) X_bsc with X = E conj(J), components c of J and w = I / 2. That is the same
product over twice as many terms, for any number of beams. Sine and cosine are evaluated by polynomials in a loop that
the compiler vectorizes. This costs less than the complex multiplications of a recurrence over channels, and allows any
frequencies.

The sources of one call are neighbours on the sky, and s is relative to a centre, so fringes turn by few turns from the
first to the last frequency. Turns at the first frequency are reduced to fractions in double precision; the turns that
the other frequencies add are held in single precision to a relative 6e-8.

**Non-uniform Fourier transforms.**
Where antennas have no heights, a visibility is V(u) = sum_s w_s exp(2 pi i u.l_s) with the horizontal direction cosines
l_s, exactly and for patches of any size. FINUFFT (Barnett et al. 2019) computes it at all baselines with a cost that
grows with sources and baselines separately, not with their product: for more than about a hundred antennas it takes
less time than matrix products. Baselines on a lattice are modes of one regular
grid, which is a transform of type 1; others need one of type 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import finufft
import numba
import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.simulate.patterns import Pattern

# Size of the two factors of a block, which then stay in a 2 MB cache.
BLOCK_BYTES = 1_200_000


def _taylor(dtype: type, terms: int) -> tuple[tuple, tuple]:
    cosines = tuple(dtype((-1) ** k * math.pi ** (2 * k) / math.factorial(2 * k)) for k in range(terms))
    sines = tuple(dtype((-1) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1)) for k in range(terms - 1))
    return cosines, sines


TAYLOR: dict[type, tuple[tuple, tuple]] = {np.float64: _taylor(np.float64, 12), np.float32: _taylor(np.float32, 8)}
"""Coefficients of cos(pi r) and sin(pi r) / r in r^2, exact to rounding for |r| <= 1/2."""


@dataclass(frozen=True)
class PairSums:
    """Visibilities of all baselines of an array, summed over sources.

    Attributes
    ----------
    delays : positions of the antennas over the speed of light, s, in east, north, up, (Nants, 3)
    pairs : first and second antenna of each baseline, two arrays (Nbls,) int
    frequencies : in Hz, ascending, (Nfreqs,)
    patterns : distinct beams at these frequencies
    index : index of the beam of each antenna, (Nants,) int
    dtype : precision of the products, float64 or float32
    """

    delays: np.ndarray
    pairs: tuple[np.ndarray, np.ndarray]
    frequencies: np.ndarray
    patterns: list[Pattern]
    index: np.ndarray
    dtype: type

    @cached_property
    def n_feeds(self) -> int:
        """Number of polarizations."""
        return self.patterns[0].n_feeds

    @cached_property
    def _block(self) -> int:
        """Sources of one product. With several beams factors have two components, and the fields are kept as well."""
        size = 4 if len(self.patterns) == 1 else 16
        return max(64, BLOCK_BYTES // (size * np.dtype(self.dtype).itemsize * len(self.delays)) // 64 * 64)

    def at(self, vectors: np.ndarray, centre: np.ndarray, flux: np.ndarray) -> np.ndarray:
        """Sum the visibilities of sources in Jy, with fringes relative to a direction `centre`, (3,).

        `vectors` are unit vectors towards the sources, above the horizon, (3, N), and `flux` is in Jy, (Nfreqs, N). The
        sums are complex128, (Nfreqs, Nfeeds, Nbls).
        """
        n_ants = len(self.delays)
        sums = np.zeros((len(self.frequencies), self.n_feeds, n_ants, n_ants))
        delays = self.delays @ (vectors - centre[:, None])
        azimuth, zenith_angle = angles(vectors)
        for start in range(0, vectors.shape[1], self._block):
            block = slice(start, start + self._block)
            turns = self._turns(delays[:, block])
            if len(self.patterns) == 1:
                weights = self.patterns[0].at(azimuth[block], zenith_angle[block])
                weights *= 0.5 * flux[:, block]
                self._add_products(turns, np.ascontiguousarray(weights.transpose(1, 0, 2), self.dtype), sums)
            else:
                fields = self._fields(azimuth[block], zenith_angle[block])
                self._add_field_products(turns, fields, (0.5 * flux[:, block]).astype(self.dtype), sums)
        first, second = self.pairs
        forward, backward = sums[..., first, second], sums[..., second, first]
        return 0.5 * ((forward + backward) + 1j * (forward - backward))

    def _turns(self, delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fractions of turns at the first frequency, and the turns from there to the last, (Nants, N)."""
        base = delays * self.frequencies[0]
        base -= np.round(base)
        slope = delays * (self.frequencies[-1] - self.frequencies[0])
        return base.astype(self.dtype, copy=False), slope.astype(self.dtype, copy=False)

    @cached_property
    def _steps(self) -> np.ndarray:
        """Position of each frequency between the first, 0, and the last, 1."""
        offsets = self.frequencies - self.frequencies[0]
        return (offsets / (offsets[-1] or 1.0)).astype(self.dtype)

    def _add_products(self, turns: tuple[np.ndarray, np.ndarray], weights: np.ndarray, sums: np.ndarray) -> None:
        """Add a block of sources with weights (Nfreqs, Nfeeds, N) to Z."""
        n_ants, n_sources = turns[0].shape
        left = np.empty((self.n_feeds * n_ants, 2 * n_sources), dtype=self.dtype)
        right = np.empty((n_ants, 2 * n_sources), dtype=self.dtype)
        for channel, step in enumerate(self._steps):
            _factors(turns, step, TAYLOR[self.dtype], weights[channel], left, right)
            sums[channel] += (left @ right.T).reshape(self.n_feeds, n_ants, n_ants)

    def _fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J of all beams, (Nfreqs, Nfeeds, Nbeams, 4, N)."""
        shape = (len(self.frequencies), self.n_feeds, len(self.patterns), 4, len(azimuth))
        table: np.ndarray = np.empty(shape, dtype=self.dtype)
        for place, pattern in enumerate(self.patterns):
            table[:, :, place] = pattern.fields(azimuth, zenith_angle).transpose(2, 1, 3, 0)
        return table

    def _add_field_products(
        self, turns: tuple[np.ndarray, np.ndarray], fields: np.ndarray, flux: np.ndarray, sums: np.ndarray
    ) -> None:
        """Add a block of sources with fields (Nfreqs, Nfeeds, Nbeams, 4, N) and fluxes (Nfreqs, N) to Z."""
        n_ants, n_sources = turns[0].shape
        fringes: np.ndarray = np.empty((2, n_ants, n_sources), dtype=self.dtype)
        left = np.empty((n_ants, 4 * n_sources), dtype=self.dtype)
        right = np.empty((n_ants, 4 * n_sources), dtype=self.dtype)
        for channel, step in enumerate(self._steps):
            _all_fringes(turns, step, TAYLOR[self.dtype], fringes)
            for feed in range(self.n_feeds):
                _field_factors(fringes, fields[channel, feed], self.index, flux[channel], left, right)
                sums[channel, feed] += left @ right.T


def product_seconds(antennas: int, sources: float) -> float:
    """Estimate the time of single-precision products for a number of sources at one frequency, without their beam."""
    return (4.7e-9 * antennas + 5.1e-11 * antennas**2) * sources


def angles(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth from east through north and zenith angle of unit vectors (3, N), rad, each (N,)."""
    # Unlike the arc cosine of the height, the arc tangent is exact near the zenith.
    zenith_angle = np.arctan2(np.hypot(vectors[0], vectors[1]), vectors[2])
    return np.arctan2(vectors[1], vectors[0]) % (2 * np.pi), zenith_angle


@numba.njit(inline="always", fastmath={"contract"})
def _polynomial(coefficients: tuple, x: float) -> float:
    value = coefficients[-1]
    for k in range(len(coefficients) - 2, -1, -1):
        value = value * x + coefficients[k]
    return value


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _fringes(
    base: np.ndarray, slope: np.ndarray, step: float, taylor: tuple, cosine: np.ndarray, sine: np.ndarray
) -> None:
    # The constants have the precision of the arrays; literals would make single precision double.
    cosines, sines = taylor
    one = cosines[0]
    two = one + one
    half = one / two
    for source in range(base.size):
        turns = base[source] + step * slope[source]
        r = turns - np.floor(turns + half)
        square = r * r
        c = _polynomial(cosines, square)
        s = r * _polynomial(sines, square)
        cosine[source] = one - two * s * s
        sine[source] = two * s * c


@numba.njit(cache=True, nogil=True)
def _all_fringes(turns: tuple, step: float, taylor: tuple, fringes: np.ndarray) -> None:
    """Fill `fringes` (2, Nants, N) with cosines and sines of the turns of all antennas, two arrays (Nants, N)."""
    base, slope = turns
    for antenna in range(len(base)):
        _fringes(base[antenna], slope[antenna], step, taylor, fringes[0, antenna], fringes[1, antenna])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _weigh(cosine: np.ndarray, sine: np.ndarray, weights: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    for source in range(weights.size):
        low[source] = weights[source] * (cosine[source] - sine[source])
        high[source] = weights[source] * (cosine[source] + sine[source])


@numba.njit(cache=True, nogil=True)
def _factors(
    turns: tuple, step: float, taylor: tuple, weights: np.ndarray, left: np.ndarray, right: np.ndarray
) -> None:
    """Fill left (Nweights * Nants, 2 N) with w (C - S) and w (C + S), right (Nants, 2 N) with C and S."""
    base, slope = turns
    n_ants, n_sources = base.shape
    # One row at a time: on rows the compiler can rule out that input and output overlap, and vectorizes.
    for antenna in range(n_ants):
        cosine, sine = right[antenna, :n_sources], right[antenna, n_sources:]
        _fringes(base[antenna], slope[antenna], step, taylor, cosine, sine)
        for index in range(len(weights)):
            row = left[index * n_ants + antenna]
            _weigh(cosine, sine, weights[index], row[:n_sources], row[n_sources:])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _multiply(
    cosine: np.ndarray, sine: np.ndarray, real: np.ndarray, imaginary: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    """Fill the real and imaginary parts of a fringe times the conjugate of a field."""
    for source in range(cosine.size):
        low[source] = cosine[source] * real[source] + sine[source] * imaginary[source]
        high[source] = sine[source] * real[source] - cosine[source] * imaginary[source]


@numba.njit(cache=True, nogil=True)
def _field_factors(
    fringes: np.ndarray, fields: np.ndarray, index: np.ndarray, flux: np.ndarray, left: np.ndarray, right: np.ndarray
) -> None:
    """Fill right (Nants, 4 N) with C and S of both components of X, left with w (C - S) and w (C + S) of them.

    `fringes` are (2, Nants, N), and `fields` (Nbeams, 4, N): real and imaginary part of one component, then the other.
    """
    n_sources = flux.size
    for antenna in range(len(index)):
        for component in range(2):
            start = 2 * component * n_sources
            cosine = right[antenna, start : start + n_sources]
            sine = right[antenna, start + n_sources : start + 2 * n_sources]
            field = fields[index[antenna]]
            _multiply(
                fringes[0, antenna], fringes[1, antenna], field[2 * component], field[2 * component + 1], cosine, sine
            )
            low = left[antenna, start : start + n_sources]
            high = left[antenna, start + n_sources : start + 2 * n_sources]
            _weigh(cosine, sine, flux, low, high)


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
        """Sum the visibilities of sources to `TOLERANCE`; see `calstudy.simulate.source_sums.PairSums.at`."""
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
