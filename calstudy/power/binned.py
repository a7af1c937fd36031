r"""Averages of delay spectra in bins, with their error bars.

Averages are spherical (paper Figs. SPHERICAL*) and cylindrical (paper Fig. WEDGE). Errors are those of the paper
(§Reduction: sigma_P^2 = (sigma_N + sigma_S)^2).

One mode (one baseline, one delay) of even times odd has, for Gaussian sky of power P_S and noise of power P_N,

    var Re(E* O) = P_S^2 + P_S P_N + P_N^2 / 2,

that is sigma_S = P_S without noise and sigma_N = P_N / sqrt(2), the rms of a noise-only spectrum, without signal. The
paper's sum is exact in both limits and conservative in between (sqrt(2) P_S P_N in place of P_S P_N).

Averages have fewer independent modes than modes:

- a taper and flags correlate neighbouring delays (`calstudy.power.delay.mode_correlation`); tau and -tau are
  independent;
- the n (n-1) products of different baselines of a redundant group have independent noise and the same signal:
  sigma_N falls by sqrt(n (n-1)), sigma_S not at all. The same holds for two polarizations. The product of signal and
  noise contains the noise of n baselines, and its variance falls by n;
- the signal of two baselines closer than the size of an antenna is partly the same. For a Gaussian beam with squared
  integral Omega_pp the visibilities correlate by exp(-pi Omega_pp |db|^2 / lambda^2), powers by its square;
- powers of several times have independent noise. Their signal is partly the same as long as the beams overlap:
  visibilities of a zenith that moved by theta correlate by exp(-pi theta^2 / (4 Omega_pp)), powers by its square.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from calstudy.power.delay import horizon_delay
from calstudy.power.settings import KBins, PowerSettings
from calstudy.power.spectra import (
    NEGLIGIBLE,
    CylindricalSpectrum,
    DelaySpectra,
    SphericalSpectrum,
    bins_of_k,
    length_bins,
    signal_correlation,
    sum_in_bins,
)


def noise_level(noise: DelaySpectra) -> float:
    """Return sigma_N of a single product of two baselines, in the unit of ``noise.power``, from spectra of noise only.

    It is the rms over all units and delays of the real part, scaled up by the number of products averaged in each unit.
    The noise must be white and alike on all baselines, as in the paper's simulations.
    """
    products = noise.n_pairs * noise.n_polarizations * noise.n_times
    return float(np.sqrt(np.mean(products[:, None] * noise.power.real**2)))


def noise_error(spectra: DelaySpectra, bins: np.ndarray, n_bins: int, noise: np.ndarray) -> np.ndarray:
    """Return sigma_N of each bin where the units differ in their noise, (n_bins,); NaN for empty bins.

    `noise`, (Nu,), is P_N of a single product of each unit, whose real part has the variance P_N^2 / 2.
    """
    filled = np.where(np.bincount(bins[bins >= 0], minlength=n_bins) > 0, 1.0, np.nan)
    level = np.max(noise, initial=0.0, where=np.isfinite(noise))
    if (noise == 0).all():
        return 0 * filled
    with np.errstate(divide="ignore"):
        # Units without noise count as of so little that it does not matter.
        independent = spectra.n_pairs / (np.maximum(noise, 1e-12 * level) ** 2 / 2)
        return filled / np.sqrt(product_modes(spectra, bins, n_bins, independent))


def product_modes(spectra: DelaySpectra, bins: np.ndarray, n_bins: int, independent: np.ndarray) -> np.ndarray:
    """Return the effective number of products with noise in each bin, (n_bins,) float, zero for empty bins.

    `independent` are the independent products of each polarization that a unit averages, (Nu,): its pairs for products
    of noise, its baselines for those of signal and noise. Errors fall by the square root. `bins` holds the bin of each
    mode, (Nu, Nd) int, -1 for those left out.
    """
    units = np.arange(len(spectra.n_pairs))
    samples = independent * spectra.n_polarizations * spectra.n_times
    return _effective_modes(spectra, bins, n_bins, (units, units, 1.0 / samples))


def sample_modes(spectra: DelaySpectra, bins: np.ndarray, n_bins: int) -> np.ndarray:
    """Return the number of independent modes of the signal in each bin, (n_bins,); sigma_S falls by its root."""
    first, second, correlation = signal_correlation(spectra)
    return _effective_modes(spectra, bins, n_bins, (first, second, correlation)) * spectra.independent_times


def independent_times(sidereal_times: np.ndarray, latitude: float, omega_pp: float) -> float:
    """Return the number of independent skies that an antenna pointing to the zenith sees at n sidereal times (rad).

    It is n^2 over the sum of the correlations of the powers of all times with each other. The latitude is in rad; the
    beam is taken as Gaussian, with the integral of its square `omega_pp` in sr.
    """
    apart = sidereal_times[:, None] - sidereal_times
    moved = 2 * np.arcsin(np.cos(latitude) * np.abs(np.sin(apart / 2)))
    return float(sidereal_times.size**2 / np.exp(-np.pi * moved**2 / (2 * omega_pp)).sum())


def with_errors(
    spectrum: SphericalSpectrum, noise: float = 0.0, signal: SphericalSpectrum | None = None
) -> SphericalSpectrum:
    """Return `spectrum` with its error bars, sigma_P = sigma_N + sigma_S in each bin.

    `noise` is sigma_N of a single product, from `noise_level`; zero for spectra of the signal only. `signal` is the
    spectrum of the signal only in the same bins, whose real part is the sample standard deviation of one mode; None for
    spectra of noise only.
    """
    amplitude = np.zeros(spectrum.k.size) if signal is None else np.abs(signal.power.real)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise_error = np.where(spectrum.n_modes > 0, noise / np.sqrt(spectrum.noise_modes), np.nan)
        sample_error = np.where(spectrum.n_modes > 0, amplitude / np.sqrt(spectrum.sample_modes), np.nan)
    return dataclasses.replace(spectrum, noise_error=noise_error, sample_error=sample_error)


def _effective_modes(
    spectra: DelaySpectra, bins: np.ndarray, n_bins: int, covariance: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return (sum w)^2 / sum_ij w_i w_j C_ij over modes i, j of each bin: w number of pairs, C units times delays."""
    first, second, between_units = covariance
    weights = spectra.n_pairs.astype(float)
    between_units = between_units * weights[first] * weights[second]
    between_delays = spectra.between_delays
    variance = np.zeros(n_bins)
    for lag in np.flatnonzero(between_delays > NEGLIGIBLE):
        shifted = np.roll(bins, -lag, axis=1)
        shared = (bins[first] == shifted[second]) & (bins[first] >= 0)
        # Both signs of the lag: the list of units has each pair in both orders.
        both = 1.0 if lag == 0 else 2.0
        values = np.broadcast_to((both * between_delays[lag] * between_units)[:, None], shared.shape)[shared]
        variance += np.bincount(bins[first][shared], values, minlength=n_bins)
    total = sum_in_bins(weights[:, None], bins, n_bins)
    return np.divide(total**2, variance, out=np.zeros(n_bins), where=variance > 0)


