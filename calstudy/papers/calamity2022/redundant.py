"""Claims on the redundant array, and on reflections in noise (paper §Performance on a Redundant Array, §Low SNR)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.claims import bins
from calstudy.claims.realizations import PooledResults, of_one_draw, over_realizations
from calstudy.papers.calamity2022.calibration import TWOFOLD, median
from calstudy.papers.calamity2022.window import ONE_DRAW, TENTH, UNBIASED, agreement
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding, Within
from calstudy.verdicts.statement import Sentence, Source, Unevaluated

REDUNDANT = Source("Performance on a Redundant Array", ("minimally_redundant", "redundant"))
SIMULATED = replace(REDUNDANT, tests_simulation=True)
K_MIN = 0.2
K_LOSS = 0.3
"""Wavenumber up to which the paper sees more loss for the redundant array, h/Mpc."""
NO_EFFECT = 0.05
HIGHER = (AtLeast(0, 2), "higher beyond the errors")


def _lower(name: str, first: Results, second: Results) -> Finding:
    """Return rms P of a variant in the first run over that in the second, outside the wedge, k >= 0.2."""
    spectra = [run.spherical(name, "outside-wedge") for run in (first, second)]
    used = bins.used_bins(*spectra, k_min=K_MIN)
    return bins.ratio(*(bins.rms_power(spectrum, used) for spectrum in spectra))


SUPPRESSED = Sentence(
    "errors-suppressed", "our redundant array suppresses calibration errors by one-to-two orders of magnitude"
)


@SIMULATED.states(
    SUPPRESSED,
    "median P^V of the minimally redundant array over that of the redundant one, outside the wedge, k >= 0.2; "
    "uncalibrated",
    AtLeast(10),
    "one order of magnitude at least",
)
def uncalibrated_systematics_suppressed(minimal: Results, redundant: Results) -> Finding:
    spectra = [run.spherical("uncalibrated", "outside-wedge") for run in (minimal, redundant)]
    used = bins.used_bins(*spectra, k_min=K_MIN)
    first, second = (np.abs(spectrum.power.real[used]) for spectrum in spectra)
    scatter = np.std(np.log(first / second)) / np.sqrt(used.sum())
    value = float(np.median(first) / np.median(second))
    return Finding(value, value * 1.25 * float(scatter))


@REDUNDANT.states(
    SUPPRESSED,
    "rms P^R without EoR (what calibration leaves behind, and noise) of the minimally redundant array over that of the "
    "redundant one, outside the wedge, k >= 0.2",
    AtLeast(10),
    "one order of magnitude at least",
)
def calibrated_systematics_suppressed(minimal: Results, redundant: Results) -> Finding:
    spectra = [run.spherical("residual_without_eor", "outside-wedge") for run in (minimal, redundant)]
    used = bins.used_bins(*spectra, k_min=K_MIN)
    return bins.ratio(*(bins.rms_without_eor(run, used) for run in (minimal, redundant)))


@SIMULATED.states(
    "the noise-only power spectrum is also significantly reduced",
    "rms P^N of the minimally redundant array over that of the redundant one, outside the wedge, k >= 0.2",
    AtLeast(1, 2),
    "reduced beyond the errors",
)
def noise_reduced(minimal: Results, redundant: Results) -> Finding:
    return _lower("noise", minimal, redundant)


HIGHER_LOSS = Sentence(
    "recovered-with-higher-loss",
    "CALAMITY is able to recover 21 cm fluctuations for the redundant case, albeit with higher signal loss (compare "
    "the regions below ≲ 0.3 h/Mpc)",
)


@REDUNDANT.states(
    HIGHER_LOSS,
    "part of the bins at k >= 0.3 outside the wedge in which P^R is within the 95 % errors of P^S",
    AtLeast(0.9),
    "95 % by chance alone; as for the minimally redundant array a tenth may miss",
    roles=("redundant",),
)
def redundant_signal_recovered(redundant: Results) -> Finding:
    return agreement(redundant, K_LOSS)


@REDUNDANT.states(
    UNBIASED,
    "mean P^R/P^S of the redundant array outside the wedge at k >= 0.3",
    *TENTH,
    roles=("redundant",),
    pooled=over_realizations("ratio", "outside-wedge", K_LOSS),
)
def redundant_residual_relatively_unbiased(redundant: Results) -> Finding:
    return bins.recovered_outside_wedge(redundant, K_LOSS)


@REDUNDANT.states(
    HIGHER_LOSS,
    "C s, the fraction of the EoR that is left, of the minimally redundant array minus that of the redundant one, bin "
    "by bin, outside the wedge, k < 0.3",
    *HIGHER,
)
def less_of_the_eor_below_0p3(minimal: Results, redundant: Results) -> Finding:
    first, second = (run.transfer("outside-wedge") for run in (minimal, redundant))
    difference = first.flux_scale * first.cross_transfer - second.flux_scale * second.cross_transfer
    error = np.hypot(first.flux_scale * first.cross_transfer_error, second.flux_scale * second.cross_transfer_error)
    below = first.k < K_LOSS - bins.TINY
    return bins.mean_of_common_errors(difference[below], error[below])


@REDUNDANT.states(
    HIGHER_LOSS,
    "T free of the flux scale of the minimally redundant array minus that of the redundant one, bin by bin, outside "
    "the wedge, k < 0.3",
    *HIGHER,
)
def more_loss_of_power_below_0p3(minimal: Results, redundant: Results) -> Finding:
    return bins.difference_of_losses(minimal, redundant, 0.0, K_LOSS - bins.TINY)


@REDUNDANT.states(
    "fewer independent realizations are averaged down in each gain solution, which increases signal loss on all scales",
    "T free of the flux scale of the minimally redundant array minus that of the redundant one, bin by bin, outside "
    "the wedge, k >= 0.3",
    *HIGHER,
)
def more_loss_on_all_scales_without_flux_scale(minimal: Results, redundant: Results) -> Finding:
    return bins.difference_of_losses(minimal, redundant, K_LOSS)


def _longer_extent(minimal: PooledResults, redundant: PooledResults) -> Finding:
    first, second = (run.bias_extents("outside-wedge") for run in (minimal, redundant))
    if first.shape != second.shape:
        raise Unevaluated("the arrays have different realizations")
    return of_one_draw(second - first)


@REDUNDANT.states(
    "the residual in our redundant array has a negative bias at larger k than the minimally redundant array",
    "difference in h/Mpc of the k up to which P^R < P^S beyond 95 % errors, outside the wedge; ± is the scatter of "
    "draws",
    AtLeast(0, 2),
    "larger beyond that scatter",
    pooled=_longer_extent,
)
def bias_reaches_larger_k(minimal: Results, redundant: Results) -> Finding:
    raise Unevaluated(ONE_DRAW)


SAME = Sentence("same-residual", "we get roughly the same residual when calibrating with redundant modeling")


@REDUNDANT.states(
    SAME,
    "rms R over N outside the wedge with one model per group over that with one per baseline; median",
    *TWOFOLD,
    roles=("redundant", "redundant_modelling"),
)
def redundant_modelling_same_visibilities(redundant: Results, modelling: Results) -> Finding:
    per_baseline, per_group = (run.measured("residual_over_noise_outside") for run in (redundant, modelling))
    found = bins.ratio(Finding(per_group.value, per_group.scatter), Finding(per_baseline.value, per_baseline.scatter))
    return found._replace(kind="scatter")


@REDUNDANT.states(
    SAME,
    "rms P^R with one model per group over that with one per baseline, outside the wedge, k >= 0.2",
    *TWOFOLD,
    roles=("redundant", "redundant_modelling"),
)
def redundant_modelling_same_power(redundant: Results, modelling: Results) -> Finding:
    return _lower("residual", modelling, redundant)


@REDUNDANT.states(
    "when we use multiple foreground coefficients within a truly redundant group, we are simply adding repeated copies "
    "of the same set of parameters which has no effect on our final answer",
    "T free of the flux scale with one model per group minus that with one per baseline, outside the wedge, k < 0.3",
    Within(-NO_EFFECT, NO_EFFECT),
    "no effect, to a twentieth of the EoR",
    roles=("redundant", "redundant_modelling"),
)
def redundant_modelling_loses_the_same(redundant: Results, modelling: Results) -> Finding:
    return bins.difference_of_losses(modelling, redundant, 0.0, K_LOSS - bins.TINY)


LOW_SNR = Source("The Low Signal-to-Noise regime", ("low_snr",))
REFLECTED = replace(LOW_SNR, tests_simulation=True)
TENFOLD = (Within(10**0.5, 10**1.5), "≈ 10, to half an order of magnitude")


def _artefact(run: Results) -> float:
    """Return the ratio of the artefact to the noise in the average of all integrations."""
    spectrum = run.spherical("uncalibrated", "outside-wedge")
    chosen = bins.reflection_bins(run, run.experiment, spectrum)
    return float(np.max(spectrum.power.real[chosen] / spectrum.noise_error[chosen]))


ARTEFACT = Sentence(
    "artefact-above-noise",
    "with no calibration, reflection artifacts exceed the thermal noise level by a factor of ≈ 10",
)


@REFLECTED.states(
    "a reflection feature is clearly visible in our uncalibrated visibilities",
    "largest P^V near 1200 ns over the standard deviation of the noise; that it exceeds it, by whatever factor",
    AtLeast(10),
    "the paper's factor, as the least",
)
def artefact_visible_above_noise(run: Results) -> Finding:
    return Finding(_artefact(run), 1.0)


@REFLECTED.states(ARTEFACT, "largest P^V near 1200 ns over the standard deviation of the noise", *TENFOLD)
def artefact_tenfold_above_noise(run: Results) -> Finding:
    return Finding(_artefact(run), 1.0)


@REFLECTED.states(ARTEFACT, "largest P^V near 1200 ns over the 95 % level of the noise", *TENFOLD)
def artefact_tenfold_above_noise_bars(run: Results) -> Finding:
    return Finding(_artefact(run) / SIGMAS_95, 1 / SIGMAS_95)


def _of_one_integration(run: Results) -> float:
    """Return the factor by which the coherent averages of blocks, and the average of their powers, reduce noise power.

    The reflections are in phase in all averaged integrations, so that their power does not change.
    """
    times = run.experiment.instrument.times
    blocks = run.experiment.power.n_blocks(times.count * times.integration, times.integration)
    return times.count / blocks**0.5


@REFLECTED.states(
    ARTEFACT,
    "largest P^V near 1200 ns over the standard deviation of the noise of a single integration, without the coherent "
    "average",
    *TENFOLD,
)
def artefact_tenfold_above_noise_of_one_integration(run: Results) -> Finding:
    return Finding(_artefact(run) / _of_one_integration(run), 1 / _of_one_integration(run))


@REFLECTED.states(
    ARTEFACT,
    "largest P^V near 1200 ns over the 95 % level of the noise of a single integration, without the coherent average",
    *TENFOLD,
)
def artefact_tenfold_above_noise_bars_of_one_integration(run: Results) -> Finding:
    unit = SIGMAS_95 * _of_one_integration(run)
    return Finding(_artefact(run) / unit, 1 / unit)


REMOVED = Sentence(
    "reflections-removed",
    "CALAMITY removes the reflection artifacts so that the residual is still consistent with noise only simulations",
)


@LOW_SNR.states(
    REMOVED,
    "mean P^R near 1200 ns over mean P^V there",
    AtMost(10**-0.5),
    "removed is an order of magnitude at least, to half an order",
)
def artefact_removed(run: Results) -> Finding:
    artefact, left, sigma = bins.at_reflections(run, run.experiment, "residual")
    if artefact < bins.SEEN * sigma:
        raise Unevaluated("there is no artefact before the calibration that could be removed")
    return Finding(left / artefact, sigma / artefact)


@LOW_SNR.states(
    REMOVED,
    "part of the bins at k >= 0.2 outside the wedge in which P^R is within 95 % of the noise",
    AtLeast(0.9),
    "95 % by chance alone; a tenth may miss",
)
def residual_consistent_with_noise(run: Results) -> Finding:
    used, (spectrum,) = bins.outside_wedge(run, "residual", k_min=K_MIN)
    return bins.fraction_within(spectrum.power.real[used], spectrum.noise_error[used])


SINGLE = Sentence(
    "single-baseline",
    "the gain corrupted visibilities, residuals, and noise are all at a similar level for a single baseline",
)


@REFLECTED.states(SINGLE, "rms of V over that of N, delays outside the wedge; median", *TWOFOLD)
def data_at_noise_on_single_baseline(run: Results) -> Finding:
    return median(run, "data_over_noise_outside")


@LOW_SNR.states(SINGLE, "rms of R over that of N, delays outside the wedge; median", *TWOFOLD)
def residual_at_noise_on_single_baseline(run: Results) -> Finding:
    return median(run, "residual_over_noise_outside")
