"""Visibilities of sources in patches of the sky, in which fringes turn slowly.

The sources of one patch of the sky turn together. With the direction s_0(t) of the patch's centre,

    V_ab(nu, t) = sum_patches  exp(2 pi i nu x_ab . s_0(t) / c)  W_ab(nu, t),
    W_ab(nu, t) = sum_{s in patch}  w_s(nu, t)  exp(2 pi i nu x_ab . (s(t) - s_0(t)) / c),

and W turns more slowly than V, by a factor of the radius of the patch in radians, in time and in frequency. It is
therefore simulated at few Chebyshev nodes and interpolated: in time, and in frequency where sky and beam are smooth.
The phase of the centre is exact, in double precision.

Errors of patches are independent and add in quadrature, so that each may contribute the same variance: a patch in the
sidelobes, with a hundredth of the signal, needs a hundredth of the relative accuracy.

W is summed by matrix products. For many antennas without heights, in single precision, it is summed by non-uniform
Fourier transforms, for which larger patches are better.

Patches are added up at the time nodes of the whole sky, and interpolated from there to the integrations. Sources that
rise or set are discontinuous in time: their patches are simulated at every integration.
"""

from __future__ import annotations

from itertools import pairwise

import numba
import numpy as np
from pyradiosky import SkyModel
from pyuvdata import UVData

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.visibilities import antenna_indices, baseline_vectors, require_rectangular
from calstudy.instrument.antenna_beams import split_beams
from calstudy.instrument.interface import AntennaBeam, AntennaBeams
from calstudy.simulate.interface import polarization_feeds
from calstudy.simulate.nodes import (
    SINGLE_PRECISION,
    Accuracy,
    Axis,
    frequency_axis,
    frequency_bandwidth,
    integration_times,
    make_axis,
    patch_nside,
    time_axis,
    time_bandwidth,
    turning_length,
)
from calstudy.simulate.patterns import InterpolatedPattern, Pattern, power_pattern
from calstudy.simulate.source_sums import FlatArray, FlatSums, PairSums, angles, flat_array, product_seconds
from calstudy.simulate.sources import SourceTracks, sky_cells, split_by_horizon, stokes_i

MARGIN = 2
"""Factor by which transforms must be faster than products to be used, because the estimates are not exact."""
PATTERN_SECONDS, TURN_SECONDS = 3e-7, 1.2e-8
"""Time to evaluate the beam at a source, and the phase of a patch's centre for a baseline, s."""
SINGLE_TURNS = 8.0
"""Turns of a fringe across the band up to which single precision keeps phases to 3e-6 rad."""
LEAST, LOOSEST = 1e-30, 0.5
"""Smallest signal of a patch over the rms that counts, and the largest relative error of a patch."""


def visibilities(
    sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy, dtype: type | None = None
) -> np.ndarray:
    """Simulate an unpolarized sky, (Ntimes, Nbls, Nfreqs, Npols) complex128, Jy.

    With a tolerance of 0 every source is simulated at every integration and channel. `dtype` is the precision of the
    products, float64 or float32; by default single precision if the tolerance allows it. Raises InputError if
    polarizations or beam are not supported.
    """
    array = PatchedArray(beam, template, accuracy)
    dtype = dtype or (np.float32 if accuracy.tolerance >= SINGLE_PRECISION else np.float64)
    times, common = integration_times(template), time_axis(template, accuracy)
    tracks = SourceTracks.of(sky, template.telescope.location, times)
    always_up, crossing = split_by_horizon(tracks, times)
    total = np.zeros((template.Nfreqs, len(common.nodes), template.Npols, template.Nbls), dtype=np.complex128)
    if len(always_up):
        steady = Patches(sky, tracks, always_up, array.choose_nside(sky.Ncomponents, common.nodes, dtype))
        patches = PatchSum(array, sky, steady, dtype)
        for place, tolerance in enumerate(array.tolerances(steady, sky)):
            axis = array.time_nodes(steady.radii[place], float(tolerance), common.nodes)
            patches.add(total, place, axis, common.nodes)
    # Axes: integrations, channels, feeds, baselines.
    cube = common.interpolate(total.swapaxes(0, 1))
    if len(crossing):
        # They are few, and simulated at every integration: one patch is enough.
        patches = PatchSum(array, sky, Patches(sky, tracks, crossing, nside=0), dtype)
        patches.add(cube.swapaxes(0, 1), 0, Axis(times, np.eye(len(times))), times)
    return np.ascontiguousarray(cube.transpose(0, 3, 1, 2))


