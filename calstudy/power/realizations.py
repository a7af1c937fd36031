r"""Pooling of realizations: quantities, their means and scatter (`calstudy.power.realizations`), and coverage.

A study draws its parts (EoR, gains, noise) again in blocks. Each of B blocks draws its own parts K_b times and leaves
the others as they are in the first realization, x_0, which is in every block. A measured quantity is

    x = mu + sum_S f_S,

where S runs over the sets of blocks and f_S, with variance V_S, depends on the draws of all blocks in S together: the
terms of a random-effects model. An S of one block is a main effect. An S of several is an interaction, such as the
product of noise and EoR in P^R: it changes as soon as one of its factors is drawn again. The only assumption is that
the draws are independent.

**One block.** mu and V are the mean and the variance of K realizations; nothing else is assumed.

**Mean of several blocks.** With m_b the mean of the K_b - 1 other realizations of block b,

    mu = x_0 + sum_b a (m_b - x_0),   a = 1 / sqrt(B).

Blocks scatter by s_b^2, whose expectation is the sum of V_S over all S that contain b. In the variance of mu, V_S has
the factor

    (1 - |S| a)^2 + sum_{b in S} a^2 / (K_b - 1),

where |S| is the number of blocks in S, and in

    error^2 = sum_b s_b^2 [(1 - a)^2 + a^2 / (K_b - 1)]

the first term is |S| (1 - a)^2 instead. The latter is not below the former as long as a^2 <= 1 / |S|. They are equal
for main effects, and for terms that depend on all blocks. The error is therefore right for these, whatever their
shares, and too large for interactions of two out of three blocks. Without interactions a = 1 - 1 / K_b would be best;
the error is larger than that by 6 % for ten and four draws that scatter alike, and by up to 19 % where only the block
of ten has scatter. With that a, however, a pure interaction has the error 0.84 instead of 0.63 (in units of its
scatter), and 0.59 from s_b^2 / K_b. `a` is 1 - 1 / K_b where that is smaller.

**Scatter of several blocks.** The variance of one realization is sum_S V_S. The sum of the s_b^2 contains V_S |S|
times. The first realization shows the interactions, because it is the only one that is in several blocks:

    <(x_0 - m_b) (x_0 - m_c)> = sum of V_S over all S that contain b and c.

With P the sum of this over all pairs of blocks, V = sum_b s_b^2 - 2 P / B counts main effects and terms that depend on
all blocks once, and interactions of two out of three blocks 4/3 times. In one bin, P is a single product of two numbers
and very uncertain. The part of sum_b s_b^2 that is counted too often is therefore estimated from all bins together, in
units of their quoted errors, and taken to be the same in all of them. It is between 0 and the part without which V
would be below the largest s_b^2. The estimate needs many independent bins: where all bins move together, the scatter is
uncertain by up to sqrt(B).

**Corrected power.** P^R is divided by the transfer function T of other realizations than the one it corrects.
P^R / T estimates the EoR without loss. T of the same data would not serve: it contains the EoR and the noise that are
to be measured. T of realization r is the mean over realizations of other gains and other noise, which cause most of the
scatter of T (through the flux scale); each draw of them has the same weight. The EoR may be the same: T is a ratio to
its power, and nearly independent of it. T_r differs from that mean by

    sigma_T^2 = sum_b s_b^2 sum_g w_g^2

where g are the draws of block b, w = 1 for the draw of
r, less the share that each draw has in the mean. s_b^2 is the scatter of the other realizations. A term that depends on
several blocks together is in each of their s_b^2, and so makes sigma_T too large rather than too small.

Noise and EoR pass through the same projection, which reduces the noise in P^R by about T as well; dividing by T
restores it to that of the data. So with P = P^R / T,

    sigma^2 (P - P^S) = sigma_{R-S}^2 + (P sigma_T / T)^2,

where sigma_{R-S} is the error of P^R - P^S, of noise and its product with the EoR
(`SphericalSpectrum.difference_error`); P less the input power also has the sample variance of the input power,

    sigma_S^2 = P_input^2 / (independent modes of the signal).

The sample error of a spectrum follows its own power instead, so that low powers have small bars: with sixty independent
modes such bars cover the input in 94.2 % of cases instead of 95.1, with twelve in 91.1 instead of 95.4 %. The 95 %
interval is the set of input powers that differ from P by at most 1.96 of the standard deviations that belong to them.

There is no result where too little of the EoR is left, or where most of the power is from elsewhere
(`calstudy.power.transfer.correctable`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.transfer import TransferFunction, correctable, why_not
from calstudy.verdicts.criterion import Finding


@dataclass(frozen=True)
class Pooled:
    """One quantity over the realizations of one block, or of all blocks, in Nk bins.

    Attributes
    ----------
    scatter, error : standard deviation of one realization, and standard error of the mean, (Nk,)
    quoted : rms of the errors that the realizations quote, (Nk,)
    covariance : of one realization, between bins, (Nk, Nk). Its rank is below the number of realizations.
    counted_twice
        Part of the sum of the variances of all blocks that is in several of them, and left out of `covariance`.
    """

    mean: np.ndarray
    scatter: np.ndarray
    error: np.ndarray
    quoted: np.ndarray
    covariance: np.ndarray
    counted_twice: float = 0.0

    @property
    def correlation(self) -> np.ndarray:
        """Covariance over the product of the standard deviations, (Nk, Nk); NaN without scatter."""
        scatters = np.outer(self.scatter, self.scatter)
        return np.divide(self.covariance, scatters, out=np.full(scatters.shape, np.nan), where=scatters > 0)


def pool(values: np.ndarray, quoted: np.ndarray) -> Pooled:
    """Pool values and their quoted errors, (K, Nk), over the K realizations of one block, at least two."""
    if len(values) < 2:
        raise ValueError(f"{len(values)} realization to pool, expected at least two")
    deviations = values - values.mean(axis=0)
    covariance = deviations.T @ deviations / (len(values) - 1)
    scatter = np.sqrt(np.diagonal(covariance))
    rms = np.sqrt(np.mean(quoted**2, axis=0))
    return Pooled(values.mean(axis=0), scatter, scatter / np.sqrt(len(values)), rms, covariance)


def together(values: np.ndarray, quoted: np.ndarray, blocks: Sequence[Sequence[int]]) -> Pooled:
    """Pool values and their quoted errors, (K, Nk), over all blocks.

    `blocks` lists the realizations of each block; the first realization is in all of them.
    """
    pooled = [pool(values[list(block)], quoted[list(block)]) for block in blocks]
    common, mean, variance = values[0], values[0].copy(), np.zeros(values.shape[1])
    from_others = []
    for block, one in zip(blocks, pooled, strict=True):
        others = len(block) - 1
        weight = min(1 / np.sqrt(len(blocks)), others / len(block))
        from_others.append(common - values[list(block)[1:]].mean(axis=0))
        mean -= weight * from_others[-1]
        variance += one.scatter**2 * ((1 - weight) ** 2 + weight**2 / others)
    rms = np.sqrt(np.mean([one.quoted**2 for one in pooled], axis=0))
    unit = rms if (rms > 0).any() else np.ones(rms.size)
    counted_twice = _counted_twice(np.array([one.scatter for one in pooled]) / unit, np.array(from_others) / unit)
    covariance = (1 - counted_twice) * np.sum([one.covariance for one in pooled], axis=0)
    return Pooled(
        mean=mean,
        scatter=np.sqrt(np.diagonal(covariance)),
        error=np.sqrt(variance),
        quoted=rms,
        covariance=covariance,
        counted_twice=counted_twice,
    )


def _counted_twice(scatters: np.ndarray, from_others: np.ndarray) -> float:
    """Return the part of the sum of the blocks' variances that is in several of them, over all bins.

    `scatters` are the standard deviations of one realization in each of B blocks, in a unit that makes bins alike;
    `from_others` the first realization less the mean of the others of each block; (B, Nk) each.
    """
    known = np.isfinite(scatters).all(axis=0)
    squares = np.sum(scatters[:, known] ** 2, axis=1)
    total = squares.sum()
    if total == 0:
        return 0.0
    pairs = sum(np.sum(first * second) for first, second in combinations(from_others[:, known], 2))
    return float(np.clip(2 / len(squares) * pairs / total, 0, 1 - squares.max() / total))


@dataclass(frozen=True)
class Sample:
    """Spectra of one realization in Nk bins of |k|.

    `residual`, `without_eor` and `eor` are P^R of data with and without the EoR, and P^S, with their errors. `put_in`
    is the power of the EoR from which the sky was drawn, (Nk,), mK^2 h^-3 Mpc^3. `transfer` is T in the same bins, None
    if not known.
    """

    residual: SphericalSpectrum
    without_eor: SphericalSpectrum
    eor: SphericalSpectrum
    put_in: np.ndarray
    transfer: TransferFunction | None = None


@dataclass(frozen=True)
class Quantity:
    """A number per bin of k that is pooled: functions of a sample give its value and quoted error, (Nk,)."""

    symbol: str
    value: Callable[[Sample], np.ndarray]
    error: Callable[[Sample], np.ndarray]


def _over_eor(values: np.ndarray, sample: Sample) -> np.ndarray:
    return values / sample.eor.power.real


def _pull(values: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.divide(values, error, out=np.full(values.shape, np.nan), where=error > 0)


def _one(sample: Sample) -> np.ndarray:
    return np.ones(sample.eor.k.size)


QUANTITIES = {
    "ratio": Quantity(
        "P^R / P^S", lambda s: _over_eor(s.residual.power.real, s), lambda s: _over_eor(s.residual.difference_error, s)
    ),
    "bias": Quantity(
        "P^R0 / P^S", lambda s: _over_eor(s.without_eor.power.real, s), lambda s: _over_eor(s.without_eor.error, s)
    ),
    "pull_eor": Quantity(
        "(P^R - P^S) / sigma",
        lambda s: _pull(s.residual.power.real - s.eor.power.real, s.residual.difference_error),
        _one,
    ),
    "pull_input": Quantity(
        "(P^R - input) / sigma", lambda s: _pull(s.residual.power.real - s.put_in, s.residual.error), _one
    ),
    "pull_without_eor": Quantity(
        "P^R0 / sigma_N", lambda s: _pull(s.without_eor.power.real, s.without_eor.error), _one
    ),
}
"""Quantities of power spectra, known in every region."""


def _of_transfer(name: str) -> tuple[Callable[[Sample], np.ndarray], Callable[[Sample], np.ndarray]]:
    """Return value and quoted error of a field of the transfer function; NaN where it has no error."""

    def read(field: str) -> Callable[[Sample], np.ndarray]:
        return lambda sample: np.broadcast_to(getattr(sample.transfer, field, np.nan), sample.eor.k.shape)

    return read(name), read(f"{name}_error")


TRANSFER_QUANTITIES = {
    "transfer": Quantity("T", *_of_transfer("transfer")),
    "scale_free_transfer": Quantity("T s^2", *_of_transfer("scale_free_transfer")),
    "flux_scale": Quantity("s", *_of_transfer("flux_scale")),
    "cross_transfer": Quantity("C", *_of_transfer("cross_transfer")),
    "squared_coherence": Quantity("C^2 / T", *_of_transfer("squared_coherence")),
}
"""Quantities of the transfer function, by its fields; a single number counts for all bins."""


@dataclass(frozen=True)
class Design:
    """The draws of each realization.

    `draws` holds the number of the draw of each part, for each of K realizations; `blocks` the parts that each block
    draws, and the realizations that belong to it, of which the first belongs to all.
    """

    draws: Sequence[Mapping[str, int]]
    blocks: Sequence[tuple[Sequence[str], Sequence[int]]]

    def shared(self, first: int, second: int) -> int:
        """Return the number of parts that two realizations have in common."""
        return sum(self.draws[second][part] == number for part, number in self.draws[first].items())

    def others(self, realization: int) -> dict[int, float]:
        """Return the other realizations from which T of one is taken, and their weights, which add up to one.

        These are the realizations with other gains and other noise, on which T depends most, whatever their EoR. Each
        draw of gains and noise has the same weight, shared by its realizations. Where no other gains and noise are
        drawn, they are the realizations that share the fewest parts, with equal weights.
        """
        rest = [number for number in range(len(self.draws)) if number != realization]
        groups: dict[tuple[int, ...], list[int]] = {}
        for number in rest:
            if all(self.draws[number][part] != self.draws[realization][part] for part in ("gains", "noise")):
                groups.setdefault((self.draws[number]["gains"], self.draws[number]["noise"]), []).append(number)
        if groups:
            return {number: 1 / len(groups) / len(members) for members in groups.values() for number in members}
        fewest = min(self.shared(realization, number) for number in rest)
        used = [number for number in rest if self.shared(realization, number) == fewest]
        return dict.fromkeys(used, 1 / len(used))

    def block_of(self, part: str) -> int | None:
        """Return the block that draws a part, or None."""
        return next((place for place, (parts, _) in enumerate(self.blocks) if part in parts), None)


@dataclass(frozen=True)
class PooledRegion:
    """All quantities in one part of Fourier space.

    `k` are the centres, (Nk,), and `bin_edges` the edges, (Nk + 1,), of the bins, h/Mpc. By the name of the quantity,
    `values` and `quoted` hold all K realizations, (K, Nk), `blocks` the pooled ones of each block, and `total` those of
    all blocks together.
    """

    k: np.ndarray
    bin_edges: np.ndarray
    design: Design
    values: Mapping[str, np.ndarray]
    quoted: Mapping[str, np.ndarray]
    blocks: Mapping[str, Sequence[Pooled]]
    total: Mapping[str, Pooled]


def quantities_of(sample: Sample) -> dict[str, Quantity]:
    """Return the quantities that are known of a sample, those of the transfer function first."""
    return (TRANSFER_QUANTITIES if sample.transfer is not None else {}) | QUANTITIES


def pool_region(samples: Sequence[Sample], design: Design) -> PooledRegion:
    """Pool all quantities of samples in the same bins."""
    first = samples[0].eor
    values, quoted, blocks, total = {}, {}, {}, {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for name, quantity in quantities_of(samples[0]).items():
            values[name] = np.stack([quantity.value(sample) for sample in samples])
            quoted[name] = np.stack([quantity.error(sample) for sample in samples])
            rows = [list(places) for _, places in design.blocks]
            blocks[name] = tuple(pool(values[name][row], quoted[name][row]) for row in rows)
            total[name] = together(values[name], quoted[name], rows)
    return PooledRegion(first.k, first.bin_edges, design, values, quoted, blocks, total)


def inside_bars(deviations: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return 1 where a deviation is within its 95 % bar, 0 where it is not, NaN where either is not known."""
    known = np.isfinite(deviations) & np.isfinite(errors)
    return np.where(known, np.abs(deviations) <= SIGMAS_95 * errors, np.nan)


