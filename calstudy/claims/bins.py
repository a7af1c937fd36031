"""Comparisons of spectra bin by bin, and means over their modes, for statements of papers and steps of the ladder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.calibrate.agreement import Statistic
from calstudy.corrupt.effects.gains import ReflectionGains
from calstudy.power.delay import horizon_delay
from calstudy.power.spectra import SphericalSpectrum
from calstudy.simulate.floor import MAIN_LOBES
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    from calstudy.experiment.model import Experiment
    from calstudy.results.reader import Results, Tables


TINY = 1e-9
"""Tolerance of the limits of a range of k, h/Mpc: a bin belongs to one range, whatever the rounding of its centre."""
SEEN = 3.0
"""Power above that of the noise by more than so many sigma is seen."""
REFLECTION_WIDTH = 2
"""Reflections are searched for within this many standard deviations of their mean delay."""


def used_bins(*spectra: SphericalSpectrum, k_min: float = 0.0, k_max: float = np.inf) -> np.ndarray:
    """Return the bins, (Nk,) bool, between two wavenumbers in h/Mpc in which all spectra have power.

    Raises Unevaluated if there is none, or the bins of the spectra differ.
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


def outside_wedge(
    run: Tables, *variants: str, k_min: float = 0.0, k_max: float = np.inf
) -> tuple[np.ndarray, list[SphericalSpectrum]]:
    """Return the `used_bins` of the spectra of some variants outside the wedge, and the spectra."""
    spectra = [run.spherical(variant, "outside-wedge") for variant in variants]
    return used_bins(*spectra, k_min=k_min, k_max=k_max), spectra


def reflection_bins(run: Tables, experiment: Experiment, spectrum: SphericalSpectrum) -> np.ndarray:
    """Return the bins of k, (Nk,) bool, of the positive delays of reflections; raises Unevaluated if there are none."""
    gains = experiment.corruption.gains
    if not isinstance(gains, ReflectionGains):
        raise Unevaluated("the gains have no reflections")
    low, high = (gains.delay + sign * REFLECTION_WIDTH * gains.delay_scatter for sign in (-1, 1))
    wedge = run.wedge("noise")
    per_second = wedge.k_parallel[-1] / wedge.delay[-1]
    chosen = (spectrum.bin_edges[1:] > low * per_second) & (spectrum.bin_edges[:-1] < high * per_second)
    chosen &= used_bins(spectrum)
    if not chosen.any():
        raise Unevaluated("no modes at the delays of the reflections")
    return chosen


def at_reflections(run: Tables, experiment: Experiment, known: str) -> tuple[float, float, float]:
    """Return P^V and P^R at the delays of the reflections, outside the wedge, and the standard deviation of the noise.

    They are means weighted with the inverse noise variance of P^R over the bins in which the variant `known` has power.
    """
    spectra = {name: run.spherical(name, "outside-wedge") for name in ("uncalibrated", "residual")}
    chosen = reflection_bins(run, experiment, spectra[known])
    weights = spectra["residual"].noise_error[chosen] ** -2.0
    before, after = (float(np.sum(weights * item.power.real[chosen]) / weights.sum()) for item in spectra.values())
    return before, after, float(weights.sum() ** -0.5)


def beyond_wedge(delay: np.ndarray, lengths: np.ndarray, buffer: float) -> np.ndarray:
    """Return which delays, s, are beyond horizon and buffer, or the taper's main lobe if wider, (Nlengths, Ndelays)."""
    lobe = MAIN_LOBES["blackman-harris"] * (delay[1] - delay[0])
    return np.abs(delay) > horizon_delay(lengths)[:, None] + max(buffer, lobe)


def median_and_scatter(values: np.ndarray) -> Finding:
    """Return the median with the scatter of the values, half the width of their central 68 %."""
    found = Statistic.of(values, "")
    return Finding(found.value, found.scatter, "scatter")


def recovered(residual: SphericalSpectrum, eor: SphericalSpectrum, k_min: float, k_max: float = np.inf) -> Finding:
    """Return P^R / P^S over bins of k (h/Mpc), weighted with the inverse variance of the difference of the two."""
    used = used_bins(residual, eor, k_min=k_min, k_max=k_max)
    signal, error = eor.power.real[used], residual.difference_error[used]
    weights = signal / error**2
    norm = np.sum(weights * signal)
    return Finding(float(np.sum(weights * residual.power.real[used]) / norm), float(norm**-0.5))