class Patches:
    """Sources sorted by patch of the sky; the patches are the cells of a grid, or one patch if `nside` is 0.

    `components`, (N,), and their `tracks` are in the order of the patches, each of which has a slice in `members`. Its
    centre is the mean direction, a fixed point of the sky as sources are. `radii`, (Npatches,), are the largest
    distances of a source from the centre of its patch, rad.
    """

    def __init__(self, sky: SkyModel, tracks: SourceTracks, components: np.ndarray, nside: int) -> None:
        cells = sky_cells(sky, nside)[components]
        order = np.argsort(cells, kind="stable")
        self.components = components[order]
        self.tracks = tracks.select(self.components)
        starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
        self.members = [slice(*ends) for ends in pairwise([*starts.tolist(), len(order)])]
        sizes = np.diff(starts, append=len(order))
        centres = np.add.reduceat(self.tracks.vectors, starts, axis=2) / sizes
        self.centres = SourceTracks(tracks.nodes, centres)
        offsets = self.tracks.vectors[0] - np.repeat(centres[0], sizes, axis=1)
        self.radii = np.maximum.reduceat(np.linalg.norm(offsets, axis=0), starts)


class PatchedArray:
    """The antennas and beams of an observation, and the times and frequencies at which patches are simulated."""

    def __init__(self, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy) -> None:
        require_rectangular(template)
        self.template, self.accuracy = template, accuracy
        used, pairs = np.unique(antenna_indices(template), return_inverse=True)
        self._beams, index = split_beams(beam, template)
        self._index, self._feeds = index[used], polarization_feeds(template)
        self.delays = template.telescope.get_enu_antpos()[used] / SPEED_OF_LIGHT
        first, second = pairs.reshape(-1, 2).T
        self.pairs = np.ascontiguousarray(first), np.ascontiguousarray(second)
        self._flat = flat_array(self.delays, self.pairs) if len(self._beams) == 1 else None
        self._turning = turning_length(template)
        self._longest = np.linalg.norm(baseline_vectors(template), axis=1).max()

    def turns(self, radius: float) -> float:
        """Return the change of fringes within a patch of a radius (rad) across the band, in turns."""
        return radius * self._longest * float(np.ptp(self.template.freq_array)) / SPEED_OF_LIGHT

    def time_nodes(self, radius: float, tolerance: float, times: np.ndarray) -> Axis:
        """Choose the times at which a patch is simulated, from which it is interpolated to `times` (Julian dates)."""
        length = self._turning * radius + self.accuracy.beam_extent
        return make_axis(times, time_bandwidth(times, self.template.freq_array.max(), length), tolerance)

    def tolerances(self, patches: Patches, sky: SkyModel) -> np.ndarray:
        """Return the allowed relative error of each patch, (Npatches,), so that all contribute the same variance.

        The variance of a patch is the sum of the squares of its sources, at the middle integration and channel, each
        through the beam in which it is brightest.
        """
        if not self.accuracy.tolerance:
            return np.zeros(len(patches.members))
        channel = self.template.freq_array[[self.template.Nfreqs // 2]]
        time = integration_times(self.template)[self.template.Ntimes // 2]
        directions = angles(patches.tracks.at(time))
        response = np.maximum.reduce([pattern.at(*directions)[:, 0] for pattern in self._patterns(channel)])
        weights = response * stokes_i(sky, channel, patches.components)
        signal = np.sqrt([np.sum(weights[:, members] ** 2) for members in patches.members])
        rms = np.sqrt(np.mean(signal**2))
        return np.minimum(self.accuracy.tolerance * rms / np.maximum(signal, LEAST * rms), LOOSEST) if rms else signal

    def choose_nside(self, sources: int, times: np.ndarray, dtype: type) -> int:
        """Choose the grid whose cells are patches: small ones for products, or the best one if transforms are faster.

        `times` are the Julian dates to which patches are interpolated, (Nt,), and `dtype` is that of the products.
        """
        small = patch_nside(sources)
        if self._flat is None or dtype is np.float64 or not small:
            return small
        products = self._seconds(sources, small, times, None)
        grids = [small >> step for step in range(small.bit_length())]
        seconds = {nside: self._seconds(sources, nside, times, self._flat) for nside in grids}
        best = min(grids, key=seconds.__getitem__)
        return best if MARGIN * seconds[best] < products else small

    def sums(self, frequencies: np.ndarray, dtype: type, sources: float, radius: float) -> PairSums | FlatSums:
        """Return the summation that is faster for a typical patch, given its number of sources and its radius (rad).

        `frequencies` are in Hz. `dtype` is the precision of products; transforms have single precision.
        """
        patterns = self._patterns(frequencies)
        if self._flat and dtype is not np.float64:
            seconds = self._flat.seconds(frequencies[-1], sources, radius)
            if MARGIN * seconds < product_seconds(len(self.delays), sources):
                return FlatSums(self._flat, frequencies, patterns[0])
        return PairSums(self.delays, self.pairs, frequencies, patterns, self._index, dtype)

    def _seconds(self, sources: int, nside: int, times: np.ndarray, flat: FlatArray | None) -> float:
        """Estimate the time of all patches of a grid, by transforms of a flat array or by products."""
        patches, radius = 6 * nside**2, 0.7 / nside
        nodes = len(self.time_nodes(radius, self.accuracy.tolerance, times).nodes)
        channels, each = frequency_axis(self.template, self.accuracy, radius).nodes, sources / 2 / patches
        sums = flat.seconds(channels[-1], each, radius) if flat else product_seconds(len(self.delays), each)
        turned = TURN_SECONDS * len(times) * self.template.Nfreqs * len(self.pairs[0])
        return patches * (nodes * len(channels) * (PATTERN_SECONDS * each + sums) + turned)

    def _patterns(self, frequencies: np.ndarray) -> list[Pattern]:
        """Return the patterns of the distinct beams, interpolated from fewer frequencies where they are smooth."""
        bandwidth = frequency_bandwidth(frequencies, self.accuracy.beam_extent)
        axis = make_axis(frequencies, bandwidth, self.accuracy.tolerance if self.accuracy.smooth_beam else 0.0)
        found = [power_pattern(beam.at(axis.nodes), axis.nodes, self._feeds) for beam in self._beams]
        if axis.at_samples:
            return found
        return [InterpolatedPattern(pattern, axis.matrix) for pattern in found]


class PatchSum:
    """Simulates patches and adds them up."""

    def __init__(self, array: PatchedArray, sky: SkyModel, patches: Patches, dtype: type) -> None:
        self._array, self._patches = array, patches
        self._channels = frequency_axis(array.template, array.accuracy, patches.radii.max())
        if array.turns(patches.radii.max()) > SINGLE_TURNS:
            dtype = np.float64
        sources = len(patches.components) / len(patches.members)
        self._sums = array.sums(self._channels.nodes, dtype, sources, patches.radii.max())
        self._flux = stokes_i(sky, self._channels.nodes, patches.components)

    def add(self, total: np.ndarray, place: int, axis: Axis, times: np.ndarray) -> None:
        """Add the patch of index `place` to a total (Nfreqs, Nt, Nfeeds, Nbls) at the Julian dates `times`, (Nt,).

        `axis` has the time nodes of the patch. If every time is a node, sources may be below the horizon.
        """
        if not axis.at_samples:
            self._add(total, place, axis, times)
            return
        for step in range(len(times)):
            now = times[step : step + 1]
            self._add(total[:, step : step + 1], place, Axis(now, np.eye(1)), now)

    def _add(self, total: np.ndarray, place: int, axis: Axis, times: np.ndarray) -> None:
        members, inner = self._patches.members[place], []
        flux = self._flux[:, members]
        centres = self._patches.centres.at(axis.nodes, slice(place, place + 1))[..., 0]
        for vectors, centre in zip(self._patches.tracks.at(axis.nodes, members), centres, strict=True):
            up = vectors[2] > 0
            inner.append(
                self._sums.at(vectors, centre, flux) if up.all() else self._sums.at(vectors[:, up], centre, flux[:, up])
            )
        at_channels = self._channels.interpolate(np.stack(inner, axis=1))
        _add_turned(total, at_channels, axis.matrix, self._centre_fringes(place, times), *self._array.pairs)

    def _centre_fringes(self, place: int, times: np.ndarray) -> np.ndarray:
        """Return exp(2 pi i nu x.s_0 / c) of all antennas, (Nfreqs, Nt, Nants)."""
        delays = self._array.delays @ self._patches.centres.at(times, slice(place, place + 1))[..., 0].T
        turns = self._array.template.freq_array[:, None, None] * delays.T
        return np.exp(2j * np.pi * (turns - np.round(turns)))


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _add_turned(
    total: np.ndarray, inner: np.ndarray, matrix: np.ndarray, fringes: np.ndarray, first: np.ndarray, second: np.ndarray
) -> None:
    """Add inner (Nfreqs, Nk, Nfeeds, Nbls), interpolated in time and multiplied by the fringes of the centre."""
    turn, value = np.empty(first.size, dtype=np.complex128), np.empty(first.size, dtype=np.complex128)
    for channel in range(total.shape[0]):
        for time in range(total.shape[1]):
            fringe = fringes[channel, time]
            for pair in range(first.size):
                turn[pair] = fringe[first[pair]].conjugate() * fringe[second[pair]]
            for feed in range(total.shape[2]):
                value[:] = 0.0
                for node in range(inner.shape[1]):
                    weight, row = matrix[time, node], inner[channel, node, feed]
                    for pair in range(value.size):
                        value[pair] += weight * row[pair]
                row = total[channel, time, feed]
                for pair in range(value.size):
                    row[pair] += value[pair] * turn[pair]
