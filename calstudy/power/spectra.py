"""Power spectra as plain arrays: per baseline and delay, and their cylindrical and spherical averages.

A *unit* is one sample of the sky: a baseline crossed with itself, or a redundant group whose baselines are crossed with
each other. The pairs of a unit share the signal; their noise products are independent.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SAME_LENGTH, SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.visibilities import positions
from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
from calstudy.power.delay import horizon_delay, mode_correlation
from calstudy.power.settings import PowerSettings

if TYPE_CHECKING:
    from hera_pspec import UVPSpec

logger = logging.getLogger(__name__)

NEGLIGIBLE = 1e-3
"""Correlations of powers below this are taken as zero."""
SAME_SKY = 0.9
"""Units whose powers correlate by more see the same sky."""


@dataclass(frozen=True)
class DelaySpectra:
    """Delay power spectra of Nu units at Nd delays, averaged over the pairs and polarizations of each unit.

    Attributes
    ----------
    power : even times odd, (Nu, Nd) complex, mK^2 h^-3 Mpc^3; its real part estimates P(k)
    vectors : east, north, up in m, (Nu, 3): mean of the unit's baselines
    n_pairs : baseline pairs in each unit, (Nu,)
    n_polarizations : polarizations averaged
    delay : s, ascending, (Nd,)
    k_perp, k_parallel : h/Mpc, (Nu,) and (Nd,), at the band centre
    frequency : band centre in Hz
    omega_pp : integral of the squared power beam in sr, mean over band and polarizations
    taper : name of the taper, see `calstudy.power.delay.TAPERS`
    share_unit, share_antenna, share_pairs, share_power
        The share of each antenna in each unit: unit and number of the antenna, (Nm,) int; number of the unit's pairs
        that contain the antenna, (Nm,) int; and the sum of the powers of these pairs, (Nm, Nd) complex. Errors by
        leaving out antennas need these (`calstudy.power.clusters`). Empty if not known: the errors of ratios then come
        from the scatter of units, which is too small where units share antennas.
    n_times, independent_times
        Number of times whose powers are averaged, each with its own noise, and number of independent skies that they
        see, at most as many (`calstudy.power.binned.independent_times`).
    flagged_correlation : as `between_delays` where channels are flagged, mean over pairs; empty if none is
    """

    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    vectors: np.ndarray = field(metadata={"unit": "m"})
    n_pairs: np.ndarray = field(metadata={"unit": ""})
    n_polarizations: int = field(metadata={"unit": ""})
    delay: np.ndarray = field(metadata={"unit": "s"})
    k_perp: np.ndarray = field(metadata={"unit": "h/Mpc"})
    k_parallel: np.ndarray = field(metadata={"unit": "h/Mpc"})
    frequency: float = field(metadata={"unit": "Hz"})
    omega_pp: float = field(metadata={"unit": "sr"})
    taper: str = field(metadata={"unit": ""})
    share_unit: np.ndarray = field(default_factory=lambda: np.zeros(0, int), metadata={"unit": ""})
    share_antenna: np.ndarray = field(default_factory=lambda: np.zeros(0, int), metadata={"unit": ""})
    share_pairs: np.ndarray = field(default_factory=lambda: np.zeros(0, int), metadata={"unit": ""})
    share_power: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 0), complex), metadata={"unit": "mK2 h-3 Mpc3"}
    )
    n_times: int = field(default=1, metadata={"unit": ""})
    independent_times: float = field(default=1.0, metadata={"unit": ""})
    flagged_correlation: np.ndarray = field(default_factory=lambda: np.zeros(0), metadata={"unit": ""})

    @property
    def between_delays(self) -> np.ndarray:
        """Correlations of the powers of delays that are 0, 1, ... Nd // 2 bins apart, (Nd // 2 + 1,)."""
        found = self.flagged_correlation
        return found if found.size else mode_correlation(self.taper, self.delay.size)

    @property
    def length(self) -> np.ndarray:
        """Baseline lengths in m, (Nu,)."""
        return np.linalg.norm(self.vectors, axis=1)

    @property
    def n_baselines(self) -> np.ndarray:
        """Number of baselines of each unit, (Nu,): one that is crossed with itself, or n with n (n - 1) pairs."""
        return np.where(self.n_pairs == 1, 1.0, (1 + np.sqrt(1 + 4 * self.n_pairs)) / 2)

    def antennas_of_units(self) -> list[tuple[int, ...]]:
        """Return the antennas of each unit, ascending: two for one baseline; none where shares are not known."""
        return [tuple(sorted(found)) for found in self._shares_of_units()]

    def pairs_of_units(self) -> list[tuple[object, ...]]:
        """Return a key of each unit: its vector to a mm, and the number of its pairs that contain each antenna."""
        places = np.rint(1e3 * self.vectors).astype(int).tolist()
        return [(*place, *sorted(found.items())) for place, found in zip(places, self._shares_of_units(), strict=True)]

    def _shares_of_units(self) -> list[dict[int, int]]:
        """Return the number of pairs of each unit that contain an antenna, by its number."""
        members: list[dict[int, int]] = [{} for _ in self.n_pairs]
        for unit, antenna, count in zip(self.share_unit, self.share_antenna, self.share_pairs, strict=True):
            members[unit][int(antenna)] = int(count)
        return members

    def of_units(self, units: np.ndarray) -> DelaySpectra:
        """Return the spectra of some units, by their numbers, in this order; a number may come several times."""
        order = np.argsort(self.share_unit, kind="stable")
        first, last = (np.searchsorted(self.share_unit[order], units, side=side) for side in ("left", "right"))
        shares = np.concatenate([order[:0], *(order[start:end] for start, end in zip(first, last, strict=True))])
        return replace(
            self,
            power=self.power[units],
            vectors=self.vectors[units],
            n_pairs=self.n_pairs[units],
            k_perp=self.k_perp[units],
            share_unit=np.repeat(np.arange(units.size), last - first),
            share_antenna=self.share_antenna[shares],
            share_pairs=self.share_pairs[shares],
            share_power=self.share_power[shares],
        )

    def with_pairs_of(self, other: DelaySpectra) -> DelaySpectra:
        """Return these spectra with the numbers of pairs of `other`, whose units have the same antennas or fewer.

        Powers of units, and mean powers of the pairs of an antenna, stay: the pairs of a unit see the same sky.
        """
        place = {pair: share for share, pair in enumerate(zip(self.share_unit, self.share_antenna, strict=True))}
        shares = np.array([place[pair] for pair in zip(other.share_unit, other.share_antenna, strict=True)], dtype=int)
        part = other.share_pairs / self.share_pairs[shares]
        return replace(
            self,
            n_pairs=other.n_pairs,
            share_unit=other.share_unit,
            share_antenna=other.share_antenna,
            share_pairs=other.share_pairs,
            share_power=part[:, None] * self.share_power[shares],
        )


