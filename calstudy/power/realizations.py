"""Pooling of realizations: quantities, their means and scatter (`calstudy.power.blocks`), and coverage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calstudy.power.blocks import Pooled, pool, together
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.transfer import TransferFunction
from calstudy.verdicts.criterion import Finding

SIGMAS_95 = 1.96


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
        "P^R / P^S",
        lambda s: _over_eor(s.residual.power.real, s),
        lambda s: _over_eor(s.residual.difference_error, s),
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
    """Pool all quantities; raise ValueError unless all samples have the same bins."""
    first = samples[0].eor
    if any(not np.array_equal(sample.eor.bin_edges, first.bin_edges) for sample in samples):
        raise ValueError("the realizations have different bins of k, expected the same")
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


def coverage(inside: np.ndarray, independent: bool) -> Finding:
    """Return the part of 95 % bars that cover, and its uncertainty, from `inside_bars`, (K, Nk).

    The uncertainty is the larger of the one from the scatter over realizations, which includes correlated bins, and the
    binomial one for 95 % of independent bins. `independent` is true if the quantity that the bars should cover is drawn
    in every realization; otherwise the realizations repeat the same trials, and only the bins of one realization count.
    """
    known = np.isfinite(inside)
    if not known.any():
        return Finding(np.nan, np.nan)
    each = np.array([row[used].mean() for row, used in zip(inside, known, strict=True) if used.any()])
    trials = known.sum() if independent else known.sum(axis=1).max()
    binomial = float(np.sqrt(0.95 * 0.05 / trials))
    by_scatter = float(each.std(ddof=1) / np.sqrt(each.size)) if independent and each.size > 1 else 0.0
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

    `values` and `quoted` are (K, Nbins). A ratio of one means that the quoted errors are right for the parts that the
    block draws.
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