def coverage(inside: np.ndarray) -> Finding:
    """Return the part of 95 % bars that cover, and its uncertainty, from `inside_bars`, (K, Nk).

    The uncertainty is the larger of the one from the scatter over realizations, which includes correlated bins, and the
    binomial one for 95 % of independent bins. The quantity that the bars should cover is drawn in every realization.
    """
    known = np.isfinite(inside)
    if not known.any():
        return Finding(np.nan, np.nan)
    each = np.array([row[used].mean() for row, used in zip(inside, known, strict=True) if used.any()])
    binomial = float(np.sqrt(0.95 * 0.05 / known.sum()))
    by_scatter = float(each.std(ddof=1) / np.sqrt(each.size)) if each.size > 1 else 0.0
    return Finding(float(inside[known].mean()), max(binomial, by_scatter))


def mean_over_bins(values: np.ndarray, design: Design) -> Finding:
    """Return the mean of a quantity, (K, Nbins), over bins, and its error by the scatter over all that was drawn.

    Bins that are not known in all realizations are left out.
    """
    known = np.isfinite(values).all(axis=0)
    if not known.any():
        return Finding(np.nan, np.nan)
    each = values[:, known].mean(axis=1, keepdims=True)
    found = together(each, np.zeros(each.shape), [places for _, places in design.blocks])
    return Finding(float(found.mean[0]), float(found.error[0]))


