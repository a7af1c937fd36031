"""Comparisons of spherical spectra bin by bin, as statements of papers and steps of the validation ladder need them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    from calstudy.claims.results import RunResults

SIGMAS_95 = 1.96
TINY = 1e-9
"""h/Mpc: a bin belongs to one range, whatever the last digit of its centre."""


def used_bins(*spectra: SphericalSpectrum, k_min: float = 0.0, k_max: float = np.inf) -> np.ndarray:
    """Return the bins, (Nk,) bool, between two wavenumbers in h/Mpc in which all spectra have power.

    Raises
    ------
    Unevaluated
        If there is none, or the bins of the spectra differ.
    """
    first = spectra[0]
    if any(not np.array_equal(first.bin_edges, other.bin_edges) for other in spectra):
        raise Unevaluated("the spectra have different bins of k")
    used = (first.k >= k_min) & (first.k <= k_max)
    for spectrum in spectra:
        used &= np.isfinite(spectrum.power.real) & np.isfinite(spectrum.error)
    if not used.any():
        raise Unevaluated(f"no modes between k = {k_min:g} and {k_max:g} h/Mpc")
    return used


def bins_at_delays(spectrum: SphericalSpectrum, wedge: CylindricalSpectrum, low: float, high: float) -> np.ndarray:
    """Return the bins of k, (Nk,) bool, that delays from `low` to `high` (s) fall into.

    Parameters
    ----------
    spectrum
        Has the bins.
    wedge
        A cylindrical spectrum of the same experiment, which relates delays to wavenumbers.
    low, high
        Both positive.

    Raises
    ------
    Unevaluated
        If they are in no bin with modes.
    """
    per_second = wedge.k_parallel[-1] / wedge.delay[-1]
    chosen = (spectrum.bin_edges[1:] > low * per_second) & (spectrum.bin_edges[:-1] < high * per_second)
    chosen &= used_bins(spectrum)
    if not chosen.any():
        raise Unevaluated("no modes at the delays of the reflections")
    return chosen


def recovered(residual: SphericalSpectrum, eor: SphericalSpectrum, k_min: float, k_max: float = np.inf) -> Finding:
    """Return the ratio P^R / P^S, averaged over bins with the inverse variance of the difference of the two.

    Parameters
    ----------
    residual, eor
        P^R and P^S in the same bins.
    k_min, k_max
        Bins that are used, h/Mpc.
    """
    used = used_bins(residual, eor, k_min=k_min, k_max=k_max)
    signal, error = eor.power.real[used], residual.difference_error[used]
    weights = signal / error**2
    norm = np.sum(weights * signal)
    return Finding(float(np.sum(weights * residual.power.real[used]) / norm), float(norm**-0.5))


def fraction_within(value: np.ndarray, error: np.ndarray) -> Finding:
    """Return which part of the values is within its 95 % bar of zero, with the binomial error for 95 %."""
    inside = np.abs(value) <= SIGMAS_95 * error
    return Finding(float(np.mean(inside)), float(np.sqrt(0.95 * 0.05 / inside.size)))


def rms_power(spectrum: SphericalSpectrum, used: np.ndarray) -> Finding:
    """Return the rms of P over bins, and its uncertainty for that many independent ones."""
    value = float(np.sqrt(np.mean(spectrum.power.real[used] ** 2)))
    return Finding(value, value / np.sqrt(2 * used.sum()))


def ratio(above: Finding, below: Finding) -> Finding:
    """Return the ratio of two numbers with independent errors."""
    value = above.value / below.value
    return Finding(value, abs(value) * np.hypot(above.uncertainty / above.value, below.uncertainty / below.value))


@dataclass(frozen=True)
class RecoveredPower:
    """What two runs are compared by, in the same bins.

    Attributes
    ----------
    residual, eor
        P^R and P^S.
    loss_error
        Standard deviation of the transfer function, (Nk,): the runs lose different amounts by chance.
    """

    residual: SphericalSpectrum
    eor: SphericalSpectrum
    loss_error: np.ndarray


def difference_of_ratios(first: RecoveredPower, second: RecoveredPower, used: np.ndarray) -> Finding:
    """Return P^R / P^S of one run minus that of another: the mean of the differences of single bins.

    Each bin has the same weight in both runs, the inverse variance of its difference, so that a difference between the
    runs cannot come from how bins of unlike ratios are averaged. Noise is independent from bin to bin. What the gains
    absorb by chance is taken as common to all bins, because they share the gains.

    Parameters
    ----------
    first, second
        The runs.
    used
        Bins, (Nk,) bool, in which all of it is known.
    """
    ratios, variances, common = [], [], []
    for run in (first, second):
        signal = run.eor.power.real[used]
        ratios.append(run.residual.power.real[used] / signal)
        variances.append((run.residual.difference_error[used] / signal) ** 2)
        common.append(run.loss_error[used])
    weights = 1 / sum(variances)
    weights /= weights.sum()
    error = np.sqrt(np.sum(weights**2 * sum(variances)) + sum(np.sum(weights * part) ** 2 for part in common))
    return Finding(float(np.sum(weights * (ratios[0] - ratios[1]))), float(error))


def mean_of_common_errors(values: np.ndarray, errors: np.ndarray) -> Finding:
    """Return the mean of known values with inverse variances as weights; the errors are taken as common to all.

    Bins of k share the gains, and what the gains absorb by chance does not average down over bins.
    """
    known = np.isfinite(values) & np.isfinite(errors)
    if not known.any():
        raise Unevaluated("no bins with a transfer function")
    weights = errors[known] ** -2.0 / np.sum(errors[known] ** -2.0)
    return Finding(float(np.sum(weights * values[known])), float(np.sum(weights * errors[known])))


def difference_of_losses(first: RunResults, second: RunResults, k_min: float, k_max: float = np.inf) -> Finding:
    """Return T free of the flux scale of one run minus that of another, over bins from `k_min` to `k_max` in h/Mpc."""
    one, other = (run.transfer("outside-wedge") for run in (first, second))
    used = (one.k >= k_min - TINY) & (one.k <= k_max)
    difference = one.scale_free_transfer - other.scale_free_transfer
    error = np.hypot(one.scale_free_transfer_error, other.scale_free_transfer_error)
    return mean_of_common_errors(difference[used], error[used])


def bias_extent(residual: SphericalSpectrum, eor: SphericalSpectrum) -> Finding:
    """Return the wavenumber in h/Mpc up to which P^R is below P^S by more than its 95 % error.

    That is the upper edge of the last such bin before two in succession are not. The lowest bin may be one that is not,
    if the next is: few modes are in it. Without any bias it is the lower edge of the first bin. The uncertainty is the
    standard deviation of a number that is anywhere within half a bin, or what a deviation by 3 sigma instead of 95 %
    makes of it if that is more.
    """
    used = np.flatnonzero(used_bins(residual, eor))
    pull = ((eor.power.real - residual.power.real) / residual.difference_error)[used]
    edges = residual.bin_edges
    ends = [
        edges[used[0]] if last is None else edges[used[last] + 1]
        for last in map(_last_biased, (pull > SIGMAS_95, pull > 3))
    ]
    return Finding(float(ends[0]), max(float(np.diff(edges)[0] / np.sqrt(12)), float(abs(ends[0] - ends[1]))))


def _last_biased(biased: np.ndarray) -> int | None:
    """Return the last bin that is biased before two that are not, or None if none of the first two is."""
    last = None
    for place, is_biased in enumerate(biased):
        if is_biased:
            last = place
        elif place - (-1 if last is None else last) > 1:
            break
    return last


def power_without_eor(run: RunResults, used: np.ndarray, weights: np.ndarray) -> Finding:
    """Return a mean of P^R0 over bins outside the wedge, mK^2 h^-3 Mpc^3: the residual of data without EoR.

    Errors come from leaving out antennas (`calstudy.power.score`), for power that foregrounds leave is not noise. The
    part of them that thermal noise explains is independent from bin to bin; the rest is taken as common to all bins,
    which share the gains. The error of a bin with a single baseline or group, whose scatter is not known, is its power.

    Parameters
    ----------
    run
        With the variants `eor` and `residual_without_eor`, and scores.
    used
        Bins, (Nk,) bool.
    weights
        Of the bins that are used, of any sum.

    Raises
    ------
    Unevaluated
        If it lacks one of them.
    """
    eor, residual = (run.spherical(variant, "outside-wedge") for variant in ("eor", "residual_without_eor"))
    score = run.score
    if not np.array_equal(score.bin_edges, residual.bin_edges):
        raise Unevaluated("the scores of the run have other bins than its spectra")
    share, noise = weights / np.sum(weights), residual.noise_error[used]
    power = residual.power.real[used]
    error = (score.bias_error * eor.power.real)[used] / score.flux_scale**2
    common = np.where(np.isfinite(error), np.sqrt(np.maximum(error**2 - noise**2, 0)), np.abs(power))
    uncertainty = np.hypot(np.sqrt(np.sum((share * noise) ** 2)), np.sum(share * common))
    return Finding(float(np.sum(share * power)), float(uncertainty))


def bias(run: RunResults, k_min: float, k_max: float) -> Finding:
    """Return s^2 P^R0 / P^S outside the wedge: the residual without EoR over the EoR, free of the flux scale s.

    Bins are weighted with their modes. For the uncertainty see `power_without_eor`.

    Parameters
    ----------
    run
        With the variants `eor` and `residual_without_eor`, and scores.
    k_min, k_max
        h/Mpc.

    Raises
    ------
    Unevaluated
        If it lacks one of them, or has no modes there.
    """
    eor, residual = (run.spherical(variant, "outside-wedge") for variant in ("eor", "residual_without_eor"))
    used = used_bins(eor, residual, k_min=k_min, k_max=k_max)
    modes = eor.n_modes[used]
    left = power_without_eor(run, used, modes)
    unit = run.score.flux_scale**2 / float(np.sum(modes * eor.power.real[used]) / np.sum(modes))
    return Finding(unit * left.value, unit * left.uncertainty)
