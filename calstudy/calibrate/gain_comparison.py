"""Compare two sets of gains, free of the degeneracies of calibration, and in units of their errors.

Errors of gains leave out what no data determine, and gains that are smooth in frequency where foregrounds are free
(`calstudy.calibrate.gain_errors`). These are taken out of ln (g1 / g2) before it is divided by the errors of both:

    pull = Re or Im of ln (g1 / g2) / sqrt(sigma_1^2 + sigma_2^2),

with a mean square of one if the gains differ by independent noise alone. Both errors must leave out the same delays:
what one of them contains, and the other does not, is taken out of the difference, but not of its error.

Errors from N realizations of the noise are known to 1 / sqrt(2 (N - 1)). Pulls then have Student's distribution, with
nu degrees of freedom and a mean square of nu / (nu - 2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pyuvdata import UVCal

from calstudy.base.errors import InputError
from calstudy.base.feeds import with_feeds_of
from calstudy.base.gains import SAME_CHANNEL, ErrorsOfFile, closest_solutions, known_gains, solution_times
from calstudy.base.visibilities import polarization_names, positions
from calstudy.calibrate.agreement import LIMITS, TAPER, aligned_gains
from calstudy.calibrate.basis import ChannelGrid
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.gain_errors import determined_spans, within
from calstudy.instrument.layouts import redundant_groups
from calstudy.power.delay import channel_width, delay_transform, delays

GRADIENT_STEPS, GRADIENT_TOLERANCE = 50, 1e-12
REDUNDANT = 1.0
"""m. Baselines that differ by less are redundant."""
NOT_PARALLEL = 0.3
"""Minimum sine of the angle between two baselines that span the plane."""
SAME_DELAY = 1e-3
"""Relative difference of delays up to which two errors leave out the same gains."""
MOST_GRID = 100
"""Channels of a grid for each channel of the gains, above which their spacing is taken for an error."""
FEWEST_REALIZATIONS = 10
"""From which errors are known well enough for chi^2."""


@dataclass(frozen=True, eq=False)
class GainPair:
    """Gains of the same antennas, integrations and channels from two sources; zero where either has none.

    Antennas have names, (Nants,), and positions east and north, m, (Nants, 2); channel centres are in Hz, (Nfreqs,).
    Gains are complex, (Ntimes, Nants, Nfreqs), of the convention "divide". Errors are of the real and the imaginary
    part of ln (first / second), (2, Ntimes, Nants, Nfreqs), NaN where there is none; None if they are not known.
    Sequences in frequency up to `smooth_delay`, s, are no part of them. The degrees of freedom of their squares are
    infinite if they are exact.
    """

    antennas: np.ndarray
    positions: np.ndarray
    frequency: np.ndarray
    polarization: str
    first: np.ndarray
    second: np.ndarray
    errors: np.ndarray | None = None
    smooth_delay: float = 0.0
    degrees_of_freedom: float = np.inf


@dataclass(frozen=True, eq=False)
class GainDifference:
    """The difference of two sets of gains: rms of the difference over the rms of the second.

    The first gains of the pair are aligned with the second; `as_given` is the difference before that, of all antennas
    together. Differences of antennas, (Nants,), and channels, (Nfreqs,), are NaN where there are no gains; `of_delay`
    is the ratio of the Blackman-Harris tapered transforms at ascending delays, s, (Ndelays,). `pulls` are the
    deviations of amplitudes and phases over their errors, (2, Ntimes, Nants, Nfreqs), NaN where there are none; None if
    errors are not known.
    """

    pair: GainPair
    as_given: float
    of_antenna: np.ndarray
    of_channel: np.ndarray
    delay: np.ndarray
    of_delay: np.ndarray
    pulls: np.ndarray | None = None

    @property
    def together(self) -> float:
        """Rms of the difference of all antennas over that of the second gains."""
        squares = [np.sum(np.abs(gains) ** 2) for gains in (self.pair.first - self.pair.second, self.pair.second)]
        return float(np.sqrt(squares[0] / squares[1]))

    @property
    def chi_squared(self) -> list[float]:
        """Mean square of the pulls over its expectation, of amplitudes and phases; empty if errors are not known."""
        degrees = self.pair.degrees_of_freedom
        expected = 1.0 if math.isinf(degrees) else degrees / (degrees - 2)
        return [] if self.pulls is None else [float(np.nanmean(part**2)) / expected for part in self.pulls]

    @property
    def within(self) -> list[list[float]]:
        """Fractions of amplitudes and of phases within `LIMITS` errors; empty if errors are not known."""
        known = [] if self.pulls is None else [np.abs(part[np.isfinite(part)]) for part in self.pulls]
        return [[float(np.mean(part < limit)) for limit in LIMITS] for part in known]

    @property
    def expected_within(self) -> list[float]:
        """The same where independent noise makes all of the difference."""
        from scipy.stats import t

        return [float(2 * t.cdf(limit, self.pair.degrees_of_freedom) - 1) for limit in LIMITS]


def pair_gains(
    first: UVCal, second: UVCal, polarization: int = 0, errors: tuple[ErrorsOfFile, ErrorsOfFile] | None = None
) -> GainPair:
    """Select the gains that two files have in common, and combine their errors.

    Gains may be of either convention. An integration of the first is compared with the closest of the second.
    `polarization` is the index among the feeds that both have, as the first calls them. Errors have the axes of the
    gains. The files are from `calstudy.base.gains.at_common_channels`. Raises InputError if the two have no antennas,
    no such feed, or not the same channels in common.
    """
    second = with_feeds_of(second, first)
    numbers = np.intersect1d(first.ant_array, second.ant_array)
    feeds = [int(feed) for feed in first.jones_array if feed in second.jones_array]
    if not numbers.size:
        raise InputError("the two files have no antenna in common")
    if polarization >= len(feeds):
        has = [polarization_names(cal.jones_array) for cal in (first, second)]
        raise InputError(
            f"the two files have {len(feeds)} feed(s) in common, and there is no number {polarization}: the first has "
            f"gains of {has[0]}, the second of {has[1]}"
        )
    frequencies = [np.sort(np.ravel(cal.freq_array)) for cal in (first, second)]
    width = float(np.min(first.channel_width))
    if len(frequencies[0]) != len(frequencies[1]) or np.abs(np.subtract(*frequencies)).max() > SAME_CHANNEL * width:
        raise InputError("the two files do not have the same channels")
    closest = closest_solutions(second, solution_times(first))
    values, known = zip(*(_gains(cal, numbers, feeds[polarization]) for cal in (first, second)), strict=True)
    used = known[0] & known[1][closest]
    combined = None
    if errors is not None:
        pairs = zip((first, second), errors, strict=True)
        of_first, of_second = (_relative_errors(*pair, numbers, feeds[polarization]) for pair in pairs)
        combined = np.where(used, np.hypot(of_first, of_second[:, closest]), np.nan)
    telescope = first.telescope
    rows = positions(telescope.antenna_numbers, numbers)
    return GainPair(
        antennas=np.array(telescope.antenna_names)[rows],
        positions=telescope.get_enu_antpos()[rows, :2],
        frequency=frequencies[0],
        polarization={-5: "x", -6: "y", -1: "r", -2: "l"}.get(feeds[polarization], str(feeds[polarization])),
        first=np.where(used, values[0], 0),
        second=np.where(used, values[1][closest], 0),
        errors=combined,
        smooth_delay=0.0 if errors is None else max(one.smooth_delay for one in errors),
        degrees_of_freedom=np.inf if errors is None else _degrees_of_freedom(errors),
    )


def obstacle(one: ErrorsOfFile, other: ErrorsOfFile) -> str | None:
    """Explain in a few words why gains are not compared in units of their errors, or return None."""
    delays = [one.smooth_delay, other.smooth_delay]
    if not all(map(math.isfinite, delays)):
        return "a file of an earlier version does not say what they leave out"
    if not math.isclose(*delays, rel_tol=SAME_DELAY):
        return f"they leave out gains up to {1e9 * delays[0]:.0f} and {1e9 * delays[1]:.0f} ns"
    fewest = min((errors.realizations for errors in (one, other) if errors.realizations), default=FEWEST_REALIZATIONS)
    if fewest < FEWEST_REALIZATIONS:
        return f"they are of {fewest} realizations, and it takes {FEWEST_REALIZATIONS}"
    return None


def _degrees_of_freedom(errors: Sequence[ErrorsOfFile]) -> float:
    """Return the degrees of freedom of the sum of two estimates of a variance that are about as large."""
    inverse = sum(1 / (one.realizations - 1) for one in errors if one.realizations)
    return 4 / inverse if inverse else np.inf


def _of_feed(cal: UVCal, array: np.ndarray, numbers: np.ndarray, feed: int) -> np.ndarray:
    """Return (Ntimes, Nants, Nfreqs), channels ascending, of an array with the axes of the gains."""
    column = int(np.flatnonzero(cal.jones_array == feed)[0])
    return np.moveaxis(
        array[positions(cal.ant_array, numbers)][..., column][:, np.argsort(np.ravel(cal.freq_array))], 2, 0
    )


def _relative_errors(cal: UVCal, errors: ErrorsOfFile, numbers: np.ndarray, feed: int) -> np.ndarray:
    """Return the errors of the real and the imaginary part of ln g, (2, Ntimes, Nants, Nfreqs)."""
    relative = np.divide(
        errors.amplitude, np.abs(cal.gain_array), out=np.full(errors.amplitude.shape, np.nan), where=cal.gain_array != 0
    )
    return np.stack([_of_feed(cal, part, numbers, feed) for part in (relative, errors.phase)])


def _gains(cal: UVCal, numbers: np.ndarray, feed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and the mask of valid ones, (Ntimes, Nants, Nfreqs), channels ascending."""
    gains, known = (_of_feed(cal, array, numbers, feed) for array in known_gains(cal))
    return np.where(known, gains, 0), known


