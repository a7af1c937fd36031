"""Claims on gain errors below the noise of a single baseline (paper §The Low Signal-to-Noise regime)."""

from __future__ import annotations

import numpy as np

from calstudy.claims.bins import SIGMAS_95, fraction_within, used_bins
from calstudy.claims.calibration import FACTOR_OF_TWO
from calstudy.claims.statement import Above, Consistent, Finding, Source, Within
from calstudy.claims.study import Study, Unevaluated
from calstudy.power.spherical import SphericalSpectrum

LOW_SNR = Source("The Low Signal-to-Noise regime", ("low_snr",))
WIDTH = 2
"""The reflection is looked for within this many standard deviations of its mean delay."""
TENFOLD = Within(10**0.5, 10**1.5)
TENFOLD_WHY = "≈ 10, to half an order of magnitude"


def reflection_bins(study: Study, spectrum: SphericalSpectrum) -> np.ndarray:
    """Return the bins of k, (Nk,) bool, that the delays of the reflections fall into; raises Unevaluated if none."""
    gains = study.corruption.gains
    middle, half = gains.delay, WIDTH * gains.delay_scatter
    wedge = study.wedge("noise")
    per_second = wedge.k_parallel[-1] / wedge.delay[-1]
    low, high = ((middle + sign * half) * per_second for sign in (-1, 1))
    chosen = (spectrum.bin_edges[1:] > low) & (spectrum.bin_edges[:-1] < high) & used_bins(spectrum)
    if not chosen.any():
        raise Unevaluated("no modes at the delays of the reflections")
    return chosen


def _artefact(study: Study) -> float:
    spectrum = study.spherical("uncalibrated", "outside-wedge")
    chosen = reflection_bins(study, spectrum)
    return float(np.max(spectrum.power.real[chosen] / spectrum.noise_error[chosen]))


ARTEFACT = "with no calibration, reflection artifacts exceed the thermal noise level by a factor of ≈ 10"


@LOW_SNR.states(
    "a reflection feature is clearly visible in our uncalibrated visibilities",
    "largest P^V near 1200 ns over the standard deviation of the noise; that it exceeds it, by whatever factor",
    Above(10),
    "the paper's factor, as the least",
)
def artefact_visible_above_noise(study: Study) -> Finding:
    return Finding(_artefact(study), 1.0)


@LOW_SNR.states(ARTEFACT, "largest P^V near 1200 ns over the standard deviation of the noise", TENFOLD, TENFOLD_WHY)
def artefact_tenfold_above_noise(study: Study) -> Finding:
    return Finding(_artefact(study), 1.0)


@LOW_SNR.states(ARTEFACT, "largest P^V near 1200 ns over the 95 % level of the noise", TENFOLD, TENFOLD_WHY)
def artefact_tenfold_above_noise_bars(study: Study) -> Finding:
    return Finding(_artefact(study) / SIGMAS_95, 1 / SIGMAS_95)


REMOVED = (
    "CALAMITY removes the reflection artifacts so that the residual is still consistent with noise only simulations"
)


@LOW_SNR.states(
    REMOVED, "mean P^R near 1200 ns, in standard deviations of the noise", Consistent(0), "no artefact beyond the noise"
)
def artefact_removed(study: Study) -> Finding:
    spectrum = study.spherical("residual", "outside-wedge")
    chosen = reflection_bins(study, spectrum)
    error = spectrum.noise_error[chosen]
    return Finding(float(np.sum(spectrum.power.real[chosen] / error**2) / np.sqrt(np.sum(error**-2.0))), 1.0)


@LOW_SNR.states(
    REMOVED,
    "part of the bins at k >= 0.2 outside the wedge in which P^R is within 95 % of the noise",
    Above(0.9),
    "95 % by chance alone; a tenth may miss",
)
def residual_consistent_with_noise(study: Study) -> Finding:
    spectrum = study.spherical("residual", "outside-wedge")
    used = used_bins(spectrum, k_min=0.2)
    return fraction_within(spectrum.power.real[used], spectrum.noise_error[used])


SINGLE = "the gain corrupted visibilities, residuals, and noise are all at a similar level for a single baseline"


@LOW_SNR.states(SINGLE, "rms of V over that of N, delays outside the wedge; median", Within(0.5, 2), FACTOR_OF_TWO)
def data_at_noise_on_single_baseline(study: Study) -> Finding:
    found = study.measured("data_over_noise_outside")
    return Finding(found.value, found.scatter)


@LOW_SNR.states(SINGLE, "rms of R over that of N, delays outside the wedge; median", Within(0.5, 2), FACTOR_OF_TWO)
def residual_at_noise_on_single_baseline(study: Study) -> Finding:
    found = study.measured("residual_over_noise_outside")
    return Finding(found.value, found.scatter)
