"""Cylindrical averages of delay spectra, in which foregrounds fill the wedge (paper Fig. WEDGE)."""

from __future__ import annotations

import numpy as np

from calstudy.power.delay import horizon_delay
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import CylindricalSpectrum, DelaySpectra


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
