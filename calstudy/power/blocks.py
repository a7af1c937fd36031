r"""Mean, scatter and covariance over many realizations whose parts were drawn in blocks.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np


@dataclass(frozen=True)
class Pooled:
    """One quantity over the realizations of one block, or of all blocks, in Nk bins.

    Attributes
    ----------
    scatter, error
        Standard deviation of one realization, and standard error of the mean, (Nk,).
    quoted
        rms of the errors that the realizations quote, (Nk,).
    covariance
        Of one realization, between bins, (Nk, Nk). Its rank is below the number of realizations.
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
