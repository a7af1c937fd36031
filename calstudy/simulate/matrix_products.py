"""Visibilities by matrix products over sources, for any three-dimensional array.

V_ab = sum_s w_s conj(E_as) E_bs with E = exp(2 pi i nu x.s / c) and w = A I / 2: the factorization of matvis
(Kittiwisit et al. 2025). The visibilities of all pairs are Hermitian and have as many real numbers as one real matrix.
With C = Re E and S = Im E,

    Z_ab = sum_s w (C_a - S_a) C_b + w (C_a + S_a) S_b = Re V_ab + Im V_ab,
    Re V = (Z + Z^T) / 2,    Im V = (Z - Z^T) / 2,

half the arithmetic of the complex product. Where antennas have different beams, the field of each takes part in its
factor: V_ab = sum_s sum_c w conj(X_asc) X_bsc with X = E conj(J), components c of J and w = I / 2. That is the same
product over twice as many terms, however many beams there are. Sine and cosine are evaluated by polynomials in a loop
the compiler vectorizes, which costs less than the complex multiplications of a recurrence over channels and allows any
frequencies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from pyradiosky import SkyModel
from pyuvdata import UVData
from scipy.constants import speed_of_light
from threadpoolctl import threadpool_limits

from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_indices, require_rectangular
from calstudy.instrument.antenna_beams import AntennaBeams, split_beams
from calstudy.simulate.brightness import stokes_i
from calstudy.simulate.directions import SourceTracks
from calstudy.simulate.interface import BeamSource
from calstudy.simulate.nodes import integration_times
from calstudy.simulate.patterns import Pattern, power_pattern

# Sources per block: the two factors of the matrix product then stay in a 2 MB cache for tens of antennas.
BLOCK_BYTES = 1_200_000

# Taylor coefficients of cos(pi r) and sin(pi r) / r in r^2, exact to rounding for |r| <= 1/2.
COSINE = tuple((-1) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(12))
SINE = tuple((-1) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(11))


def visibilities(sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData, dtype: type) -> np.ndarray:
    """Return the visibilities of an unpolarized sky in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128.

    Parameters
    ----------
    sky, beam, template
        As for `calstudy.simulate.interface.Engine.simulate`.
    dtype
        Of the inner products: float64 or float32.

    Raises
    ------
    InputError
        If a polarization is not xx or yy, or the beam is not of the kind `calstudy.simulate.patterns.power_pattern`
        takes.
    """
    require_rectangular(template)
    frequencies, feeds = template.freq_array, polarization_feeds(template)
    beams, index = split_beams(beam, template)
    patterns = [power_pattern(item.at(frequencies), frequencies, feeds) for item in beams]
    flux = stokes_i(sky, frequencies)
    times = integration_times(template)
    tracks = SourceTracks(sky, template.telescope.location, times)
    order = _order_on_sky(tracks.at(times[0]))
    used, pairs = np.unique(antenna_indices(template), return_inverse=True)
    first, second = pairs.reshape(-1, 2).T
    delays = template.telescope.get_enu_antpos()[used] / speed_of_light
    cube = np.empty((len(times), template.Nbls, len(frequencies), len(feeds)), dtype=np.complex128)
    # The products are many and small: threads in each cost more than they gain, and workers share the cores.
    with threadpool_limits(limits=1, user_api="blas"):
        for step, time in enumerate(times):
            vectors = tracks.at(time, order)
            up = vectors[2] > 0
            tracked = _Sources(vectors[:, up], flux, order[up])
            if len(patterns) == 1:
                sums = _sum_sources(tracked, delays, frequencies, patterns[0], dtype)
            else:
                sums = _sum_fields(tracked, delays, frequencies, (patterns, index[used]), dtype)
            forward, backward = sums[..., first, second], sums[..., second, first]
            # Shape (Nbls, Nfreqs, Nfeeds).
            cube[step] = 0.5 * ((forward + backward) + 1j * (forward - backward)).transpose(2, 0, 1)
    return cube


@dataclass(frozen=True)
class _Sources:
    """Sources above the horizon at one time.

    Attributes
    ----------
    vectors
        Where they are, (3, Nup).
    flux
        Of all sources, (Nfreqs, Ncomponents), Jy.
    components
        Which of all they are, (Nup,) int.
    """

    vectors: np.ndarray
    flux: np.ndarray
    components: np.ndarray


def _sum_sources(
    sources: _Sources, delays: np.ndarray, frequencies: np.ndarray, pattern: Pattern, dtype: type
) -> np.ndarray:
    """Return Z of every frequency and feed, (Nfreqs, Nfeeds, Nants, Nants), for antennas at delays (Nants, 3)."""
    n_ants, vectors = len(delays), sources.vectors
    azimuth, zenith_angle = np.arctan2(vectors[1], vectors[0]) % (2 * np.pi), _zenith_angles(vectors)
    size = max(64, BLOCK_BYTES // (4 * 8 * n_ants) // 64 * 64)
    sums = np.zeros((len(frequencies), pattern.n_feeds, n_ants, n_ants))
    for start in range(0, len(sources.components), size):
        block = slice(start, start + size)
        weights = pattern.at(azimuth[block], zenith_angle[block])
        weights *= 0.5 * sources.flux[:, sources.components[block]]
        _add_products(delays @ vectors[:, block], weights, frequencies, sums, dtype)
    return sums


def _sum_fields(
    sources: _Sources,
    delays: np.ndarray,
    frequencies: np.ndarray,
    antennas: tuple[list[Pattern], np.ndarray],
    dtype: type,
) -> np.ndarray:
    """Return Z as `_sum_sources` does, for antennas with several patterns and the index of that of each."""
    patterns, index = antennas
    n_ants, vectors = len(delays), sources.vectors
    azimuth, zenith_angle = np.arctan2(vectors[1], vectors[0]) % (2 * np.pi), _zenith_angles(vectors)
    # A quarter of that for one beam: factors have two components, and the fields are there as well.
    size = max(64, BLOCK_BYTES // (16 * 8 * n_ants) // 64 * 64)
    sums = np.zeros((len(frequencies), patterns[0].n_feeds, n_ants, n_ants))
    for start in range(0, len(sources.components), size):
        block = slice(start, start + size)
        # Sources of one part of one component lie together.
        table = np.empty((len(frequencies), patterns[0].n_feeds, len(patterns), 4, len(azimuth[block])))
        for place, pattern in enumerate(patterns):
            table[:, :, place] = pattern.fields(azimuth[block], zenith_angle[block]).transpose(2, 1, 3, 0)
        fluxes = 0.5 * sources.flux[:, sources.components[block]]
        _add_field_products(delays @ vectors[:, block], (table, index), fluxes, frequencies, sums, dtype)
    return sums


def _add_field_products(
    delays: np.ndarray,
    fields: tuple[np.ndarray, np.ndarray],
    fluxes: np.ndarray,
    frequencies: np.ndarray,
    sums: np.ndarray,
    dtype: type,
) -> None:
    """Add to Z a block of sources with delays (Nants, N), fields (Nfreqs, Nfeeds, Nbeams, 4, N), fluxes (Nfreqs, N)."""
    table, index = fields
    n_ants, n_sources = delays.shape
    fringes = np.empty((2, n_ants, n_sources))
    left = np.empty((n_ants, 4 * n_sources), dtype=dtype)
    right = np.empty((n_ants, 4 * n_sources), dtype=dtype)
    for channel, frequency in enumerate(frequencies):
        _all_fringes(delays, frequency, fringes)
        for feed in range(table.shape[1]):
            _field_factors(fringes, table[channel, feed], index, fluxes[channel], left, right)
            sums[channel, feed] += left @ right.T


def _add_products(
    delays: np.ndarray, weights: np.ndarray, frequencies: np.ndarray, sums: np.ndarray, dtype: type
) -> None:
    """Add to Z a block of sources with delays (Nants, N) and weights (Nweights, Nfreqs, N)."""
    n_weights, (n_ants, n_sources) = len(weights), delays.shape
    left = np.empty((n_weights * n_ants, 2 * n_sources), dtype=dtype)
    right = np.empty((n_ants, 2 * n_sources), dtype=dtype)
    for index, frequency in enumerate(frequencies):
        _factors(delays, weights[:, index], frequency, left, right)
        sums[index] += (left @ right.T).reshape(n_weights, n_ants, n_ants)


def polarization_feeds(template: UVData) -> list[str]:
    """Return the feed of each polarization; raises InputError for cross-hand or circular ones."""
    feeds = {-5: "x", -6: "y"}
    unknown = [int(number) for number in template.polarization_array if int(number) not in feeds]
    if unknown:
        raise InputError(f"polarization number {unknown[0]} is not xx (-5) or yy (-6)")
    return [feeds[int(number)] for number in template.polarization_array]


def _zenith_angles(vectors: np.ndarray) -> np.ndarray:
    # Unlike the arc cosine of the height, exact near the zenith.
    return np.arctan2(np.hypot(vectors[0], vectors[1]), vectors[2])


def _order_on_sky(vectors: np.ndarray) -> np.ndarray:
    """Return an order of the sources in which neighbours are near on the sky, for the beam table's sake."""
    rings = np.floor(np.rad2deg(_zenith_angles(vectors)))
    return np.lexsort((np.arctan2(vectors[1], vectors[0]), rings))


