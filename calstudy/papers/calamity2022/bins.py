"""Comparisons of spherical spectra bin by bin, with the error model of the paper."""

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


def difference_error(residual: SphericalSpectrum) -> np.ndarray:
    r"""Return the standard deviation of P^R - P^S, (Nk,), where both hold the same EoR.

    Of the variance P_S^2 + P_S P_N + P_N^2 / 2 of a mode (`calstudy.power.errors`) the first term is common to both, so
    that sigma_N^2 + sqrt(2) sigma_S sigma_N is left.
    """
    noise, sample = residual.noise_error, residual.sample_error
    return np.sqrt(noise**2 + np.sqrt(2) * noise * sample)


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
    signal, error = eor.power.real[used], difference_error(residual)[used]
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


def bias_extent(residual: SphericalSpectrum, eor: SphericalSpectrum) -> Finding:
    """Return the wavenumber in h/Mpc up to which P^R is below P^S by more than its 95 % error, without a gap.

    That is the upper edge of the last such bin, counted from the lowest that has modes, or the lower edge of that one
    if it is none; the uncertainty is half a bin.
    """
    used = np.flatnonzero(used_bins(residual, eor))
    low = (eor.power.real - residual.power.real > SIGMAS_95 * difference_error(residual))[used]
    count = low.size if low.all() else int(np.argmin(low))
    edges = residual.bin_edges
    edge = edges[used[0]] if count == 0 else edges[used[count - 1] + 1]
    return Finding(float(edge), float(np.diff(edges)[0] / 2))