def recovered_outside_wedge(run: Results, k_min: float, k_max: float = np.inf) -> Finding:
    """Return what `recovered` does, of a run outside the wedge, with the errors of what is left without EoR and of s.

    The flux scale s differs between draws of gains and noise by more than the noise of P^R. How far it is from 1 in
    this run is the one sample of that.
    """
    used, (residual, eor) = outside_wedge(run, "residual", "eor", k_min=k_min, k_max=k_max)
    found = recovered(residual, eor, k_min, k_max)
    signal, error = eor.power.real[used], residual.difference_error[used]
    weights = signal / error**2
    left = np.sum(weights * error_of_what_is_left(run)[used]) / np.sum(weights * signal)
    of_scale = found.value * (1 - run.score.flux_scale**2)
    return found._replace(uncertainty=float(np.linalg.norm([found.uncertainty, left, of_scale])))


def fraction_within(value: np.ndarray, error: np.ndarray) -> Finding:
    """Return the fraction of the values within their 95 % error bars of zero, with the binomial error for 95 %."""
    inside = np.abs(value) <= SIGMAS_95 * error
    return Finding(float(np.mean(inside)), float(np.sqrt(0.95 * 0.05 / inside.size)))


def rms_power(spectrum: SphericalSpectrum, used: np.ndarray) -> Finding:
    """Return the rms of P over bins, with the uncertainty for independent bins of the same variance, as noise has."""
    value = float(np.sqrt(np.mean(spectrum.power.real[used] ** 2)))
    return Finding(value, value / np.sqrt(2 * used.sum()))


def ratio(above: Finding, below: Finding) -> Finding:
    """Return the ratio of two numbers with independent errors."""
    value = above.value / below.value
    return Finding(value, abs(value) * np.hypot(above.uncertainty / above.value, below.uncertainty / below.value))


def mean_of_common_errors(values: np.ndarray, errors: np.ndarray) -> Finding:
    """Return the mean, weighted with inverse variances, of values with a common error, such as that of shared gains."""
    known = np.isfinite(values) & np.isfinite(errors)
    if not known.any():
        raise Unevaluated("no bins with a transfer function")
    weights = errors[known] ** -2.0 / np.sum(errors[known] ** -2.0)
    return Finding(float(np.sum(weights * values[known])), float(np.sum(weights * errors[known])))


def difference_of_losses(first: Results, second: Results, k_min: float, k_max: float = np.inf) -> Finding:
    """Return T free of the flux scale of one run minus that of another, over their common bins of k, h/Mpc."""
    one, other = (run.transfer("outside-wedge") for run in (first, second))
    if not np.array_equal(one.bin_edges, other.bin_edges):
        raise Unevaluated("the transfer functions have different bins of k")
    used = (one.k >= k_min - TINY) & (one.k <= k_max)
    difference = one.scale_free_transfer - other.scale_free_transfer
    error = np.hypot(one.scale_free_transfer_error, other.scale_free_transfer_error)
    return mean_of_common_errors(difference[used], error[used])