@numba.njit(inline="always", fastmath={"contract"})
def _polynomial(coefficients: tuple, x: float) -> float:
    value = coefficients[-1]
    for k in range(len(coefficients) - 2, -1, -1):
        value = value * x + coefficients[k]
    return value


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _fringes(delays: np.ndarray, frequency: float, cosine: np.ndarray, sine: np.ndarray) -> None:
    for source in range(delays.size):
        turns = delays[source] * frequency
        half = turns - np.floor(turns + 0.5)
        square = half * half
        c = _polynomial(COSINE, square)
        s = half * _polynomial(SINE, square)
        cosine[source] = 1.0 - 2.0 * s * s
        sine[source] = 2.0 * s * c


@numba.njit(cache=True, nogil=True)
def _all_fringes(delays: np.ndarray, frequency: float, fringes: np.ndarray) -> None:
    """Fill `fringes` (2, Nants, N) with the cosines and sines of all antennas with delays (Nants, N)."""
    for antenna in range(len(delays)):
        _fringes(delays[antenna], frequency, fringes[0, antenna], fringes[1, antenna])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _weigh(cosine: np.ndarray, sine: np.ndarray, weights: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    for source in range(weights.size):
        low[source] = weights[source] * (cosine[source] - sine[source])
        high[source] = weights[source] * (cosine[source] + sine[source])


@numba.njit(cache=True, nogil=True)
def _factors(delays: np.ndarray, weights: np.ndarray, frequency: float, left: np.ndarray, right: np.ndarray) -> None:
    """Fill left (Nweights * Nants, 2 N) with w (C - S) and w (C + S), right (Nants, 2 N) with C and S."""
    n_ants, n_sources = delays.shape
    # One row at a time: on rows the compiler can rule out that input and output overlap, and vectorizes.
    for antenna in range(n_ants):
        cosine, sine = right[antenna, :n_sources], right[antenna, n_sources:]
        _fringes(delays[antenna], frequency, cosine, sine)
        for index in range(len(weights)):
            row = left[index * n_ants + antenna]
            _weigh(cosine, sine, weights[index], row[:n_sources], row[n_sources:])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _multiply(
    cosine: np.ndarray, sine: np.ndarray, real: np.ndarray, imaginary: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    """Fill real and imaginary part of a fringe times the conjugate of a field."""
    for source in range(cosine.size):
        low[source] = cosine[source] * real[source] + sine[source] * imaginary[source]
        high[source] = sine[source] * real[source] - cosine[source] * imaginary[source]


@numba.njit(cache=True, nogil=True)
def _field_factors(
    fringes: np.ndarray, fields: np.ndarray, index: np.ndarray, flux: np.ndarray, left: np.ndarray, right: np.ndarray
) -> None:
    """Fill right (Nants, 4 N) with C and S of X of both components, left with w (C - S) and w (C + S) of them.

    `fringes` are cosine and sine, (2, Nants, N), and `fields` those of the beams, (Nbeams, 4, N): real and imaginary
    part of one component, then of the other.
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
