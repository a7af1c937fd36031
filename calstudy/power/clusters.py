r"""Errors of sums over baselines that have antennas in common.

A calibration changes a signal through its gains, and each gain acts on all baselines of its antenna. The scatter of
baselines, taken as independent, therefore understates the error of a sum over them. Errors here come from leaving out
antennas.

Redundant baselines see the same sky, so that they are one sample, whether they are crossed with each other or each with
itself (`calstudy.power.spectra.skies`).

Let d_s be the deviation that each sample s adds to a sum of mean zero, d_{sa} that of its pairs of baselines that
contain antenna a, d_a that of all pairs that do, and w_a the part of the modes that these have. Leaving out antenna a
moves the sum by d_a / (1 - w_a). Where deviations are

- due to the samples themselves, the variance of the sum is the sum of d_s^2 over the samples;
- due to the N antennas, it is that of the jackknife, (N - 1) / N times the sum of (d_a / (1 - w_a))^2.

The second counts again what pairs of one sample have in common that share an antenna. This is subtracted, so that

    var = n / (n - 1) sum_s d_s^2 + (N - 1) / N sum_a [d_a^2 - sum_s d_{sa}^2] / (1 - w_a)^2

for n samples: the sum of the products of the deviations of all pairs that are of one sample or have an antenna in
common. For samples of one baseline and many antennas this is the variance of dyadic data (Fafchamps & Gubert 2007, J.
Dev. Econ. 83, 326). The term of the antennas may be negative by chance, and is then taken as zero.

Two cases are conservative. Where gains are fitted to all baselines, the loss of all baselines together is fixed by the
number of unknowns, which does not appear in any scatter. And what differs between lengths of baselines in every sky
counts as scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calstudy.power.spectra import DelaySpectra, bins_of_k, skies, sum_in_bins

LARGEST_PART = 0.5
"""Upper limit of w_a: little of a bin is left without an antenna that has a larger part of its modes."""


@dataclass(frozen=True)
class Clusters:
    """Sums into which the modes of delay spectra fall: by bin, and within bins by sample and antenna.

    Attributes
    ----------
    mode, share_mode : sum to which each mode (Nu, Nd) and each antenna's share of a unit (Nm, Nd) belongs; -1 for none
    owner, weight : bin of each sum over a sample, and the modes in it, each once per pair of baselines, (Nsums,)
    share_sample, share_antenna, share_weight
        Sum over a sample, antenna, and weight of each sum over the share of an antenna in a sample, (Nshares,). The
        weight counts the pairs that contain the antenna. Empty if the antennas are not known.
    """

    n_bins: int
    mode: np.ndarray
    share_mode: np.ndarray
    owner: np.ndarray
    weight: np.ndarray
    share_sample: np.ndarray
    share_antenna: np.ndarray
    share_weight: np.ndarray

    @classmethod
    def of(cls, spectra: DelaySpectra, bins: np.ndarray, samples: np.ndarray, n_bins: int) -> Clusters:
        """Find the sums from the bin, -1 for none, and the sample of each mode, (Nu, Nd) int each."""
        mode, (owner, _) = _number(bins, samples)
        unit = spectra.share_unit
        antenna = np.broadcast_to(spectra.share_antenna[:, None], (unit.size, bins.shape[1]))
        share_mode, (share_sample, share_antenna) = _number(mode[unit], antenna)
        weight = sum_in_bins(spectra.n_pairs[:, None], mode, owner.size)
        share_weight = sum_in_bins(spectra.share_pairs[:, None], share_mode, share_sample.size)
        return cls(n_bins, mode, share_mode, owner, weight, share_sample, share_antenna, share_weight)

    @classmethod
    def of_baselines(cls, antennas: np.ndarray) -> Clusters:
        """Return the clusters of one number per baseline, all in one bin, from the antennas of each, (Nbls, 2)."""
        baselines = np.arange(len(antennas))
        return cls(
            n_bins=1,
            mode=baselines[:, None],
            share_mode=np.arange(antennas.size)[:, None],
            owner=np.zeros(baselines.size, int),
            weight=np.ones(baselines.size),
            share_sample=np.repeat(baselines, 2),
            share_antenna=antennas.ravel(),
            share_weight=np.ones(antennas.size),
        )

    @property
    def n_samples(self) -> np.ndarray:
        """Number of samples in each bin, (n_bins,) int."""
        return np.bincount(self.owner, minlength=self.n_bins)

    def sums(self, values: np.ndarray, shares: np.ndarray) -> Sums:
        """Add up a quantity of each mode, (Nu, Nd), summed over the pairs of its unit.

        `shares` are the parts of it by the pairs that contain an antenna, (Nm, Nd).
        """
        # Without shares, their power has no delays either.
        shares = np.reshape(shares, self.share_mode.shape)
        samples = sum_in_bins(values, self.mode, self.owner.size)
        return Sums(self, samples, sum_in_bins(shares, self.share_mode, self.share_sample.size))

    def powers(self, spectra: DelaySpectra) -> Sums:
        """Add up the real parts of powers, each pair of baselines counting the same."""
        return self.sums(spectra.n_pairs[:, None] * spectra.power.real, spectra.share_power.real)

    @property
    def counts(self) -> Sums:
        """Numbers of modes, each counted once per pair of baselines."""
        return Sums(self, self.weight, self.share_weight)


@dataclass(frozen=True)
class Sums:
    """Sums over the samples of each bin, (Nsums,), and over the antennas' shares in them, (Nshares,)."""

    clusters: Clusters
    samples: np.ndarray
    shares: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Sum over the samples of each bin, (n_bins,); NaN for empty bins."""
        total = np.bincount(self.clusters.owner, self.samples, self.clusters.n_bins)
        return np.where(self.clusters.n_samples > 0, total, np.nan)

    def __sub__(self, other: Sums) -> Sums:
        return Sums(self.clusters, self.samples - other.samples, self.shares - other.shares)

    def ratio(self, reference: Sums) -> tuple[np.ndarray, np.ndarray]:
        """Return the ratio of the totals in each bin, and its standard deviation, (n_bins,) each.

        To first order (Cochran 1977, section 6.3): the deviation of a sample is x - (sum x / sum y) y, over sum y.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            value, total = self.total / reference.total, reference.total
        return value, linear_error(((1 / total, self), (-value / total, reference)))


