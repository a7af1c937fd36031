r"""The noise of measured data: from the difference of two halves, and from the autocorrelations.

With E and O the averages of the halves, of n_e and n_o integrations and phased to the same point of the sky, the sky
cancels in E - O, whose variance is sigma^2 (1/n_e + 1/n_o) for noise of variance sigma^2. The cross power of E and O
has noise of the geometric mean of the variances of E and O, sigma^2 / sqrt(n_e n_o). Hence the noise of even x odd
follows from the power P_N of

    sqrt(sqrt(n_e n_o) / (n_e + n_o)) (E - O):

the real part of one product has the variance P_N^2 / 2.

The autocorrelations give the same by the radiometer equation, sigma^2 = V_aa V_bb / (channel width x time), over
|g_a g_b|^2 for calibrated data. The mean of the delay power of visibilities of known moduli does not depend on their
phases (Parseval), so that it is that of real visibilities sigma(nu).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from calstudy.base.constants import SAME_LENGTH
from calstudy.base.visibilities import antenna_pairs, flag_cube, rows_of, to_cube
from calstudy.instrument.layouts import redundant_groups
from calstudy.power.spectra import DelaySpectra, outside_wedge

if TYPE_CHECKING:
    from pyuvdata import UVData

# Median over mean of the square of a complex normal variable.
MEDIAN_OVER_MEAN = np.log(2)
ABOVE_NOISE = 2.0
"""Antennas with a baseline of more than so many times the median power of noise correlate with another."""
PARALLEL = (-1, -2, -5, -6)
"""Numbers of the polarizations RR, LL, XX and YY."""
FAINT = 1e-3
"""Without autocorrelations baselines with a smaller fraction of the array's median power are noise."""
TYPICAL_PARTNERS = 4
"""Where the median antenna correlates with so many others, one with a single other has cross-talk, and sees no sky."""


def radiometer_variance(data: UVData, pairs: np.ndarray, polarization: int) -> np.ndarray | None:
    """Return sigma^2 of samples of some baselines by the radiometer equation, (Ntimes, len(pairs), Nfreqs).

    `pairs` are antenna numbers, (Nbls, 2), and `polarization` is an index. The result is NaN where it is not known, and
    None without the autocorrelations of all antennas.
    """
    all_pairs = antenna_pairs(data)
    autos = {int(a): row for row, (a, b) in enumerate(all_pairs) if a == b}
    if not set(np.unique(pairs).tolist()) <= set(autos):
        return None
    flags, cube = flag_cube(data)[..., polarization], to_cube(data)[..., polarization]
    power = np.where(flags, np.nan, cube.real)
    rows = rows_of(data, pairs)
    first, second = ([autos[int(number)] for number in column] for column in pairs.T)
    counts = data.nsample_array[..., polarization].reshape(cube.shape)[:, rows]
    samples = np.abs(np.mean(data.channel_width)) * np.mean(data.integration_time) * counts
    product = power[:, first] * power[:, second]
    valid = (product > 0) & (samples > 0)
    return np.where(valid, product / np.where(valid, samples, 1), np.nan)


def sample_noise(data: UVData) -> float | None:
    """Return sigma of cross-correlations with nsamples of 1, by the radiometer equation, in the unit of the data.

    Its inverse square is the mean of the inverse variances of all unflagged samples and polarizations, so that weights
    of that mean have the right level; the rms, which loud antennas decide, is larger. None without the autocorrelations
    of all antennas, or if none of their samples can be used.
    """
    all_pairs, all_flags = antenna_pairs(data), flag_cube(data)
    crosses = all_pairs[:, 0] != all_pairs[:, 1]
    flags, counts = all_flags[:, crosses], data.nsample_array.reshape(all_flags.shape)[:, crosses]
    found = []
    for polarization in range(data.Npols):
        variance = radiometer_variance(data, all_pairs[crosses], polarization)
        if variance is None:
            return None
        single = (variance * counts[..., polarization])[~flags[..., polarization]]
        found.append(single[np.isfinite(single)])
    values = np.concatenate(found)
    return float(np.mean(1 / values) ** -0.5) if values.size else None


