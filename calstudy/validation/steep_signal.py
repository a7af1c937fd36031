r"""Step 0.2: a steep P(k), which the taper's window mixes.

A delay spectrum at tau estimates the mean of P over k_par, weighted with the window |T~(tau - tau')|^2 of the taper T:

    E P^(tau) = sum_tau' |T~(tau - tau')|^2 P(sqrt(k_perp^2 + k_par(tau')^2)) / sum_tau' |T~|^2,

over the delays that the channels hold (the simulated sky has no others). The spread of k_perp by the beam is left out:
beyond 0.3 h/Mpc it changes k in second order. Only baselines within the resolution of the map enter.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.constants import speed_of_light

from calstudy.power.delay import make_taper
from calstudy.power.spectra import DelaySpectra
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.signal import clustered_mean, pooled

FINE = 8
"""Points of the integral over delays per delay of the spectrum."""
MARGIN = 60
"""Multipoles by which the beam spreads a baseline's."""
BANDS = (0.3, 0.5, 1.0, np.inf)


def measure(evidence: Evidence) -> Measurement:
    """Return the mean of P^ over its expectation beyond `parameters["k_min"]`, all together and band by band."""
    k_min = evidence.parameters["k_min"]
    whole, bands = [], {band: [] for band in itertools.pairwise(BANDS)}
    for name, sections in evidence.experiments.items():
        spectra = evidence.spectra(name, "eor")

        def power(k: np.ndarray, name: str = name) -> np.ndarray:
            return evidence.input_power(name, k)

        relative = spectra.power.real / windowed(power, spectra)
        resolved = 2 * np.pi * spectra.length * spectra.frequency / speed_of_light + MARGIN
        relative[resolved > 3 * sections["sky"]["eor"]["nside"] - 1] = np.nan
        k = np.hypot(spectra.k_perp[:, None], spectra.k_parallel)
        whole.append(clustered_mean(np.where(k > k_min, relative, np.nan)))
        for low, high in bands:
            bands[low, high].append(clustered_mean(np.where((k > low) & (k <= high), relative, np.nan)))
    parts = {band: pooled(found) for band, found in bands.items() if all(np.isfinite(item.value) for item in found)}
    remarks = tuple(
        f"k from {low:g} to {high:g} h/Mpc: {found.value:.4f} ± {found.uncertainty:.4f}"
        for (low, high), found in parts.items()
    )
    lowest = next(iter(parts.values()))
    return Measurement({"normalization": pooled(whole), "lowest_band": lowest}, remarks)


def windowed(power, spectra: DelaySpectra) -> np.ndarray:
    """Return the expected estimates of `power` (a function of k in h/Mpc), (Nu, Nd), as in the module's text."""
    count = spectra.delay.size
    # Columns run through the delays in the order of the spectrum, each divided into FINE.
    offsets = (np.arange(FINE) - (FINE - 1) / 2) / FINE
    cells = (np.arange(count) - count // 2)[:, None] + offsets
    step = spectra.k_parallel[1] - spectra.k_parallel[0]
    k_parallel = cells * step
    expected = np.zeros((len(spectra.k_perp), count))
    for column, offset in enumerate(offsets):
        values = power(np.hypot(spectra.k_perp[:, None], k_parallel[:, column]))
        # A wave between two delays reaches the delay m of the transform with this weight.
        waves = make_taper(spectra.taper, count) * np.exp(2j * np.pi * offset * np.arange(count) / count)
        weights = np.abs(np.fft.fft(waves)) ** 2
        expected += np.fft.ifft(np.fft.fft(values, axis=1) * np.fft.fft(weights), axis=1).real / weights.sum()
    return expected / FINE
