r"""Signal loss: the part of the EoR power that remains after calibration (paper §Conclusion: account for the loss).

The same foregrounds, noise and gains are calibrated twice, with the EoR S in the data and without. The residuals are
R_with = R_0 + D and R_without = R_0. Their difference D is the response of the residual to the signal: the part of S
that the foreground model and the gains have not absorbed. The power of the residual is then

    <R_with* R_with> = <R_0* R_0> + <D* D> + 2 Re <R_0* D>,

and the last term has zero mean, because S is independent of noise and foregrounds. P^D is therefore the part of P^R
that is due to the signal, without bias, and

    T(k) = P^D / P^S

is the transfer function: P^R / P^S without the part of P^R that is present without signal. The difference of the two
powers, P^{R_with} - P^{R_without}, has the same mean, but also the scatter of the last term from noise and foreground
residuals. These cancel in D, up to the change of the gains (S / F, 1e-4) times the noise. T is computed from cross
powers of even and odd data, so that the remaining noise in D gives no bias.

The *cross transfer* uses the cross power of signal and response instead,

    C(k) = Re <S* D> / P^S,

the coefficient of the linear regression of D on S. If a calibration projects (D = M S with M = M* = M^2) and S is
white, <D* D> = <S* M* M S> = <S* M S>: C and T are equal, and are the fraction of the mode that the fit cannot absorb.

The flux scale of a calibration is not determined by the fit: gains times sqrt(s) and a model divided by s fit as well.
The prior that fixes s (in the paper, on the summed model) has an error of some per cent. It multiplies the residual by
1/s, hence C by 1/s and T by 1/s^2, which is a part of P^R / P^S but not a loss. In a simulation the true gains are
known, and with them

    s^-2 = Re < r_even* r_odd >,   r = g_a g_b* / (ghat_a ghat_b*) averaged over the integrations of a block,

the mean over baselines, blocks of coherent averaging, and channels, weighted by the square of the taper: calibration
with these gains multiplies the power of a white signal by that. T s^2 is the transfer function free of the flux scale.
Where the true gains are not known, the *squared coherence* of response and signal,

    C^2 / T = (Re <S* D>)^2 / (<S* S> <D* D>),

does not depend on the scale either: it is 1 if only the scale was changed. If each baseline is crossed with itself, it
is the fraction of the power that remains after an orthogonal projection of white S, and equals T s^2. Weights that are
not flat make the projection oblique: it moves power between modes, which is in T and not in <S* D>, and C^2 / T is
smaller than T s^2. Between different baselines of a redundant group it is not such a fraction.

Numerator and denominator contain the same sky, so that most of the sample variance cancels. The rest is estimated from
the scatter of independent samples within a bin, where baselines that see the same sky are one sample (one patch of the
uv plane, whose delays share the taper), and by leaving out antennas, for baselines share the gains of their antennas
(`calstudy.power.clusters`).

**Bins in which P^R can be divided by T.** T contains all of D, whatever D contains, and C the part of S in it. A
projection of a white S has T = C. T - C is power from elsewhere: gain errors, or weights that vary between channels,
multiply the EoR in frequency, and leak power of other delays into this one. Such power measures P(k') at those delays.
Divided by T, it is the EoR at k only if the EoR has the same ratio of P(k') to P(k) as the simulated one that gave T.
The simulated ones are flat, which alone makes their quotients right. A result is therefore given only where

- T is above five times its error; otherwise there is nothing to correct;
- C is above five times its error, for a leak correlates with S by chance. Errors are often from four draws, and
  deviations over them have the wide tails of Student's t: with three degrees of freedom 3 % are above three errors, and
  0.8 % above five;
- C is above half of T: more than half of the power behaves as under a projection. Errors of C fall with every
  realization, and a C of a tenth of T becomes significant, but the leak in P^R / T does not decrease.

The T that is expected of a fit, by its linear response, has the bins in which injected signals are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from calstudy.power.clusters import Clusters, Sums, clusters_in_k, linear_error
from calstudy.power.delay import horizon_delay
from calstudy.power.spectra import BaselineModes, Cylinder, bins_of_k, length_bins, skies, sum_in_bins
from calstudy.verdicts.standing import is_measured

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.power.spectra import DelaySpectra, SphericalSpectrum

LEAST_SIGNIFICANCE = 5.0
LEAST_SHARE = 0.5


def _significant(values: ArrayLike, errors: ArrayLike) -> np.ndarray:
    """Return where values are above `LEAST_SIGNIFICANCE` times their errors; False where an error is not known."""
    return np.asarray(values) > LEAST_SIGNIFICANCE * np.asarray(errors)


def correctable(
    transfer: np.ndarray, transfer_error: np.ndarray, cross_transfer: np.ndarray, cross_transfer_error: np.ndarray
) -> np.ndarray:
    """Return where P^R can be divided by T, bool; T, C and their errors have the same shape."""
    own = _significant(cross_transfer, cross_transfer_error) & (cross_transfer > LEAST_SHARE * transfer)
    return _significant(transfer, transfer_error) & own


def why_not(transfer: float, transfer_error: float, cross_transfer: float, cross_transfer_error: float) -> str:
    """Explain in one sentence why P^R cannot be divided by T; return an empty text where it can."""
    if not _significant(transfer, transfer_error):
        return f"T = {transfer:.2f} is not above {LEAST_SIGNIFICANCE:g} times its error, {transfer_error:.2g}"
    if not _significant(cross_transfer, cross_transfer_error):
        return (
            f"C = {cross_transfer:.2g} is not above {LEAST_SIGNIFICANCE:g} times its error, "
            f"{cross_transfer_error:.2g}: nothing that is left is known to be the EoR at this k"
        )
    if not cross_transfer > LEAST_SHARE * transfer:
        return (
            f"C = {cross_transfer:.2g} is not above {LEAST_SHARE:g} T, T = {transfer:.2f}: most of the power is from "
            "elsewhere"
        )
    return ""


BANDS = (0.1, 0.2, 0.3, 0.5, 1.0)
"""Edges in h/Mpc of the wide bins in which studies are compared."""


# The key `array` in the metadata of a field is its name among the arrays of a figure, where published figures have
# another one than the field (see `calstudy.plotting.style.figure_arrays`).


@dataclass(frozen=True)
class TransferFunction:
    """T and C in Nk bins of |k|. Bins without signal hold NaN; errors are NaN where a bin has a single sample.

    Attributes
    ----------
    k, bin_edges : bin centres (Nk,) and edges (Nk + 1,), h/Mpc
    transfer, transfer_error : T = P^D / P^S and its standard deviation, (Nk,)
    cross_transfer, cross_transfer_error : C = Re <S* D> / P^S and its standard deviation, (Nk,)
    scale_free_transfer, scale_free_transfer_error
        T s^2, the transfer function free of the flux scale, and its standard deviation, (Nk,); NaN if s is not known.
    squared_coherence, squared_coherence_error
        C^2 / T, which does not depend on the scale of the gains, and its standard deviation, (Nk,). For spectra of each
        baseline with itself it is the fraction of the power that is retained, but where power leaks in from other
        delays, as next to the wedge.
    signal : sum of P^S over the modes of the bin, each pair of baselines counting the same, (Nk,); NaN for empty bins
    n_samples : different baselines in each bin, redundant ones counting once, (Nk,) int
    flux_scale : s: fitted gain products over the true ones; NaN if not known
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    transfer: np.ndarray = field(metadata={"unit": ""})
    transfer_error: np.ndarray = field(metadata={"unit": ""})
    cross_transfer: np.ndarray = field(metadata={"unit": "", "array": "coherence"})
    cross_transfer_error: np.ndarray = field(metadata={"unit": "", "array": "coherence_error"})
    scale_free_transfer: np.ndarray = field(metadata={"unit": ""})
    scale_free_transfer_error: np.ndarray = field(metadata={"unit": ""})
    squared_coherence: np.ndarray = field(metadata={"unit": "", "array": "retained"})
    squared_coherence_error: np.ndarray = field(metadata={"unit": "", "array": "retained_error"})
    signal: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    n_samples: np.ndarray = field(metadata={"unit": ""})
    flux_scale: float = field(metadata={"unit": ""})


