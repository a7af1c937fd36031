"""Chebyshev nodes: times and frequencies from which visibilities can be interpolated to a tolerance.

Over an observation a visibility is band-limited, in time by its fringe rate and in frequency by its horizon delay. The
contribution of a source is a phasor exp(i c x) on the scaled interval x in [-1, 1], whose Chebyshev coefficients
2 J_k(c) decrease faster than exponentially once k > c. The number of nodes therefore follows from the longest baseline,
the span and the tolerance. It does not depend on the engine.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import jv

from calstudy.base.constants import SECONDS_PER_DAY, SPEED_OF_LIGHT
from calstudy.base.visibilities import baseline_vectors

if TYPE_CHECKING:
    from pyuvdata import UVData

EARTH_ROTATION_RATE = 7.2921158553e-5  # rad / s, sidereal
SINGLE_PRECISION = 1e-5
"""Smallest tolerance for which products in single precision are accurate enough."""
CHUNK_BYTES = 4e8
"""Largest size of the visibilities of one chunk of a smooth sky, unless there are too few chunks."""
PATCH_SOURCES = 700
"""Smallest mean number of sources in a patch of the sky, about the number in one matrix product."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of interpolated visibilities, and whether beam and fluxes vary smoothly with frequency.

    `tolerance` is the error relative to the rms of the visibilities if all fringes were as fast as the fastest one;
    with 0 nothing is interpolated. `beam_extent`, m, is added to each baseline for the structure of the beam in fringe
    rate and delay.
    """

    tolerance: float
    beam_extent: float
    smooth_beam: bool = True
    smooth_sky: bool = True


EXACT = Accuracy(tolerance=0.0, beam_extent=0.0)
"""Every source is simulated at every integration and channel."""


@dataclass(frozen=True)
class Axis:
    """Nodes along time or frequency, Julian dates (UTC) or Hz, (n,), and the matrix that interpolates from them.

    The matrix, (m, n), is from values at the nodes to values at the m samples of the axis.
    """

    nodes: np.ndarray
    matrix: np.ndarray

    @property
    def at_samples(self) -> bool:
        """Whether the nodes are the samples, so that nothing is interpolated."""
        return self.matrix.shape[0] == self.matrix.shape[1] and bool((self.matrix == np.eye(len(self.nodes))).all())

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Interpolate complex values (n, ...) at the nodes to the samples, (m, ...)."""
        if self.at_samples:
            return values
        # Complex values are taken as pairs of real numbers, because NumPy would make the matrix complex.
        pairs = np.ascontiguousarray(values).view(np.float64).reshape(len(self.nodes), -1)
        return (self.matrix @ pairs).view(np.complex128).reshape(len(self.matrix), *values.shape[1:])


def make_axis(samples: np.ndarray, bandwidth: float, tolerance: float) -> Axis:
    """Choose the nodes from which phasors are interpolated to ascending samples, (m,), to a tolerance.

    With a tolerance of 0, or if as many nodes as samples are needed, the nodes are the samples.
    """
    count = chebyshev_count(bandwidth, tolerance) if tolerance else len(samples)
    if count >= len(samples):
        return Axis(samples, np.eye(len(samples)))
    nodes = chebyshev_nodes(samples.min(), samples.max(), count)
    return Axis(nodes, interpolation_matrix(nodes, samples))


@lru_cache(maxsize=256)
def chebyshev_count(bandwidth: float, tolerance: float) -> int:
    """Return the number of Chebyshev nodes that interpolate every phasor of a bandwidth to a tolerance.

    It is the smallest n with 4 sum_{k >= n} |J_k(c)| < tolerance, a bound of the error of the interpolant on n nodes
    for phasors of unit amplitude. The bandwidth c is half the phase in radians through which the fastest phasor exp(i c
    x) turns over the interval |x| <= 1.
    """
    # Beyond c + 12 c^(1/3) + 40 the Bessel functions are below the smallest double that matters.
    orders = np.arange(int(bandwidth + 12 * np.cbrt(bandwidth) + 40))
    bounds = 4 * np.cumsum(np.abs(jv(orders, bandwidth))[::-1])[::-1]
    return max(1, int(np.argmax(bounds < tolerance)))