def make_bin_edges(bins: KBins) -> np.ndarray:
    """Return the edges in h/Mpc of equal bins from ``bins.min`` up to at least ``bins.max``, shape (Nk + 1,)."""
    count = int(np.ceil((bins.max - bins.min) / bins.width - 1e-9))
    return bins.min + bins.width * np.arange(count + 1)


def modes_in_bins(
    spectra: DelaySpectra, settings: PowerSettings, exclude_wedge: bool, only_wedge: bool = False
) -> np.ndarray:
    """Return the bin of |k| of each mode, (Nu, Nd) int, -1 for those left out; parameters as in `spherical_average`."""
    buffer = settings.wedge_buffer if exclude_wedge or only_wedge else None
    return bins_of_k(spectra, make_bin_edges(settings.bins), buffer, inside=only_wedge)


def spherical_average(
    spectra: DelaySpectra, settings: PowerSettings, exclude_wedge: bool, only_wedge: bool = False
) -> SphericalSpectrum:
    """Average over all modes in bins of |k|, with equal weights for all pairs of baselines, without error bars.

    `exclude_wedge` leaves out modes with |tau| <= |b|/c + buffer, `only_wedge` all others.
    """
    edges = make_bin_edges(settings.bins)
    n_bins = edges.size - 1
    bins = modes_in_bins(spectra, settings, exclude_wedge, only_wedge)
    pairs = spectra.n_pairs[:, None]
    total = sum_in_bins(pairs, bins, n_bins)
    real, imaginary = (sum_in_bins(pairs * part, bins, n_bins) for part in (spectra.power.real, spectra.power.imag))
    unknown = np.full(n_bins, np.nan)
    return SphericalSpectrum(
        k=(edges[1:] + edges[:-1]) / 2,
        bin_edges=edges,
        power=np.divide(real + 1j * imaginary, total, out=np.full(n_bins, np.nan, dtype=complex), where=total > 0),
        n_modes=np.bincount(bins[bins >= 0], minlength=n_bins),
        noise_modes=product_modes(spectra, bins, n_bins, spectra.n_pairs),
        sample_modes=sample_modes(spectra, bins, n_bins),
        cross_modes=product_modes(spectra, bins, n_bins, spectra.n_baselines),
        noise_error=unknown,
        sample_error=unknown,
        wedge_excluded=exclude_wedge,
    )


def cylindrical_average(spectra: DelaySpectra, settings: PowerSettings) -> CylindricalSpectrum:
    """Average over baselines of similar length and over +-tau, with equal weights for all pairs.

    Zero, and the extreme delay of an even number of channels, have no partner.
    """
    edges, index = length_bins(spectra.length, settings.length_bin)
    power = np.zeros((len(edges), spectra.delay.size), dtype=complex)
    np.add.at(power, index, spectra.n_pairs[:, None] * spectra.power)
    n_pairs = np.zeros(len(edges), dtype=int)
    np.add.at(n_pairs, index, spectra.n_pairs)
    length = np.bincount(index, spectra.n_pairs * spectra.length) / n_pairs
    power /= n_pairs[:, None]
    delay = spectra.delay
    step = np.abs(np.rint(delay / (delay[1] - delay[0])).astype(int))
    counts = np.bincount(step)
    folded = np.zeros((counts.size, len(power)), dtype=complex)
    np.add.at(folded, step, power.T)
    return CylindricalSpectrum(
        baseline_length=length,
        bin_edges=edges,
        k_perp=np.bincount(index, spectra.n_pairs * spectra.k_perp) / n_pairs,
        delay=np.bincount(step, np.abs(delay)) / counts,
        k_parallel=np.bincount(step, np.abs(spectra.k_parallel)) / counts,
        power=(folded / counts[:, None]).T,
        n_pairs=n_pairs,
        horizon_delay=horizon_delay(length),
    )