def error_ratio(values: np.ndarray, quoted: np.ndarray) -> Finding:
    """Return the scatter over the realizations of a block over the quoted error, rms over bins, with a jackknife error.

    `values` and `quoted` are (K, Nbins). A ratio of one means that quoted errors are right for what the block draws.
    """
    known = np.isfinite(values).all(axis=0) & np.isfinite(quoted).all(axis=0)
    count = len(values)
    if not known.any() or count < 3:
        return Finding(np.nan, np.nan)

    def ratio(rows: np.ndarray) -> float:
        errors = np.mean(quoted[rows][:, known] ** 2)
        return float(np.sqrt(values[rows][:, known].var(axis=0, ddof=1).mean() / errors))

    left_out = np.array([ratio(np.delete(np.arange(count), number)) for number in range(count)])
    error = np.sqrt((count - 1) * np.mean((left_out - left_out.mean()) ** 2))
    return Finding(ratio(np.arange(count)), float(error))


@dataclass(frozen=True)
class Corrected:
    """P^R / T of K realizations in Nk bins, T of other realizations; NaN where `correctable` forbids it.

    Attributes
    ----------
    transfer, transfer_error
        Mean T of the other realizations, and the expected deviation of this one's T from it, (K, Nk).
    power : P^R / T, (K, Nk), mK^2 h^-3 Mpc^3
    error, error_with_sample
        Standard deviations of its difference from P^S, and from the input power, with its sample variance, (K, Nk).
    power_known_scale
        P^R s^2 / (T s^2), (K, Nk): P^R on the true flux scale, by s of the realization itself, over T s^2 of others.
    shared : largest number of parts (EoR, gains, noise) in common with a realization that T is from, (K,) int
    reasons : why a bin is not corrected in any realization, (Nk,) str; empty where it is
    """

    transfer: np.ndarray = field(metadata={"unit": ""})
    transfer_error: np.ndarray = field(metadata={"unit": ""})
    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    error: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    error_with_sample: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    power_known_scale: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    shared: np.ndarray = field(metadata={"unit": ""})
    reasons: np.ndarray = field(metadata={"unit": ""})