def _reach(spectra: DelaySpectra, correlation: float) -> float:
    """Return the difference of two baselines, in m, at which the correlation of their powers falls to this."""
    rate = 2 * np.pi * spectra.omega_pp * (spectra.frequency / SPEED_OF_LIGHT) ** 2
    return float(np.sqrt(-np.log(correlation) / rate))


def signal_correlation(spectra: DelaySpectra) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of units that share signal, in both orders and with themselves, and correlations of powers."""
    from scipy.spatial import cKDTree

    reach = _reach(spectra, NEGLIGIBLE)
    tree = cKDTree(spectra.vectors)
    units = np.arange(len(spectra.vectors))
    # V(-b) is the conjugate of V(b), its powers those at -tau: the same |k|.
    close = [tree.query_pairs(reach, output_type="ndarray")]
    opposite = tree.query_ball_point(-spectra.vectors, reach)
    close.append(np.array([(i, j) for i, found in enumerate(opposite) for j in found if i < j]).reshape(-1, 2))
    pairs = np.unique(np.concatenate(close).astype(int), axis=0)
    first, second = pairs.T
    distance = np.minimum(
        np.linalg.norm(spectra.vectors[first] - spectra.vectors[second], axis=1),
        np.linalg.norm(spectra.vectors[first] + spectra.vectors[second], axis=1),
    )
    correlation = NEGLIGIBLE ** ((distance / reach) ** 2)
    return (
        np.concatenate([units, first, second]),
        np.concatenate([units, second, first]),
        np.concatenate([np.ones(units.size), correlation, correlation]),
    )


def skies(spectra: DelaySpectra) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the sky that each unit sees, (Nu,) int, and whether at the opposite sign of the delay, bool.

    Redundant baselines that are not crossed with each other, and all whose powers correlate by more than `SAME_SKY`,
    directly or through others, see the same sky.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(spectra.vectors)
    first, second, correlation = signal_correlation(spectra)
    same = correlation > SAME_SKY
    _, number = connected_components(coo_array((correlation[same], (first[same], second[same])), (count, count)))
    _, start = np.unique(number, return_index=True)
    reference = spectra.vectors[start[number]]
    return number, np.sum(reference * spectra.vectors, axis=1) < 0


@dataclass(frozen=True)
class BaselineModes:
    """The modes of baselines, with `length` (m) and `k_perp` (h/Mpc), (Nbls,).

    `delay` (s) and `k_parallel` (h/Mpc) are ascending, (Ndelays,).
    """

    length: np.ndarray
    k_perp: np.ndarray
    delay: np.ndarray
    k_parallel: np.ndarray


def modes_of(delay: np.ndarray, lengths: np.ndarray, centre: float, power: PowerSettings) -> BaselineModes:
    """Return the modes of baselines (lengths in m) at delays (s), for the centre of the band (Hz)."""
    cosmology = make_cosmology(power.cosmology)
    return BaselineModes(
        length=lengths,
        k_perp=k_perpendicular(cosmology, lengths, centre),
        delay=delay,
        k_parallel=k_parallel(cosmology, delay, centre),
    )


@dataclass(frozen=True)
class Cylinder:
    """Nb bins of baseline length and Nd delays from zero up, both signs of the delay together.

    Attributes
    ----------
    baseline_length, k_perp : mean of each bin, (Nb,) ascending, m and h/Mpc. Bins without baselines do not appear.
    bin_edges : lower and upper edge of each bin, (Nb, 2), m
    delay, k_parallel : (Nd,) ascending, s and h/Mpc
    horizon_delay : |b|/c, the edge of the wedge, (Nb,), s
    """

    baseline_length: np.ndarray = field(metadata={"unit": "m"})
    bin_edges: np.ndarray = field(metadata={"unit": "m"})
    k_perp: np.ndarray = field(metadata={"unit": "h/Mpc"})
    delay: np.ndarray = field(metadata={"unit": "s"})
    k_parallel: np.ndarray = field(metadata={"unit": "h/Mpc"})
    horizon_delay: np.ndarray = field(metadata={"unit": "s"})


@dataclass(frozen=True)
class CylindricalSpectrum(Cylinder):
    """A power spectrum in bins of baseline length and delay.

    Attributes
    ----------
    power : mean over the pairs of baselines in each bin, (Nb, Nd) complex; the real part estimates P(k)
    n_pairs : pairs of baselines averaged, (Nb,) int
    """

    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    n_pairs: np.ndarray = field(metadata={"unit": ""})


@dataclass(frozen=True)
class SphericalSpectrum:
    """A power spectrum in Nk bins of |k|. Empty bins hold NaN power and zero modes.

    Attributes
    ----------
    k, bin_edges
        Bin centres (Nk,) and edges (Nk + 1,), h/Mpc. A bin holds modes above its lower and not above its upper edge.
    power : mean over modes, (Nk,) complex; the real part estimates P(k)
    n_modes : modes (baseline or redundant group, and delay) averaged, (Nk,) int
    noise_modes, sample_modes, cross_modes
        Independent modes of noise, of signal, and of the product of both among them, (Nk,); see
        `calstudy.power.binned`.
    noise_error, sample_error
        Standard deviations by noise and by sample variance, (Nk,); NaN until `calstudy.power.binned.with_errors`.
    wedge_excluded : true if modes inside the wedge were left out
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    n_modes: np.ndarray = field(metadata={"unit": ""})
    noise_modes: np.ndarray = field(metadata={"unit": ""})
    sample_modes: np.ndarray = field(metadata={"unit": ""})
    cross_modes: np.ndarray = field(metadata={"unit": ""})
    noise_error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    sample_error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    wedge_excluded: bool = field(metadata={"unit": ""})

    @property
    def error(self) -> np.ndarray:
        """sigma_P = sigma_N + sigma_S, one standard deviation, (Nk,)."""
        return self.noise_error + self.sample_error

    @property
    def difference_error(self) -> np.ndarray:
        """Standard deviation of P - P_S, (Nk,), where the EoR that P contains is the one whose power is P_S.

        Both contain the sample variance of a mode (`calstudy.power.binned`). Noise and its product with signal remain.
        """
        noise, sample = self.noise_error, self.sample_error
        modes = np.sqrt(2 * self.noise_modes * self.sample_modes)
        both = np.divide(modes, self.cross_modes, out=np.zeros(self.k.size), where=self.cross_modes > 0)
        return np.sqrt(noise**2 + both * noise * sample)