def compare_gains(pair: GainPair, redundant: bool = False) -> GainDifference:
    """Compare two sets of gains, free of one phase per channel and one real scale for each integration.

    With `redundant`, one amplitude and one phase gradient across the array in every channel are removed as well, which
    the redundancy of an array does not determine. On a lattice a gradient may be of any number of turns per baseline,
    elsewhere it must be less than half a turn per baseline. Raises InputError if the two have no gains in common, or
    fewer than two channels, or channels that do not lie on an evenly spaced grid.
    """
    if not pair.first.any():
        raise InputError("all gains that the two files have in common are flagged in either")
    first = pair.first
    if redundant:
        both = zip(_without_turns(pair), pair.second, strict=True)
        first = np.stack([_without_gradients(*gains, pair.positions) for gains in both])
    solved = first.any(axis=(1, 2))
    aligned = np.zeros_like(first)
    aligned[solved] = aligned_gains(first[solved], pair.second[solved])
    difference, pair_aligned = aligned - pair.second, replace(pair, first=aligned)
    grid = _even_grid(pair.frequency)
    frequencies = np.linspace(pair.frequency[0], pair.frequency[-1], grid.n_channels)
    power = [
        np.mean(np.abs(delay_transform(grid.filled(values), frequencies, TAPER)) ** 2, axis=(0, 1))
        for values in (difference, pair.second)
    ]
    return GainDifference(
        pair=pair_aligned,
        as_given=float(_relative(pair.first - pair.second, pair.second, (0, 1, 2))),
        of_antenna=_relative(difference, pair.second, (0, 2)),
        of_channel=_relative(difference, pair.second, (0, 1)),
        delay=delays(grid.n_channels, channel_width(frequencies)),
        of_delay=np.sqrt(power[0] / power[1]),
        pulls=None if pair.errors is None else _pulls(pair_aligned, pair.errors),
    )


