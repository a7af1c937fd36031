r"""P^R corrected for signal loss: divided by the transfer function T of other realizations than the one it corrects.

P^R / T estimates the EoR without loss. T of the same data would not serve: it contains the EoR and the noise that are
to be measured. T of realization r is the mean over realizations of other gains and other noise, which cause most of the
scatter of T (through the flux scale); each draw of them has the same weight. The EoR may be the same: T is a ratio to
its power, and nearly independent of it. T_r differs from that mean by

    sigma_T^2 = sum_b s_b^2 sum_g w_g^2

(`calstudy.power.realizations` defines the blocks b of draws), where g are the draws of block b, w = 1 for the draw of
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
(`calstudy.power.correctable`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calstudy.power.correctable import correctable, why_not
from calstudy.power.realizations import TRANSFER_QUANTITIES, Design, Sample


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

    `values` are T of all realizations, (K, Nk). A block of the design with fewer than two other realizations leaves the
    deviation unknown: NaN.
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

    Where T and C of the others do not allow it (`calstudy.power.correctable`), there is no result. Their errors are
    those by scatter, or those that are quoted, whichever are larger.
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
