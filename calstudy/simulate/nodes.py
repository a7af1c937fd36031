"""Chebyshev nodes: times and frequencies from which visibilities can be interpolated to a tolerance.

Over an observation a visibility is band-limited, in time by its fringe rate and in frequency by its horizon delay. The
component of a source is a phasor exp(i c x) on the scaled interval x in [-1, 1], whose Chebyshev coefficients 2 J_k(c)
fall faster than exponentially once k > c. The number of nodes therefore follows from the longest baseline, the span and
the tolerance. It does not depend on the engine.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import jv

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.visibilities import baseline_vectors
from calstudy.instrument.size import baseline_lengths

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.instrument.settings import InstrumentSettings
    from calstudy.simulate.settings import Nodes

EARTH_ROTATION_RATE = 7.2921158553e-5  # rad / s, sidereal
SECONDS_PER_DAY = 86400.0


@dataclass(frozen=True)
class NodeGrid:
    """Times and frequencies to simulate, and the matrices that interpolate from them.

    Attributes
    ----------
    times_jd : (Nt,) float
        Julian dates (UTC) to simulate.
    frequencies : (Nf,) float
        Frequencies to simulate, Hz.
    time_matrix : (Ntimes, Nt) float
        Values at the nodes to values at the integrations.
    frequency_matrix : (Nfreqs, Nf) float
        Values at the nodes to values at the channels.
    """

    times_jd: np.ndarray
    frequencies: np.ndarray
    time_matrix: np.ndarray
    frequency_matrix: np.ndarray

    @property
    def at_integrations(self) -> bool:
        """Whether the times are the integrations themselves."""
        return _is_identity(self.time_matrix)

    @property
    def at_channels(self) -> bool:
        """Whether the frequencies are the channels themselves."""
        return _is_identity(self.frequency_matrix)

    def interpolate_times(self, cube: np.ndarray) -> np.ndarray:
        """Return a (Nt, ...) cube at all integrations, (Ntimes, ...)."""
        return cube if self.at_integrations else np.tensordot(self.time_matrix, cube, axes=(1, 0))

    def interpolate_frequencies(self, cube: np.ndarray) -> np.ndarray:
        """Return a (Ntimes, Nbls, Nf, Npols) cube at all channels, (Ntimes, Nbls, Nfreqs, Npols)."""
        return cube if self.at_channels else np.matmul(self.frequency_matrix, cube)

    def interpolate(self, cube: np.ndarray) -> np.ndarray:
        """Return a (Nt, Nbls, Nf, Npols) cube at all integrations and channels, (Ntimes, Nbls, Nfreqs, Npols)."""
        return self.interpolate_frequencies(self.interpolate_times(cube))


def _is_identity(matrix: np.ndarray) -> bool:
    return matrix.shape[0] == matrix.shape[1] and bool((matrix == np.eye(len(matrix))).all())


@lru_cache(maxsize=256)
def chebyshev_count(bandwidth: float, tolerance: float) -> int:
    """Return how many Chebyshev nodes interpolate every phasor of a bandwidth to a tolerance.

    Parameters
    ----------
    bandwidth
        Half the phase in radians through which the fastest phasor turns over the interval: c in exp(i c x), |x| <= 1.
    tolerance
        Largest error for a phasor of unit amplitude.

    Returns
    -------
    int
        Smallest n with 4 sum_{k >= n} |J_k(c)| < tolerance, a bound of the error of the interpolant on n nodes.
    """
    # Beyond c + 12 c^(1/3) + 40 the Bessel functions are below the smallest double that matters.
    orders = np.arange(int(bandwidth + 12 * np.cbrt(bandwidth) + 40))
    bounds = 4 * np.cumsum(np.abs(jv(orders, bandwidth))[::-1])[::-1]
    return max(1, int(np.argmax(bounds < tolerance)))


def chebyshev_nodes(first: float, last: float, count: int) -> np.ndarray:
    """Return the `count` Chebyshev nodes of the first kind in the interval, (count,), strictly inside it, ascending.

    Parameters
    ----------
    first, last
        Ends of the interval.
    count
        Number of nodes.
    """
    angles = np.pi * (np.arange(count)[::-1] + 0.5) / count
    return first + 0.5 * (last - first) * (1 + np.cos(angles))


def interpolation_matrix(nodes: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the matrix from values at the nodes to values of their interpolating polynomial at the samples.

    Parameters
    ----------
    nodes : (n,) float
        Distinct abscissae, near Chebyshev nodes for a well-conditioned result. They need not be exact: a Julian date
        holds a time only to 40 us, so the weights are those of the nodes as they are.
    samples : (m,) float

    Returns
    -------
    (m, n) float
        Barycentric interpolation of the second kind (Berrut & Trefethen 2004).
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
    terms = weights / np.where(hits, 1.0, offsets)
    matrix = terms / terms.sum(axis=1, keepdims=True)
    exact = hits.any(axis=1)
    matrix[exact] = hits[exact]
    return matrix


def time_bandwidth(template: UVData, beam_extent: float) -> float:
    """Return half the phase in radians through which the fastest fringe turns from the first to the last integration.

    A source moves perpendicular to the Earth's axis only, so it is the baselines' component perpendicular to it that
    counts, lengthened by `beam_extent` metres for the beam's own drift.
    """
    times = integration_times(template)
    latitude = template.telescope.location.geodetic.lat.rad
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    length = np.linalg.norm(np.cross(baseline_vectors(template), pole), axis=1).max() + beam_extent
    rotation = EARTH_ROTATION_RATE * SECONDS_PER_DAY * np.ptp(times)
    return float(np.pi * template.freq_array.max() / SPEED_OF_LIGHT * length * rotation)


def frequency_bandwidth(template: UVData, beam_extent: float) -> float:
    """Return half the phase in radians through which the longest horizon delay turns across the band."""
    length = np.linalg.norm(baseline_vectors(template), axis=1).max() + beam_extent
    return float(np.pi * length / SPEED_OF_LIGHT * np.ptp(template.freq_array))


def integration_times(template: UVData) -> np.ndarray:
    """Return the Julian date of each integration, (Ntimes,), of a time-major data set."""
    return template.time_array[:: template.Nbls]


def _axis(samples: np.ndarray, bandwidth: float, settings: Nodes) -> tuple[np.ndarray, np.ndarray]:
    count = chebyshev_count(bandwidth, settings.tolerance)
    if count >= len(samples):
        return samples, np.eye(len(samples))
    nodes = chebyshev_nodes(samples.min(), samples.max(), count)
    return nodes, interpolation_matrix(nodes, samples)


def node_counts(instrument: InstrumentSettings, settings: Nodes) -> tuple[int, int]:
    """Return how many time and frequency nodes a smooth sky takes, about, from the settings alone: for plans.

    Parameters
    ----------
    instrument
        The `instrument` section.
    settings
        Tolerance and extent of the beam, or `enabled=False` for every integration and channel.
    """
    times, channels = instrument.times, instrument.channels
    if not settings.enabled:
        return times.count, channels.count
    length = baseline_lengths(instrument.layout)[0] + settings.beam_extent
    low, high = channels.band
    rotation = EARTH_ROTATION_RATE * times.integration * (times.count - 1)
    in_time = chebyshev_count(np.pi * high / SPEED_OF_LIGHT * length * rotation, settings.tolerance)
    in_frequency = chebyshev_count(np.pi * length / SPEED_OF_LIGHT * (high - low), settings.tolerance)
    return min(in_time, times.count), min(in_frequency, channels.count)


def node_grid(template: UVData, settings: Nodes, smooth_in_frequency: bool) -> NodeGrid:
    """Choose the nodes for an observation.

    Parameters
    ----------
    template
        The observation to be simulated.
    settings
        Tolerance, extent of the beam, or `enabled=False` for every integration and channel.
    smooth_in_frequency
        Whether sky and beam vary smoothly in frequency. If not, every channel is a node.

    Returns
    -------
    NodeGrid
        An axis that needs as many nodes as it has samples gets its samples.
    """
    times, frequencies = integration_times(template), template.freq_array
    if not settings.enabled:
        return NodeGrid(times, frequencies, np.eye(len(times)), np.eye(len(frequencies)))
    node_times, time_matrix = _axis(times, time_bandwidth(template, settings.beam_extent), settings)
    if not smooth_in_frequency:
        return NodeGrid(node_times, frequencies, time_matrix, np.eye(len(frequencies)))
    bandwidth = frequency_bandwidth(template, settings.beam_extent)
    node_frequencies, frequency_matrix = _axis(frequencies, bandwidth, settings)
    return NodeGrid(node_times, node_frequencies, time_matrix, frequency_matrix)