def chebyshev_nodes(first: float, last: float, count: int) -> np.ndarray:
    """Return the Chebyshev nodes of the first kind in an interval, (count,), ascending and strictly inside it."""
    angles = np.pi * (np.arange(count)[::-1] + 0.5) / count
    return first + 0.5 * (last - first) * (1 + np.cos(angles))


def interpolation_matrix(nodes: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the matrix (m, n) from values at the nodes to those of their interpolating polynomial at the samples (m,).

    It is the barycentric interpolation of the second kind (Berrut & Trefethen 2004). The nodes, (n,), are near those of
    Chebyshev; a Julian date holds a time only to 40 us, so the weights are computed from the rounded nodes.
    """
    centre = nodes[len(nodes) // 2]
    half = np.ptp(np.concatenate([nodes, samples])) / 2 or 1.0
    # The interval of length 4 has capacity 1: products of its differences neither overflow nor underflow.
    x, y = 2 * (nodes - centre) / half, 2 * (samples - centre) / half
    differences = x[:, None] - x
    np.fill_diagonal(differences, 1.0)
    weights = 1 / np.prod(differences, axis=1)
    offsets = y[:, None] - x
    hits = offsets == 0
    # A sample that is a node has its value.
    terms = np.where(hits.any(axis=1, keepdims=True), hits, weights / np.where(hits, 1.0, offsets))
    return terms / terms.sum(axis=1, keepdims=True)


def time_axis(template: UVData, accuracy: Accuracy) -> Axis:
    """Choose the times at which sources that stay above the horizon are simulated.

    On the longest baselines many sources are close to the bound of the error, so a tenth of the tolerance is used.
    """
    times = integration_times(template)
    bandwidth = time_bandwidth(times, template.freq_array.max(), turning_length(template) + accuracy.beam_extent)
    return make_axis(times, bandwidth, 0.1 * accuracy.tolerance)


def frequency_axis(template: UVData, accuracy: Accuracy, radius: float = 1.0) -> Axis:
    """Choose the frequencies at which a sky is simulated: every channel, unless sky and beam are smooth.

    `radius` is the largest distance of a source from the direction to which fringes are relative, rad; 1: the zenith.
    """
    channels = template.freq_array
    smooth = accuracy.smooth_beam and accuracy.smooth_sky
    length = radius * np.linalg.norm(baseline_vectors(template), axis=1).max() + accuracy.beam_extent
    return make_axis(channels, frequency_bandwidth(channels, length), accuracy.tolerance if smooth else 0.0)


def turning_length(template: UVData) -> float:
    """Return the length of the longest component (m) of a baseline perpendicular to the Earth's axis.

    Sources move only perpendicular to the axis, so this component determines how fast fringes turn.
    """
    latitude = template.telescope.location.geodetic.lat.rad
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    return float(np.linalg.norm(np.cross(baseline_vectors(template), pole), axis=1).max())


def time_bandwidth(times_jd: np.ndarray, frequency: float, length: float) -> float:
    """Return half the phase in radians through which the fastest fringe turns over a range of Julian dates.

    `frequency` is the highest frequency, Hz, and `length` the longest baseline perpendicular to the Earth's axis, m.
    """
    rotation = EARTH_ROTATION_RATE * SECONDS_PER_DAY * np.ptp(times_jd)
    return float(np.pi * frequency / SPEED_OF_LIGHT * length * rotation)


def frequency_bandwidth(frequencies: np.ndarray, length: float) -> float:
    """Return half the phase in radians through which the delay of a length in m turns across a band."""
    return float(np.pi * length / SPEED_OF_LIGHT * np.ptp(frequencies))


def patch_nside(components: float) -> int:
    """Return the resolution of the grid whose cells are patches, for a number of components; 0: one patch."""
    cells = components / PATCH_SOURCES
    return int(2 ** np.floor(np.log2(cells / 12) / 2)) if cells >= 12 else 0


def frequency_blocks(size: float, chunks: int) -> int:
    """Return the number of blocks of frequency nodes of a smooth sky whose visibilities have a total size in bytes."""
    return min(chunks, int(np.ceil(size / CHUNK_BYTES)))


def integration_times(template: UVData) -> np.ndarray:
    """Return the Julian date of each integration, (Ntimes,), of a time-major data set."""
    return template.time_array[:: template.Nbls]