RATIOS = ("transfer", "cross_transfer", "scale_free_transfer", "squared_coherence")
"""Fields of a transfer function that have an error."""


@dataclass(frozen=True)
class TransferMap(Cylinder):
    """T and C in bins of baseline length and delay, as in `TransferFunction`, (Nb, Nd) each.

    The two signs of the delay of a baseline are two samples.
    """

    transfer: np.ndarray = field(metadata={"unit": ""})
    transfer_error: np.ndarray = field(metadata={"unit": ""})
    cross_transfer: np.ndarray = field(metadata={"unit": "", "array": "coherence"})
    cross_transfer_error: np.ndarray = field(metadata={"unit": "", "array": "coherence_error"})


@dataclass(frozen=True)
class Injection:
    """Delay spectra S x S of an injected signal, D x D of its response, and S x D, for the same units and delays."""

    signal: DelaySpectra
    response: DelaySpectra
    cross: DelaySpectra


def where_measured(found: TransferFunction) -> TransferFunction:
    """Return a transfer function in which bins whose T is not measured hold NaN, but for the signal."""
    unknown = np.array(
        [not is_measured(*pair) for pair in zip(found.transfer, found.transfer_error, strict=True)], bool
    )
    changes: dict[str, Any] = {
        name: np.where(unknown, np.nan, getattr(found, name)) for stem in RATIOS for name in (stem, f"{stem}_error")
    }
    return replace(found, **changes)