def outside_wedge(modes: DelaySpectra | BaselineModes, buffer: float) -> np.ndarray:
    """Return which modes lie outside the wedge: |tau| > |b|/c + `buffer` (s), shape (Nu, Nd) bool."""
    horizon = horizon_delay(modes.length)
    return np.abs(modes.delay) > horizon[:, None] + buffer


def bins_of_k(
    modes: DelaySpectra | BaselineModes, edges: np.ndarray, buffer: float | None = None, inside: bool = False
) -> np.ndarray:
    """Return the bin of |k| of each mode, (Nu, Nd) int, -1 for those in none.

    `edges` are ascending, h/Mpc; a bin holds modes above its lower and not above its upper edge. With a buffer, s, bins
    hold only modes outside the wedge (`outside_wedge`), or only those `inside`.
    """
    bins = np.searchsorted(edges, np.hypot(modes.k_perp[:, None], modes.k_parallel), side="left") - 1
    bins[bins >= edges.size - 1] = -1
    if buffer is not None:
        bins[outside_wedge(modes, buffer) == inside] = -1
    return bins


def sum_in_bins(values: np.ndarray, bins: np.ndarray, n_bins: int) -> np.ndarray:
    """Return the sum of real values in each bin, (n_bins,); `bins` are int, -1 for none, and values broadcast to it."""
    used = bins >= 0
    return np.bincount(bins[used], np.broadcast_to(values, bins.shape)[used], n_bins)