def _even_grid(frequency: np.ndarray) -> ChannelGrid:
    """Return the grid of evenly spaced channels that contain the given ones; raises InputError if none do.

    Files that lack channels have gaps, and so have the channels that two files have in common.
    """
    if frequency.size < 2:
        raise InputError("the two files have one channel in common; their comparison by delay needs two or more")
    width = np.diff(frequency).min()
    steps = (frequency - frequency[0]) / width
    place = np.rint(steps).astype(int)
    if np.abs(steps - place).max() > SAME_CHANNEL or place[-1] >= MOST_GRID * frequency.size:
        raise InputError(
            "the common channels of the two files do not lie on an evenly spaced grid; average or select them"
        )
    return ChannelGrid(float(width), int(place[-1]) + 1, place)


def _pulls(pair: GainPair, errors: np.ndarray) -> np.ndarray | None:
    """Return deviations of aligned gains over their errors, (2, Ntimes, Nants, Nfreqs), NaN where there are none.

    None if no gain has errors in both.
    """
    known = np.isfinite(errors).all(axis=0) & (pair.first != 0) & (pair.second != 0)
    if not known.any():
        return None
    found = np.full(errors.shape, np.nan)
    for at in np.flatnonzero(known.any(axis=(1, 2))):
        ratio = np.divide(pair.first[at], pair.second[at], out=np.ones(known[at].shape, complex), where=known[at])
        spans = determined_spans(pair.frequency, pair.smooth_delay, known[at])
        change = within(spans, np.log(ratio))
        power = np.where(known[at], np.abs(pair.second[at]) ** 2, 0)
        total = power.sum(axis=0)
        scale = np.sum(power * change.real) / total.sum()
        phase = np.sum(power * change.imag, axis=0) / np.where(total > 0, total, 1)
        deviation = np.stack([change.real - scale, change.imag - phase])
        found[:, at] = np.where(known[at], deviation / errors[:, at], np.nan)
    return found