def signal_response(with_signal: UVData, without_signal: UVData) -> UVData:
    """Return D, the difference of two residuals of the same noise, with and without the signal in the data.

    Samples that are flagged in either are flagged; the inputs are not changed.
    """
    response = with_signal.copy()
    response.data_array = with_signal.data_array - without_signal.data_array
    response.flag_array = with_signal.flag_array | without_signal.flag_array
    return response


def gain_ratio(true: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Return the mean over integrations of g_a g_b* / (ghat_a ghat_b*) for all pairs of antennas, (Npairs, Nfreqs).

    Both gains are (Ntimes, Nants, Nfreqs), complex; fitted ones are NaN where there are none. Integrations without a
    gain are left out of the mean of its pairs, which is NaN if all are.
    """
    first, second = np.triu_indices(true.shape[1], 1)
    total, count = np.zeros((first.size, true.shape[2]), complex), np.zeros((first.size, true.shape[2]))
    for injected, gains in zip(true, fitted, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = injected / gains
            product = ratio[first] * ratio[second].conj()
        known = np.isfinite(product)
        total[known] += product[known]
        count += known
    return np.divide(total, count, out=np.full(total.shape, np.nan, complex), where=count > 0)


def flux_scale(even: np.ndarray, odd: np.ndarray, weights: np.ndarray) -> float:
    """Return s, the flux scale of a calibration; NaN if even and odd data have nothing in common, not even the sign.

    `even` and `odd` are true over fitted gain products (`gain_ratio`), (Npairs, Nfreqs), complex; NaN is left out. The
    weights of the channels, (Nfreqs,), are the square of the taper.
    """
    power = (even.conj() * odd).real
    known = np.isfinite(power)
    total = np.sum(np.broadcast_to(weights, power.shape), where=known)
    mean = np.sum(power * weights, where=known) / total if total > 0 else np.nan
    return float(mean**-0.5) if mean > 0 else np.nan


def spherical_transfer(
    injection: Injection, edges: ArrayLike, buffer: float, inside: bool, flux_scale: float = np.nan
) -> TransferFunction:
    """Return T in bins of |k|, outside or inside the wedge; `edges` and `buffer` are as in `clusters_in_k`.

    `flux_scale` is s of the calibration; NaN if not known.
    """
    limits = np.asarray(edges, dtype=float)
    signal = injection.signal
    clusters = clusters_in_k(signal, limits, buffer, inside)
    of_signal, response, cross = (clusters.powers(part) for part in (signal, injection.response, injection.cross))
    transfer, transfer_error = response.ratio(of_signal)
    cross_transfer, cross_transfer_error = cross.ratio(of_signal)
    squared_coherence, squared_coherence_error = _squared_coherence(of_signal, response, cross)
    return TransferFunction(
        k=(limits[1:] + limits[:-1]) / 2,
        bin_edges=limits,
        transfer=transfer,
        transfer_error=transfer_error,
        cross_transfer=cross_transfer,
        cross_transfer_error=cross_transfer_error,
        scale_free_transfer=transfer * flux_scale**2,
        scale_free_transfer_error=transfer_error * flux_scale**2,
        squared_coherence=squared_coherence,
        squared_coherence_error=squared_coherence_error,
        signal=of_signal.total,
        n_samples=clusters.n_samples,
        flux_scale=flux_scale,
    )


def _squared_coherence(signal: Sums, response: Sums, cross: Sums) -> tuple[np.ndarray, np.ndarray]:
    """Return C^2 / T in each bin, and its standard deviation."""
    with np.errstate(divide="ignore", invalid="ignore"):
        value = cross.total**2 / (signal.total * response.total)
        terms = ((2 / cross.total, cross), (-1 / signal.total, signal), (-1 / response.total, response))
    known = np.isfinite(value)
    error = np.abs(value) * linear_error(terms)
    return np.where(known, value, np.nan), np.where(known, error, np.nan)


def cylindrical_transfer(injection: Injection, length_bin: float) -> TransferMap:
    """Return T in bins of baseline length, `length_bin` m wide, and delay."""
    signal = injection.signal
    length_edges, row = length_bins(signal.length, length_bin)
    spacing = signal.delay[1] - signal.delay[0]
    step = np.rint(signal.delay / spacing).astype(int)
    column = np.abs(step)
    shape = (len(length_edges), column.max() + 1)
    bins = row[:, None] * shape[1] + column
    sky, opposite = skies(signal)
    samples = 2 * sky[:, None] + ((step < 0) ^ opposite[:, None])
    clusters = Clusters.of(signal, bins, samples, shape[0] * shape[1])
    of_signal = clusters.powers(signal)
    transfer, cross_transfer = (
        clusters.powers(part).ratio(of_signal) for part in (injection.response, injection.cross)
    )
    pairs = np.bincount(row, signal.n_pairs)
    length = np.bincount(row, signal.n_pairs * signal.length) / pairs
    return TransferMap(
        baseline_length=length,
        bin_edges=length_edges,
        k_perp=np.bincount(row, signal.n_pairs * signal.k_perp) / pairs,
        delay=spacing * np.arange(shape[1]),
        k_parallel=np.bincount(column, np.abs(signal.k_parallel)) / np.bincount(column),
        transfer=transfer[0].reshape(shape),
        transfer_error=transfer[1].reshape(shape),
        cross_transfer=cross_transfer[0].reshape(shape),
        cross_transfer_error=cross_transfer[1].reshape(shape),
        horizon_delay=horizon_delay(length),
    )


def pool(transfers: Sequence[TransferFunction]) -> TransferFunction:
    """Return the transfer function of several injections together, such as EoR skies of different seeds.

    Each enters with its signal's power, as if its modes were further modes of one injection, and errors add up as those
    of independent skies. A number that is NaN in some of them is that of the others. Raise ValueError if their bins
    differ.
    """
    first = transfers[0]
    if any(not np.array_equal(other.bin_edges, first.bin_edges) for other in transfers):
        raise ValueError("the transfer functions have different bins, expected the same")
    signal = np.stack([item.signal for item in transfers])
    found: dict[str, np.ndarray] = {}
    for name in RATIOS:
        values, errors = (np.stack([getattr(item, key) for item in transfers]) for key in (name, f"{name}_error"))
        weights = np.where(np.isfinite(values), signal, 0.0)
        weights = np.divide(weights, weights.sum(axis=0), out=np.full(weights.shape, np.nan), where=weights > 0)
        found[name] = _sum_present(weights * values)
        # Not known if that of one of the skies is not.
        unknown = (weights > 0) & ~np.isfinite(errors)
        found[f"{name}_error"] = np.where(unknown.any(axis=0), np.nan, np.sqrt(_sum_present((weights * errors) ** 2)))
    scales = [item.flux_scale for item in transfers if np.isfinite(item.flux_scale)]
    return replace(
        first,
        **found,
        signal=_sum_present(signal),
        n_samples=np.sum([item.n_samples for item in transfers], axis=0),
        flux_scale=float(np.mean(scales)) if scales else np.nan,
    )


def _sum_present(values: np.ndarray) -> np.ndarray:
    """Sum over the first axis, leaving out NaN; NaN where there is nothing else."""
    return np.where(np.isnan(values).all(axis=0), np.nan, np.nansum(values, axis=0))


def correct(spectrum: SphericalSpectrum, transfer: TransferFunction, reduced: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return P^R / T and its standard deviation, (Nk,) each, in the unit of the spectrum.

    Errors of P^R and T are independent. Those of P^R are divided by T if they are `reduced` like P^R, as errors of
    what is left in measured data. Those of simulations are of all noise and EoR, of which the calibration takes as much
    as of the signal: dividing P^R by T restores both. NaN where too little is left to be corrected, or where most
    of it is not the EoR at this k (`correctable`). Both must have the same bins.
    """
    known = correctable(
        transfer.transfer, transfer.transfer_error, transfer.cross_transfer, transfer.cross_transfer_error
    )
    factor = np.where(known, transfer.transfer, np.nan)
    power = spectrum.power.real / factor
    own = spectrum.error / factor if reduced else np.where(known, spectrum.error, np.nan)
    return power, np.hypot(own, power * transfer.transfer_error / factor)


@dataclass(frozen=True)
class ExpectedBins:
    """Expected T, each baseline counting the same.

    Attributes
    ----------
    k, bin_edges : centres (Nk,) and edges (Nk + 1,), h/Mpc
    outside, outside_error
        T outside the wedge and its standard deviation from random probes, (Nk,); NaN in bins without modes.
    length_edges : lower and upper edge of each bin of baseline length, m, (Nb, 2)
    delay : from zero up, s, (Nd,)
    by_length : T per length and delay, both signs of the delay together, (Nb, Nd)
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    outside: np.ndarray = field(metadata={"unit": ""})
    outside_error: np.ndarray = field(metadata={"unit": ""})
    length_edges: np.ndarray = field(metadata={"unit": "m"})
    delay: np.ndarray = field(metadata={"unit": "s"})
    by_length: np.ndarray = field(metadata={"unit": ""})


def bin_expected(
    modes: BaselineModes, transfer: np.ndarray, error: np.ndarray, edges: ArrayLike, buffer: float, length_bin: float
) -> ExpectedBins:
    """Average the expected transfer function, (Nbls, Ndelays), and its error over bins; NaN without data.

    `edges` and `buffer` are as in `calstudy.power.clusters.clusters_in_k`. `length_bin` is a width, m.
    """
    limits = np.asarray(edges, float)
    known = np.isfinite(transfer)
    bins = np.where(known, bins_of_k(modes, limits, buffer), -1)
    count, total, square = (sum_in_bins(values, bins, limits.size - 1) for values in (np.ones(()), transfer, error**2))
    filled = np.where(count > 0, count, np.nan)
    length_edges, row = length_bins(modes.length, length_bin)
    spacing = modes.delay[1] - modes.delay[0]
    column = np.abs(np.rint(modes.delay / spacing).astype(int))
    cell = (row[:, None] * (column.max() + 1) + column)[known]
    shape = (len(length_edges), column.max() + 1)
    members, sums = (np.bincount(cell, weights, shape[0] * shape[1]) for weights in (None, transfer[known]))
    return ExpectedBins(
        k=(limits[1:] + limits[:-1]) / 2,
        bin_edges=limits,
        outside=total / filled,
        outside_error=np.sqrt(square) / filled,
        length_edges=length_edges,
        delay=spacing * np.arange(shape[1]),
        by_length=(sums / np.where(members > 0, members, np.nan)).reshape(shape),
    )


def bin_response(
    modes: BaselineModes, signal: np.ndarray, responses: tuple[np.ndarray, np.ndarray], edges: ArrayLike, buffer: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return T = Re <D* D'> / P^S and C = Re <S* (D + D')> / 2 P^S outside the wedge, (Nk,) each; NaN without signal.

    `signal` holds the amplitudes of the signal S, and `responses` those of the parts D and D' that two fits leave of
    it, (Nbls, Ndelays), complex; `edges` and `buffer` are as in `bin_expected`.
    """
    limits = np.asarray(edges, float)
    bins = bins_of_k(modes, limits, buffer)
    first, second = responses
    left, crossed, put_in = (
        sum_in_bins(np.real(one.conj() * other), bins, limits.size - 1)
        for one, other in ((first, second), (signal, (first + second) / 2), (signal, signal))
    )
    put_in = np.where(put_in > 0, put_in, np.nan)
    return left / put_in, crossed / put_in