def _without_eor(run: Results, used: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return P^R0 of bins outside the wedge, its standard deviation by noise, and the rest of its error, (N,) each.

    Errors come from leaving out antennas (`calstudy.power.score`), because power left by foregrounds is not noise. In a
    bin with a single baseline or group, whose scatter is not known, the rest is the power itself. Raises Unevaluated
    without the variants `eor` and `residual_without_eor`, or scores.
    """
    eor, residual = (run.spherical(variant, "outside-wedge") for variant in ("eor", "residual_without_eor"))
    score = run.score
    if not np.array_equal(score.bin_edges, residual.bin_edges):
        raise Unevaluated("the scores of the run have other bins than its spectra")
    power, noise = residual.power.real[used], residual.noise_error[used]
    error = (score.bias_error * eor.power.real)[used] / score.flux_scale**2
    rest = np.where(np.isfinite(error), np.sqrt(np.maximum(error**2 - noise**2, 0)), np.abs(power))
    return power, noise, rest


def power_without_eor(run: Results, used: np.ndarray, weights: np.ndarray) -> Finding:
    """Return a weighted mean of P^R0 over bins outside the wedge, mK^2 h^-3 Mpc^3: the residual of data without EoR.

    The bins are (Nk,) bool; the weights of the used bins may have any sum. Noise is independent from bin to bin; the
    rest of the error is taken as common to all bins, which share the gains. Raises Unevaluated as `_without_eor`.
    """
    power, noise, rest = _without_eor(run, used)
    share = weights / np.sum(weights)
    uncertainty = np.hypot(np.sqrt(np.sum((share * noise) ** 2)), np.sum(share * rest))
    return Finding(float(np.sum(share * power)), float(uncertainty))


def _above_noise(run: Results, used: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `_without_eor` does, and no rest of the error in bins that are not above the noise by `SEEN` sigma.

    There leaving out antennas tells the noise, which is known better.
    """
    power, noise, rest = _without_eor(run, used)
    return power, noise, np.where(np.abs(power) > SEEN * noise, rest, 0)


def error_of_what_is_left(run: Results) -> np.ndarray:
    """Return the error of P^R0 in bins outside the wedge but for noise, (Nk,); zero if P^R0 is not above the noise."""
    residual = run.spherical("residual_without_eor", "outside-wedge")
    known, found = np.isfinite(residual.power.real) & np.isfinite(residual.noise_error), np.zeros(residual.k.size)
    found[known] = _above_noise(run, known)[2]
    return found


def rms_without_eor(run: Results, used: np.ndarray, units: np.ndarray | float = 1.0) -> Finding:
    """Return the rms over bins of P^R0 outside the wedge, over its `units` in the bins.

    The square of noise has the variance 2 sigma^4, and that of power P with noise 4 P^2 sigma^2 + 2 sigma^4, in which
    the measured square is P^2 + sigma^2. What is left above the noise has the errors of `power_without_eor`.
    """
    power, noise, rest = (values / units for values in _above_noise(run, used))
    rms = float(np.sqrt(np.mean(power**2)))
    of_noise = max(float(np.sum(4 * power**2 * noise**2 - 2 * noise**4)), float(np.sum(2 * noise**4))) ** 0.5
    common = float(np.sum(2 * np.abs(power) * rest))
    return Finding(rms, float(np.hypot(of_noise, common)) / (2 * power.size * rms))


def pull_without_eor(run: Results, used: np.ndarray) -> Finding:
    """Return the mean over bins of P^R0 outside the wedge in units of its noise; errors as for `rms_without_eor`."""
    power, noise, rest = _above_noise(run, used)
    return Finding(float(np.mean(power / noise)), float(np.hypot(power.size**-0.5, np.mean(rest / noise))))


def bias(run: Results, k_min: float, k_max: float) -> Finding:
    """Return s^2 P^R0 / P^S outside the wedge: the residual without EoR over the EoR, free of the flux scale s.

    Bins of k (h/Mpc) are weighted with their modes; for uncertainty and errors see `power_without_eor`.
    """
    used, (eor, _) = outside_wedge(run, "eor", "residual_without_eor", k_min=k_min, k_max=k_max)
    modes = eor.n_modes[used]
    left = power_without_eor(run, used, modes)
    unit = run.score.flux_scale**2 / float(np.sum(modes * eor.power.real[used]) / np.sum(modes))
    return Finding(unit * left.value, unit * left.uncertainty)


def clustered_mean(values: np.ndarray, weights: np.ndarray | None = None) -> Finding:
    """Return the mean over (Nunits, Nmodes) and its standard error, with the modes of each unit as one sample.

    Modes that are NaN are left out. `weights` are those of the units, (Nunits,); equal by default.
    """
    used = np.isfinite(values)
    scale = np.ones(len(values)) if weights is None else np.asarray(weights, float)
    sums, counts = scale * np.where(used, values, 0).sum(axis=1), scale * used.sum(axis=1)
    filled = counts > 0
    if not filled.any():
        return Finding(np.nan, np.nan)
    mean = sums.sum() / counts.sum()
    deviations = (sums - mean * counts)[filled]
    error = np.sqrt(np.sum(deviations**2) * filled.sum() / max(filled.sum() - 1, 1)) / counts.sum()
    return Finding(float(mean), float(error))


def pooled(findings: list[Finding]) -> Finding:
    """Return the mean of independent measurements of one number, weighted by their inverse variances."""
    weights = np.array([finding.uncertainty**-2 for finding in findings])
    values = np.array([finding.value for finding in findings])
    return Finding(float(np.sum(weights * values) / weights.sum()), float(weights.sum() ** -0.5))
