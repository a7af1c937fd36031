"""Averages of delay spectra in bins: spherical (paper Figs. SPHERICAL*), and cylindrical (paper Fig. WEDGE)."""

from __future__ import annotations

import numpy as np

from calstudy.power.delay import horizon_delay
from calstudy.power.errors import cross_modes, noise_modes, sample_modes
from calstudy.power.settings import KBins, PowerSettings
from calstudy.power.spectra import CylindricalSpectrum, DelaySpectra, SphericalSpectrum, outside_wedge


def make_bin_edges(bins: KBins) -> np.ndarray:
    """Return the edges in h/Mpc of equal bins from ``bins.min`` up to at least ``bins.max``, shape (Nk + 1,)."""
    count = int(np.ceil((bins.max - bins.min) / bins.width - 1e-9))
    return bins.min + bins.width * np.arange(count + 1)


def modes_in_bins(
    spectra: DelaySpectra, settings: PowerSettings, exclude_wedge: bool, only_wedge: bool = False
) -> np.ndarray:
    """Return the bin of |k| of each mode, (Nu, Nd) int, -1 for those left out; parameters as in `spherical_average`."""
    edges = make_bin_edges(settings.bins)
    magnitude = np.hypot(spectra.k_perp[:, None], spectra.k_parallel)
    bins = np.searchsorted(edges, magnitude, side="left") - 1
    bins[(bins < 0) | (bins >= edges.size - 1)] = -1
    if exclude_wedge:
        bins[~outside_wedge(spectra, settings.wedge_buffer)] = -1
    if only_wedge:
        bins[outside_wedge(spectra, settings.wedge_buffer)] = -1
    return bins


def spherical_average(
    spectra: DelaySpectra, settings: PowerSettings, exclude_wedge: bool, only_wedge: bool = False
) -> SphericalSpectrum:
    """Average over all modes in bins of |k|, with equal weights for all pairs of baselines, without error bars.

    `exclude_wedge` leaves out modes with |tau| <= |b|/c + buffer, `only_wedge` all others.
    """
    edges = make_bin_edges(settings.bins)
    n_bins = edges.size - 1
    bins = modes_in_bins(spectra, settings, exclude_wedge, only_wedge)
    used = bins >= 0
    weights = np.broadcast_to(spectra.n_pairs[:, None], bins.shape)[used]
    total = np.bincount(bins[used], weights, minlength=n_bins)
    values = weights * spectra.power[used]
    summed = np.bincount(bins[used], values.real, minlength=n_bins).astype(complex)
    summed += 1j * np.bincount(bins[used], values.imag, minlength=n_bins)
    unknown = np.full(n_bins, np.nan)
    return SphericalSpectrum(
        k=(edges[1:] + edges[:-1]) / 2,
        bin_edges=edges,
        power=np.divide(summed, total, out=np.full(n_bins, np.nan, dtype=complex), where=total > 0),
        n_modes=np.bincount(bins[used], minlength=n_bins),
        noise_modes=noise_modes(spectra, bins, n_bins),
        sample_modes=sample_modes(spectra, bins, n_bins),
        cross_modes=cross_modes(spectra, bins, n_bins),
        noise_error=unknown,
        sample_error=unknown,
        wedge_excluded=exclude_wedge,
    )


def cylindrical_average(spectra: DelaySpectra, settings: PowerSettings, folded: bool = True) -> CylindricalSpectrum:
    """Average over baselines of similar length with equal weights for all pairs; `folded` averages +-tau as well."""
    bins, index = np.unique(np.floor(spectra.length / settings.length_bin).astype(int), return_inverse=True)
    power = np.zeros((bins.size, spectra.delay.size), dtype=complex)
    np.add.at(power, index, spectra.n_pairs[:, None] * spectra.power)
    n_pairs = np.zeros(bins.size, dtype=int)
    np.add.at(n_pairs, index, spectra.n_pairs)
    length = np.bincount(index, spectra.n_pairs * spectra.length) / n_pairs
    power /= n_pairs[:, None]
    delay, k_parallel = spectra.delay, spectra.k_parallel
    if folded:
        delay, k_parallel, power = _fold(delay, k_parallel, power)
    return CylindricalSpectrum(
        baseline_length=length,
        bin_edges=np.column_stack([bins, bins + 1]) * settings.length_bin,
        k_perp=np.bincount(index, spectra.n_pairs * spectra.k_perp) / n_pairs,
        delay=delay,
        k_parallel=k_parallel,
        power=power,
        n_pairs=n_pairs,
        horizon_delay=horizon_delay(length),
    )


def _fold(delay: np.ndarray, k_parallel: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average over +-tau; zero, and the extreme delay of an even number of channels, have no partner."""
    step = np.abs(np.rint(delay / (delay[1] - delay[0])).astype(int))
    counts = np.bincount(step)
    total = np.zeros((step.max() + 1, len(power)), dtype=complex)
    np.add.at(total, step, power.T)
    return (
        np.bincount(step, np.abs(delay)) / counts,
        np.bincount(step, np.abs(k_parallel)) / counts,
        (total / counts[:, None]).T,
    )