def length_bins(lengths: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (N, 2) of the bins that have baselines, and the bin of each; lengths and the width are in m.

    A length that is the edge of two bins but for rounding is in the upper one, so that equal lengths share a bin.
    """
    found, index = np.unique(np.floor((lengths + SAME_LENGTH) / width).astype(int), return_inverse=True)
    return np.column_stack([found, found + 1]) * width, index


def of_common_units(spectra: Mapping[str, DelaySpectra]) -> dict[str, DelaySpectra]:
    """Return the spectra of the units that all have in common, with the same numbers of pairs of baselines.

    Baselines that are completely flagged have no spectra. Those of an antenna without gains are missing in the spectra
    of the residual, but not in those of the EoR. A redundant group that lacks some of its baselines in one of the
    spectra is the same sample of the sky, and counts as many pairs in all; parts of a group, which flags split, count
    each. Groups of the spectra with the fewest pairs are left out where another lacks one of their baselines.

    The spectra, by name, have the same delays and their units in the same order. A warning says if they are averages
    of different times or polarizations. Raise InputError if they have no unit in common or units that cannot be told
    apart.
    """
    averaged = {name: (one.n_times, one.n_polarizations) for name, one in spectra.items()}
    if len(set(averaged.values())) > 1:
        counts = ", ".join(f"{name} {times} and {hands}" for name, (times, hands) in averaged.items())
        logger.warning(
            "spectra are averages of different numbers of times and polarizations (%s), because some were not "
            "calibrated: the sample variance of the others is in their ratio, and not in its error",
            counts,
        )
    first, *others = keys = [one.pairs_of_units() for one in spectra.values()]
    if all(other == first for other in others):
        return dict(spectra)
    if any(len(set(found)) < len(found) for found in keys):
        raise InputError(
            f"the spectra of {', '.join(spectra)} are not of the same baselines, and which they have in common cannot "
            "be told: baselines of the same vector need the shares of their antennas (share_unit, share_antenna, "
            "share_pairs and share_power), which the estimator does not give"
        )
    fewest = min(spectra.values(), key=lambda one: one.n_pairs.sum())
    matches = {name: _counterparts(fewest, one) for name, one in spectra.items()}
    common = np.logical_and.reduce([found >= 0 for found in matches.values()])
    if not common.any():
        raise InputError("no baseline has data in all of " + ", ".join(spectra))
    left_out = max(len(key) - np.unique(matches[name][common]).size for name, key in zip(matches, keys, strict=True))
    if left_out:
        logger.warning("%d of %d baselines or redundant groups are left out: flagged", left_out, max(map(len, keys)))
    kept = fewest.of_units(np.flatnonzero(common))
    return {name: one.of_units(matches[name][common]).with_pairs_of(kept) for name, one in spectra.items()}


def _counterparts(spectra: DelaySpectra, other: DelaySpectra) -> np.ndarray:
    """Return the unit of `other` with the pairs of each unit, (Nu,): a baseline, or a group with at least its pairs.

    Groups that lack baselines have other mean vectors, whose powers must correlate by `SAME_SKY`. -1 if there is none.
    """
    from scipy.spatial import cKDTree

    place = {key: unit for unit, key in enumerate(other.pairs_of_units())}
    found = np.array([place.get(key, -1) for key in spectra.pairs_of_units()])
    shares, of_other = spectra._shares_of_units(), other._shares_of_units()
    tree = cKDTree(other.vectors)
    for unit in np.flatnonzero((found < 0) & (spectra.n_pairs > 1)):
        near = np.array(tree.query_ball_point(spectra.vectors[unit], _reach(spectra, SAME_SKY)), dtype=int)
        distance = np.linalg.norm(other.vectors[near] - spectra.vectors[unit], axis=1)
        for candidate in near[np.argsort(distance)].tolist():
            if all(of_other[candidate].get(antenna, 0) >= count for antenna, count in shares[unit].items()):
                found[unit] = candidate
                break
    return found


def average_times(spectra: Sequence[DelaySpectra], independent: float) -> DelaySpectra:
    """Average the spectra of several times, which see `independent` skies; raise ValueError if the units differ."""
    first = spectra[0]
    flagged = any(one.flagged_correlation.size for one in spectra)
    if any(not np.array_equal(other.vectors, first.vectors) for other in spectra):
        raise ValueError("the spectra of several times are of different units, expected the same")
    return replace(
        first,
        power=np.mean([one.power for one in spectra], axis=0),
        share_power=np.mean([one.share_power for one in spectra], axis=0),
        n_times=len(spectra),
        independent_times=independent,
        flagged_correlation=np.mean([one.between_delays for one in spectra], axis=0) if flagged else np.zeros(0),
    )


def delay_spectra(uvp: UVPSpec, settings: PowerSettings) -> DelaySpectra:
    """Gather the pairs of a `UVPSpec` of `calstudy.power.estimate.estimate_power` into units.

    `settings` are those with which it was made. Raise ValueError if it has several spectral windows or times.
    """
    if uvp.Nspws != 1 or uvp.Nbltpairs != uvp.Nblpairs:
        raise ValueError(f"the spectra have {uvp.Nspws} spectral windows and {uvp.Ntpairs} times, expected 1 and 1")
    pairs = np.column_stack(np.divmod(uvp.blpair_array, 10**6))
    unit, vectors = _units(uvp, pairs)
    power = np.zeros((len(vectors), uvp.Ndlys), dtype=complex)
    np.add.at(power, unit, uvp.data_array[0].mean(axis=2))
    n_pairs = np.bincount(unit)
    frequency = float(uvp.freq_array.mean())
    modes = modes_of(uvp.dly_array, np.linalg.norm(vectors, axis=1), frequency, settings)
    # hera_pspec has flags of even and odd data along the third axis, and polarizations along the last.
    weights = np.moveaxis(uvp.wgt_array[0], -1, 1)
    correlation = np.zeros(0) if weights.all() else mode_correlation(settings.taper, weights.shape[-2], weights)
    return DelaySpectra(
        power=power / n_pairs[:, None],
        vectors=vectors,
        n_pairs=n_pairs,
        n_polarizations=uvp.Npols,
        delay=uvp.dly_array.copy(),
        k_perp=modes.k_perp,
        k_parallel=modes.k_parallel,
        frequency=frequency,
        omega_pp=float(uvp.OmegaPP.mean()),
        taper=settings.taper,
        flagged_correlation=correlation,
        **_antenna_shares(uvp, pairs, unit),
    )


def _antenna_shares(uvp: UVPSpec, pairs: np.ndarray, unit: np.ndarray) -> dict[str, Any]:
    """Return unit, antenna, number of pairs and summed power (mean over polarizations) of `DelaySpectra`'s shares."""
    numbers = {int(code): uvp.bl_to_antnums(int(code)) for code in np.unique(pairs)}
    antennas = np.array([[*numbers[first], *numbers[second]] for first, second in pairs.tolist()])
    # A pair counts once for an antenna that both of its baselines have.
    pair, column = np.nonzero(
        [[antenna not in row[:place] for place, antenna in enumerate(row)] for row in antennas.tolist()]
    )
    (owner, antenna), share = np.unique(np.stack([unit[pair], antennas[pair, column]]), axis=1, return_inverse=True)
    power = np.zeros((owner.size, uvp.Ndlys), dtype=complex)
    np.add.at(power, share, uvp.data_array[0].mean(axis=2)[pair])
    counts = np.bincount(share)
    return {"share_unit": owner, "share_antenna": antenna, "share_pairs": counts, "share_power": power}


def _units(uvp: UVPSpec, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit of each pair and the mean vector of each unit: units are baselines connected by `pairs`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    baselines, places = np.unique(pairs, return_inverse=True)
    first, second = places.reshape(pairs.shape).T
    graph = coo_array((np.ones(first.size), (first, second)), shape=(baselines.size, baselines.size))
    _, label = connected_components(graph, directed=False)
    rows = positions(uvp.bl_array, baselines)
    # hera_pspec stores x_a - x_b.
    vectors = -uvp.get_ENU_bl_vecs()[rows]
    mean = np.stack([np.bincount(label, vectors[:, axis]) for axis in range(3)], axis=1) / np.bincount(label)[:, None]
    return label[first], mean