def linear_error(terms: tuple[tuple[np.ndarray, Sums], ...]) -> np.ndarray:
    """Return the standard deviation of a linear combination of totals whose deviations add up to zero in each bin.

    `terms` are factors, (n_bins,), and the sums that they multiply. The error, (n_bins,), is NaN in bins of one sample.
    """
    clusters = terms[0][1].clusters
    share_owner = clusters.owner[clusters.share_sample]
    with np.errstate(invalid="ignore"):
        samples = sum(factor[clusters.owner] * sums.samples for factor, sums in terms)
        shares = sum(factor[share_owner] * sums.shares for factor, sums in terms)
    count = clusters.n_samples
    scale = np.divide(count, count - 1, out=np.full(count.size, np.nan), where=count > 1)
    variance = scale * np.bincount(clusters.owner, samples**2, count.size)
    # The antennas in each bin.
    owner, _, antenna = _combinations(share_owner, clusters.share_antenna)
    part = np.bincount(antenna, clusters.share_weight) / np.bincount(clusters.owner, clusters.weight)[owner]
    left = 1 - np.minimum(part, LARGEST_PART)
    moved = (np.bincount(antenna, shares) ** 2 - np.bincount(antenna, shares**2)) / left**2
    antennas = np.maximum(np.bincount(owner, minlength=count.size), 1)
    by_antennas = (antennas - 1) / antennas * np.bincount(owner, moved, count.size)
    return np.sqrt(variance + np.maximum(by_antennas, 0.0))


def _number(groups: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the number of each mode's combination of group and label, -1 without a group, and the combinations."""
    number = np.full(groups.shape, -1)
    used = groups >= 0
    group, found, number[used] = _combinations(groups[used], label[used])
    return number, (group, found)


def _combinations(group: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return group and label, none negative, of each combination, and the number of the combination of each entry."""
    count = int(label.max(initial=0)) + 1
    found, index = np.unique(group * count + label, return_inverse=True)
    return found // count, found % count, index


def clusters_in_k(spectra: DelaySpectra, edges: np.ndarray, buffer: float, inside: bool) -> Clusters:
    """Return the clusters of the modes in bins of |k|, outside or inside the wedge; units of one sky are a sample.

    `edges` are as in `calstudy.power.spectra.bins_of_k`. Modes with |tau| <= |b|/c + `buffer` (s) are inside the wedge.
    """
    bins = bins_of_k(spectra, edges, buffer, inside)
    samples = np.broadcast_to(skies(spectra)[0][:, None], bins.shape)
    return Clusters.of(spectra, bins, samples, edges.size - 1)