def uncorrelated(data: UVData) -> list[int]:
    """Return the numbers of antennas that see no sky: their cross-correlations are zero, flagged, noise or cross-talk.

    Of noise alone is a baseline whose median of |V|^2 / sigma^2, by the radiometer equation, is less than `ABOVE_NOISE`
    times that of noise; without autocorrelations, whose median of |V|^2 is less than `FAINT` of that of all baselines.
    None are named if they were half of all: then the data are no measure of them.
    """
    pairs = antenna_pairs(data)
    crosses = np.not_equal(*pairs.T)
    pairs, values = pairs[crosses], np.abs(np.where(flag_cube(data), 0, to_cube(data))[:, crosses]) ** 2
    seen = np.asarray(np.any(values > 0, axis=(0, 2)))
    # Cross-hands have little of the sky, of which antennas are known that see none.
    parallel = np.isin(data.polarization_array, PARALLEL)
    seen &= parallel | ~parallel.any()
    for polarization in range(data.Npols):
        variance = radiometer_variance(data, pairs, polarization)
        known = np.ma.masked_less_equal(np.nan_to_num(values[..., polarization]), 0)
        if variance is None:
            medians, least = np.ma.median(known, axis=(0, 2)), FAINT * np.ma.median(known)
        else:
            medians = np.ma.median(known / np.ma.masked_invalid(variance), axis=(0, 2))
            least = ABOVE_NOISE * MEDIAN_OVER_MEAN
        seen[:, polarization] &= medians.filled(np.inf) > least
    numbers = np.unique(pairs)
    counts = np.bincount(np.searchsorted(numbers, pairs[seen.any(axis=1)]).ravel(), minlength=numbers.size)
    lost = numbers[counts <= (1 if np.median(counts) >= TYPICAL_PARTNERS else 0)]
    return lost.tolist() if 2 * lost.size < numbers.size else []


def half_difference(even: UVData, odd: UVData) -> UVData:
    """Return the difference of two averages, with the power P_N of the noise of their product.

    Both have one integration of the same baselines, phased to the same point. Samples flagged in either are flagged.
    """
    found = even.copy()
    n_even, n_odd = (_weights(uvd) for uvd in (even, odd))
    found.flag_array = even.flag_array | odd.flag_array | (n_even <= 0) | (n_odd <= 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.sqrt(np.sqrt(n_even * n_odd) / (n_even + n_odd))
    found.data_array = np.where(found.flag_array, 0, factor * (even.data_array - odd.data_array))
    return found


def _weights(uvd: UVData) -> np.ndarray:
    """Return the time of measurement of each sample, s times nsamples."""
    return uvd.nsample_array * np.asarray(uvd.integration_time)[:, None, None]


def noise_of_average(variance: np.ndarray, uvd: UVData, times: np.ndarray) -> np.ndarray:
    """Return sigma of the average over some integrations, (Nbls, Nfreqs, Npols); NaN where no variance is known.

    `variance` is sigma^2 of each sample, (Ntimes, Nbls, Nfreqs, Npols), NaN where it is not known: there that of a
    single measurement is taken to be the mean over the measurements in known samples. The numbers of samples in `uvd`
    are the weights, of unflagged samples only. `times` are indices of integrations, (n,).
    """
    weights = np.where(flag_cube(uvd), 0, uvd.nsample_array.reshape(variance.shape))[times]
    variance = variance[times]
    known = np.where(np.isfinite(variance), weights, 0)
    squares = np.sum(np.where(known > 0, known**2 * variance, 0), axis=0)
    # Sums of w^2 sigma^2 grow as the number w of measurements: those of unknown noise enlarge them by as much.
    counts = known.sum(axis=0) * weights.sum(axis=0)
    return np.sqrt(squares / np.where(counts > 0, counts, np.nan))


def noise_of_baselines(noise: DelaySpectra, buffer: float, everywhere: bool) -> np.ndarray:
    """Return P_N of each baseline, the mean over delays, (Nu,); NaN for a baseline without delays beyond the buffer.

    `noise` is the power of `half_difference`, or of the real noise from autocorrelations, of each baseline with itself.
    Unless `everywhere`, delays within |b|/c + `buffer` (s) are left out: there the sky changes between halves.
    """
    used = np.ones(noise.power.shape, bool) if everywhere else outside_wedge(noise, buffer)
    count = used.sum(axis=1)
    total = np.sum(noise.power.real, axis=1, where=used)
    return np.divide(total, count, out=np.full(count.size, np.nan), where=count > 0)


def noise_of_units(spectra: DelaySpectra, noise: DelaySpectra, levels: np.ndarray, tolerance: float) -> np.ndarray:
    """Return P_N of each unit of spectra (baseline or redundant group), (Nu,): the mean over its baselines.

    `noise` gives the baselines, and `levels` P_N of each. NaN is left out; units without levels have the mean of all.
    Baselines are identified by their antennas, and those of groups, or of spectra without shares, by their vectors, to
    a tolerance in m: baselines without a partner are in no group.
    """
    known = np.isfinite(levels)
    mean = np.mean(levels[known]) if known.any() else np.nan
    units = spectra.antennas_of_units()
    if all(len(antennas) == 2 for antennas in units):
        level = dict(zip(noise.antennas_of_units(), np.where(known, levels, mean).tolist(), strict=True))
        return np.array([level.get(antennas, mean) for antennas in units])
    both = np.concatenate([spectra.vectors, -spectra.vectors])
    # Units of the same vector, which only spectra without shares have, cannot be told apart: they have one level.
    group = redundant_groups(spectra.vectors, SAME_LENGTH).index
    distance, nearest = cKDTree(both).query(noise.vectors[known])
    place, near = group[nearest % len(group)], distance <= tolerance
    count = np.bincount(place[near], minlength=len(group))
    total = np.bincount(place[near], levels[known][near], len(group))
    return np.divide(total, count, out=np.full(count.size, mean), where=count > 0)[group]
