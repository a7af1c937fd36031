"""Comparisons of spherical spectra bin by bin, as statements of papers and steps of the validation ladder need them."""

from __future__ import annotations

import numpy as np

from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

SIGMAS_95 = 1.96


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


def difference_of_ratios(
    first: tuple[SphericalSpectrum, SphericalSpectrum],
    second: tuple[SphericalSpectrum, SphericalSpectrum],
    k_min: float,
    k_max: float = np.inf,
) -> Finding:
    """Return P^R / P^S of one run minus that of another: the mean of the differences of single bins.

    Each bin has the same weight in both runs, the inverse variance of its difference, so that a difference between the
    runs cannot come from how bins of unlike ratios are averaged.

    Parameters
    ----------
    first, second
        P^R and P^S of each run, in the same bins.
    k_min, k_max
        Bins that are used, h/Mpc.
    """
    used = used_bins(*first, *second, k_min=k_min, k_max=k_max)
    ratios, variances = [], []
    for residual, eor in (first, second):
        signal = eor.power.real[used]
        ratios.append(residual.power.real[used] / signal)
        variances.append((residual.difference_error[used] / signal) ** 2)
    weights = 1 / sum(variances)
    return Finding(float(np.sum(weights * (ratios[0] - ratios[1])) / weights.sum()), float(weights.sum() ** -0.5))


def bias_extent(residual: SphericalSpectrum, eor: SphericalSpectrum) -> Finding:
    """Return the wavenumber in h/Mpc up to which P^R is below P^S by more than its 95 % error.

    That is the upper edge of the first run of such bins, from small k up. Before it there may be bins in which P^R is
    below P^S by less than their errors, because few modes are in them. If there is no such run before the first bin in
    which P^R is not below P^S, it is the lower edge of the first bin. The uncertainty is half a bin.
    """
    used = np.flatnonzero(used_bins(residual, eor))
    pull = ((eor.power.real - residual.power.real) / residual.difference_error)[used]
    biased = pull > SIGMAS_95
    # Each search ends at the end of the bins at the latest.
    start = int(np.argmax(np.append(biased | ~(pull > 0), True)))
    end = start + int(np.argmax(np.append(~biased[start:], True)))
    edges = residual.bin_edges
    edge = edges[used[end - 1] + 1] if end > start else edges[used[0]]
    return Finding(float(edge), float(np.diff(edges)[0] / 2))
