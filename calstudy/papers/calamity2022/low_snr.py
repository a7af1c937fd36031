"""Claims on gain errors below the noise of a single baseline (paper §The Low Signal-to-Noise regime)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.claims.bins import SIGMAS_95, bins_at_delays, fraction_within, used_bins
from calstudy.corrupt.effects.gains import ReflectionGains
from calstudy.papers.calamity2022.calibration import FACTOR_OF_TWO
from calstudy.power.spectra import SphericalSpectrum
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, Equal, Finding, Within
from calstudy.verdicts.statement import Sentence, Source, Unevaluated

LOW_SNR = Source("The Low Signal-to-Noise regime", ("low_snr",))
SIMULATED = replace(LOW_SNR, tests_simulation=True)
WIDTH = 2
"""Half-width of the range of the reflection, in standard deviations of its delay."""
TENFOLD = Within(10**0.5, 10**1.5)
TENFOLD_WHY = "≈ 10, to half an order of magnitude"


def reflection_bins(run: Results, spectrum: SphericalSpectrum) -> np.ndarray:
    """Return the bins of k, (Nk,) bool, of the delays of the reflections; raises Unevaluated if there are none."""
    gains = run.experiment.corruption.gains
    if not isinstance(gains, ReflectionGains):
        raise Unevaluated("the gains have no reflections")
    low, high = (gains.delay + sign * WIDTH * gains.delay_scatter for sign in (-1, 1))
    return bins_at_delays(spectrum, run.wedge("noise"), low, high)


def _artefact(run: Results) -> float:
    """Return the ratio of the artefact to the noise in the average of all integrations."""
    spectrum = run.spherical("uncalibrated", "outside-wedge")
    chosen = reflection_bins(run, spectrum)
    return float(np.max(spectrum.power.real[chosen] / spectrum.noise_error[chosen]))


ARTEFACT = Sentence(
    "artefact-above-noise",
    "with no calibration, reflection artifacts exceed the thermal noise level by a factor of ≈ 10",
)


@SIMULATED.states(
    "a reflection feature is clearly visible in our uncalibrated visibilities",
    "largest P^V near 1200 ns over the standard deviation of the noise; that it exceeds it, by whatever factor",
    AtLeast(10),
    "the paper's factor, as the least",
)
def artefact_visible_above_noise(run: Results) -> Finding:
    return Finding(_artefact(run), 1.0)


@SIMULATED.states(ARTEFACT, "largest P^V near 1200 ns over the standard deviation of the noise", TENFOLD, TENFOLD_WHY)
def artefact_tenfold_above_noise(run: Results) -> Finding:
    return Finding(_artefact(run), 1.0)


@SIMULATED.states(ARTEFACT, "largest P^V near 1200 ns over the 95 % level of the noise", TENFOLD, TENFOLD_WHY)
def artefact_tenfold_above_noise_bars(run: Results) -> Finding:
    return Finding(_artefact(run) / SIGMAS_95, 1 / SIGMAS_95)


def _of_one_integration(run: Results) -> float:
    """Return the factor by which the coherent averages of blocks, and the average of their powers, reduce noise power.

    The reflections are in phase in all averaged integrations, so that their power does not change.
    """
    times = run.experiment.instrument.times
    blocks = run.experiment.power.n_blocks(times.count * times.integration, times.integration)
    return times.count / blocks**0.5


@SIMULATED.states(
    ARTEFACT,
    "largest P^V near 1200 ns over the standard deviation of the noise of a single integration, without the coherent "
    "average",
    TENFOLD,
    TENFOLD_WHY,
)
def artefact_tenfold_above_noise_of_one_integration(run: Results) -> Finding:
    return Finding(_artefact(run) / _of_one_integration(run), 1 / _of_one_integration(run))


@SIMULATED.states(
    ARTEFACT,
    "largest P^V near 1200 ns over the 95 % level of the noise of a single integration, without the coherent average",
    TENFOLD,
    TENFOLD_WHY,
)
def artefact_tenfold_above_noise_bars_of_one_integration(run: Results) -> Finding:
    unit = SIGMAS_95 * _of_one_integration(run)
    return Finding(_artefact(run) / unit, 1 / unit)


REMOVED = Sentence(
    "reflections-removed",
    "CALAMITY removes the reflection artifacts so that the residual is still consistent with noise only simulations",
)


@LOW_SNR.states(
    REMOVED, "mean P^R near 1200 ns, in standard deviations of the noise", Equal(0), "no artefact beyond the noise"
)
def artefact_removed(run: Results) -> Finding:
    spectrum = run.spherical("residual", "outside-wedge")
    chosen = reflection_bins(run, spectrum)
    error = spectrum.noise_error[chosen]
    return Finding(float(np.sum(spectrum.power.real[chosen] / error**2) / np.sqrt(np.sum(error**-2.0))), 1.0)


@LOW_SNR.states(
    REMOVED,
    "part of the bins at k >= 0.2 outside the wedge in which P^R is within 95 % of the noise",
    AtLeast(0.9),
    "95 % by chance alone; a tenth may miss",
)
def residual_consistent_with_noise(run: Results) -> Finding:
    spectrum = run.spherical("residual", "outside-wedge")
    used = used_bins(spectrum, k_min=0.2)
    return fraction_within(spectrum.power.real[used], spectrum.noise_error[used])


SINGLE = Sentence(
    "single-baseline",
    "the gain corrupted visibilities, residuals, and noise are all at a similar level for a single baseline",
)


@SIMULATED.states(SINGLE, "rms of V over that of N, delays outside the wedge; median", Within(0.5, 2), FACTOR_OF_TWO)
def data_at_noise_on_single_baseline(run: Results) -> Finding:
    found = run.measured("data_over_noise_outside")
    return Finding(found.value, found.scatter, "scatter")


@LOW_SNR.states(SINGLE, "rms of R over that of N, delays outside the wedge; median", Within(0.5, 2), FACTOR_OF_TWO)
def residual_at_noise_on_single_baseline(run: Results) -> Finding:
    found = run.measured("residual_over_noise_outside")
    return Finding(found.value, found.scatter, "scatter")
