"""Cylindrical averages of delay spectra (paper Fig. WEDGE)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from astropy import constants

if TYPE_CHECKING:
    from calstudy.power.settings import PowerSettings
    from calstudy.power.spectra import DelaySpectra


@dataclass(frozen=True)
class WedgeSpectrum:
    """A cylindrical power spectrum in Nb bins of baseline length and Nd delays.

    Attributes
    ----------
    baseline_length, k_perp
        Mean of each bin, (Nb,) ascending, m and h/Mpc. Bins without baselines do not appear.
    bin_edges
        Lower and upper edge of each bin, (Nb, 2), m.
    delay, k_parallel
        (Nd,) ascending, s and h/Mpc; from zero up if folded.
    power
        Mean over the pairs of baselines in each bin, (Nb, Nd) complex; the real part estimates P(k).
    n_pairs
        Pairs of baselines averaged, (Nb,) int.
    horizon_delay
        |b|/c, the edge of the wedge, (Nb,), s.
    """

    baseline_length: np.ndarray = field(metadata={"unit": "m"})
    bin_edges: np.ndarray = field(metadata={"unit": "m"})
    k_perp: np.ndarray = field(metadata={"unit": "h/Mpc"})
    delay: np.ndarray = field(metadata={"unit": "s"})
    k_parallel: np.ndarray = field(metadata={"unit": "h/Mpc"})
    power: np.ndarray = field(metadata={"unit": "mK2 h-3 Mpc3"})
    n_pairs: np.ndarray = field(metadata={"unit": ""})
    horizon_delay: np.ndarray = field(metadata={"unit": "s"})


def cylindrical_average(spectra: DelaySpectra, settings: PowerSettings, folded: bool = True) -> WedgeSpectrum:
    """Average over baselines of similar length, with equal weights for all pairs.

    Parameters
    ----------
    spectra
        Delay spectra of units.
    settings
        Width of the bins in baseline length.
    folded
        Average delays of opposite sign.
    """
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
    return WedgeSpectrum(
        baseline_length=length,
        bin_edges=np.column_stack([bins, bins + 1]) * settings.length_bin,
        k_perp=np.bincount(index, spectra.n_pairs * spectra.k_perp) / n_pairs,
        delay=delay,
        k_parallel=k_parallel,
        power=power,
        n_pairs=n_pairs,
        horizon_delay=length / constants.c.value,
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
