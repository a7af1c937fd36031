"""Synthetic extragalactic radio sources that follow measured source counts."""

from __future__ import annotations

import numpy as np

# Franzen et al. (2019), 154 MHz: log10(S^2.5 dN/dS / (Jy^1.5/sr)) = Σ a_i (log10 S/Jy)^i, for 1 mJy < S < 75 Jy.
COEFFICIENTS = (3.52, 0.307, -0.388, -0.0404, 0.0351, 0.00600)
COUNTS_FREQUENCY = 154e6
FAINTEST, BRIGHTEST = 1e-3, 75.0
# GLEAM's wide band, and the mean spectral index with which the counts at 154 MHz agree with GLEAM there.
FREQUENCY = 200e6
SPECTRAL_INDEX = -0.8

FULL_SKY = 4 * np.pi
BINS_PER_DECADE = 20
POINTS_PER_BIN = 50


def differential_counts(flux: np.ndarray) -> np.ndarray:
    """Return dN/dS at 200 MHz in 1/(Jy sr) for fluxes at 200 MHz in Jy (Franzen et al. 2019, scaled by ν^-0.8)."""
    scale = (COUNTS_FREQUENCY / FREQUENCY) ** SPECTRAL_INDEX
    flux_then = np.asarray(flux, dtype=float) * scale
    return scale * 10 ** np.polyval(COEFFICIENTS[::-1], np.log10(flux_then)) * flux_then**-2.5


def expected_sources(faint: float, bright: float = BRIGHTEST) -> float:
    """Return the expected number of sources on the whole sky between two fluxes at 200 MHz, in Jy."""
    edges = np.geomspace(faint, max(bright, faint), 500)
    return float(FULL_SKY * np.trapezoid(differential_counts(edges), edges))


def draw_population(faint: float, bright: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw an all-sky, isotropic population of sources between two fluxes at 200 MHz in Jy.

    Return right ascension and declination in radians and flux at 200 MHz in Jy, (Nsources,) each. The counts are
    measured from 0.81 mJy to 61 Jy at this frequency. Every bin of flux has its own random stream, so that the bright
    sources do not depend on the faint limit.
    """
    from scipy.integrate import cumulative_trapezoid

    lowest, highest = (int(np.floor(np.log10(flux) * BINS_PER_DECADE)) for flux in (faint, bright))
    parts = []
    for number in range(lowest, highest + 1):
        edges = 10.0 ** np.linspace(number / BINS_PER_DECADE, (number + 1) / BINS_PER_DECADE, POINTS_PER_BIN + 1)
        cumulative = cumulative_trapezoid(differential_counts(edges), edges, initial=0.0) * FULL_SKY
        # A spawn key must not be negative, but the numbers of bins below 1 Jy are.
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number + 1000,)))
        drawn = generator.uniform(0, cumulative[-1], generator.poisson(cumulative[-1]))
        flux = np.interp(drawn, cumulative, edges)
        right_ascension = generator.uniform(0, 2 * np.pi, len(flux))
        declination = np.arcsin(generator.uniform(-1, 1, len(flux)))
        kept = (flux >= faint) & (flux < bright)
        parts.append((right_ascension[kept], declination[kept], flux[kept]))
    right_ascension, declination, flux = (np.concatenate(column) for column in zip(*parts, strict=True))
    return right_ascension, declination, flux