def transfer_of_others(values: np.ndarray, design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean T of other realizations, and the expected deviation of each one's own T from it, (K, Nk) each.

    `values` are T of all realizations, (K, Nk). With fewer than two others in a block the deviation is NaN.
    """
    mean, variance = np.empty(values.shape), np.zeros(values.shape)
    for own in range(len(values)):
        used = design.others(own)
        mean[own] = np.sum([weight * values[other] for other, weight in used.items()], axis=0)
        for parts, places in design.blocks:
            weights: dict[tuple[int, ...], float] = {}
            for number, weight in [(own, 1.0), *((other, -weight) for other, weight in used.items())]:
                draw = tuple(design.draws[number][part] for part in parts)
                weights[draw] = weights.get(draw, 0.0) + weight
            others = values[[place for place in places if place != own]]
            scatter = others.var(axis=0, ddof=1) if len(others) > 1 else np.full(values.shape[1], np.nan)
            variance[own] += scatter * sum(weight**2 for weight in weights.values())
    return mean, np.sqrt(variance)


def correct_realizations(samples: Sequence[Sample], design: Design) -> Corrected:
    """Divide P^R of every realization by T of others; every sample must have a transfer function.

    Where T and C of the others do not allow it (`calstudy.power.transfer.correctable`), there is no result. Their
    errors are those by scatter, or those that are quoted, whichever are larger.
    """
    mean, error, largest = _of_others("transfer", samples, design)
    cross, _, cross_error = _of_others("cross_transfer", samples, design)
    judged = (mean, largest, cross, cross_error)
    known = np.isfinite(error) & correctable(*judged)
    factor = np.where(known, mean, np.nan)
    power = np.stack([sample.residual.power.real for sample in samples]) / factor
    scale, scale_free = (
        np.stack([TRANSFER_QUANTITIES[name].value(sample) for sample in samples])
        for name in ("flux_scale", "scale_free_transfer")
    )
    known_scale = power * factor * scale**2 / transfer_of_others(scale_free, design)[0]
    own = np.stack([sample.residual.difference_error for sample in samples])
    with_noise = np.hypot(own, power * error / factor)
    with_sample = np.hypot(with_noise, np.stack([_sample_error_of_input(sample) for sample in samples]))
    return Corrected(
        transfer=mean,
        transfer_error=error,
        power=power,
        error=np.where(known, with_noise, np.nan),
        error_with_sample=np.where(known, with_sample, np.nan),
        power_known_scale=known_scale,
        shared=np.array(
            [max(design.shared(item, other) for other in design.others(item)) for item in range(len(samples))]
        ),
        reasons=np.array([_reason(*column) for column in zip(known.T, error.T, np.stack(judged).T, strict=True)]),
    )


def _sample_error_of_input(sample: Sample) -> np.ndarray:
    modes = sample.eor.sample_modes
    return np.divide(sample.put_in, np.sqrt(modes), out=np.full(modes.shape, np.nan), where=modes > 0)


def _of_others(name: str, samples: Sequence[Sample], design: Design) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `transfer_of_others` of T or C, and the larger of that error and the quoted one, (K, Nk) each."""
    quantity = TRANSFER_QUANTITIES[name]
    values, quoted = (np.stack([read(sample) for sample in samples]) for read in (quantity.value, quantity.error))
    mean, error = transfer_of_others(values, design)
    return mean, error, np.fmax(error, np.sqrt(np.mean(quoted**2, axis=0)))


def _reason(known: np.ndarray, error: np.ndarray, judged: np.ndarray) -> str:
    """Explain why a bin is not corrected in any of K realizations, by the first of them with an error.

    `known` and `error`, (K,), are where it is corrected and the error of T by scatter; `judged`, (K, 4), the arguments
    of `why_not`.
    """
    if known.any():
        return ""
    if np.isnan(judged[:, 0]).all():
        return "no modes"
    if np.isnan(error).all():
        return "too few realizations for an error of T"
    return why_not(*judged[np.isfinite(error)][0])