def _relative(difference: np.ndarray, gains: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    above, below = (np.sum(np.abs(values) ** 2, axis=axes) for values in (difference, gains))
    return np.sqrt(np.divide(above, below, out=np.full(np.shape(above), np.nan), where=below > 0))


def _without_turns(pair: GainPair) -> np.ndarray:
    """Return the first gains without the phase gradient to the second, for any number of turns across the array.

    Gains g_a' = g_a exp(i q x_a) turn the products of antennas of one redundant group all by q d: the mean of those
    products gives q d for the shortest group, and for the shortest that is not parallel to it. On a lattice these are
    its steps, and whole turns per step make no difference. Elsewhere q must be less than half a turn per baseline.
    """
    first, second = np.triu_indices(len(pair.antennas), 1)
    if not first.size:
        return pair.first
    vectors = pair.positions[second] - pair.positions[first]
    groups = redundant_groups(np.column_stack([vectors, np.zeros(len(vectors))]), REDUNDANT)
    overlap = pair.first * pair.second.conj()
    products = overlap[:, second] * overlap[:, first].conj()
    products[:, groups.conjugated] = products[:, groups.conjugated].conj()
    vectors = np.where(groups.conjugated[:, None], -vectors, vectors)
    means = np.array([vectors[groups.index == number].mean(axis=0) for number in range(groups.index.max() + 1)])
    chosen = _spanning(means)
    turns = np.array([np.angle(products[:, groups.index == group].sum(axis=1)) for group in chosen])
    gradients = np.einsum("ij,jtf->tif", np.linalg.pinv(means[chosen]), turns)
    phases = np.einsum("ai,tif->taf", pair.positions - pair.positions.mean(axis=0), gradients)
    return pair.first * np.exp(-1j * phases)


def _spanning(vectors: np.ndarray) -> list[int]:
    """Return the indices of the shortest vector, and of the shortest that is not parallel to it if there is one."""
    lengths = np.array([np.linalg.norm(vector) for vector in vectors])
    order = np.argsort(lengths)
    east, north = vectors[order[0]] / lengths[order[0]]
    across = np.abs(east * vectors[:, 1] - north * vectors[:, 0]) > NOT_PARALLEL * lengths
    return [int(order[0]), *order[across[order]][:1].tolist()]


def _without_gradients(first: np.ndarray, second: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Match amplitude and phase gradient of each channel of the first gains, (Nants, Nfreqs), to the second."""
    design = np.column_stack([positions - positions.mean(axis=0), np.ones(len(positions))])
    turned = fix_phase(first, second)
    for _ in range(GRADIENT_STEPS):
        overlap = turned * second.conj()
        normal = np.einsum("ai,af,aj->fij", design, np.abs(overlap), design)
        slope = np.einsum("fij,aj,af->fi", np.linalg.pinv(normal, hermitian=True), design, overlap.imag)
        phase = design @ slope.T
        turned = turned * np.exp(-1j * phase)
        if np.abs(phase).max() < GRADIENT_TOLERANCE:
            break
    size = np.sum(np.abs(turned) ** 2, axis=0)
    amplitude = np.sum((turned.conj() * second).real, axis=0) / np.where(size > 0, size, 1)
    return turned * np.where(amplitude > 0, amplitude, 1)
