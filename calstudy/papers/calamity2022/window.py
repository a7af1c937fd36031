"""Claims on the wedge and the spherical power spectra of the minimally redundant array (paper §Simulation Results)."""

from __future__ import annotations

import numpy as np

from calstudy.claims import bins
from calstudy.claims.realizations import PooledResults, of_one_draw, over_realizations
from calstudy.papers.calamity2022.calibration import FACTOR_OF_TWO, RESULTS, SIMULATED, TWOFOLD
from calstudy.power.spectra import CylindricalSpectrum
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding, Within
from calstudy.verdicts.statement import Sentence, Unevaluated

K_AGREEMENT = 0.2
"""Wavenumber beyond which the paper's P^R agrees with P^S, h/Mpc."""
K_BIAS = 0.25
K_SMALL = 0.5
"""The paper's 'small k values', h/Mpc, where there is signal and not only noise."""


def window(run: Results, wedge: CylindricalSpectrum) -> np.ndarray:
    """Return which modes are beyond the wedge of the longest baseline of each bin of lengths, (Nb, Nd) bool."""
    chosen = bins.beyond_wedge(wedge.delay, wedge.bin_edges[:, 1], run.experiment.power.wedge_buffer)
    if not chosen.any():
        raise Unevaluated("no delays outside the wedge")
    return chosen


def _rows(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the median of |values| over the chosen delays of each bin of lengths that has any."""
    return np.array([np.median(np.abs(row[mask])) for row, mask in zip(values, chosen, strict=True) if mask.any()])


def _row_ratio(run: Results, above: str, below: tuple[str, ...]) -> Finding:
    """Return the ratio of medians over the window, median and scatter over the bins of lengths."""
    upper = run.wedge(above)
    chosen = window(run, upper)
    total = sum(_rows(run.wedge(name).power.real, chosen) for name in below)
    return bins.median_and_scatter(_rows(upper.power.real, chosen) / total)


FILLED = Sentence("window-filled", "the entire EoR window is filled in with systematics")


@SIMULATED.states(
    "in our simulated visibilities without calibration errors, foreground power is contained within the wedge",
    "|P^{S+N+F}| in the window over |P^S| + |P^N|; medians",
    AtMost(2),
    "what is not contained adds to EoR and noise; " + FACTOR_OF_TWO,
)
def foregrounds_contained(run: Results) -> Finding:
    return _row_ratio(run, "uncorrupted", ("eor", "noise"))


@SIMULATED.states(
    FILLED,
    "part of the window in which P^V exceeds P^S",
    AtLeast(0.95),
    "the entire window, but for chance crossings of zero",
)
def leakage_fills_window(run: Results) -> Finding:
    upper, signal = run.wedge("uncalibrated"), run.wedge("eor")
    chosen = window(run, upper)
    above = (np.abs(upper.power.real) > np.abs(signal.power.real))[chosen]
    return Finding(float(above.mean()), float(np.sqrt(above.mean() * (1 - above.mean()) / above.size)))


@SIMULATED.states(
    FILLED,
    "|P^V| in the window over |P^S|; medians",
    AtLeast(100),
    "systematics orders of magnitude above the signal: two at least",
)
def leakage_far_above_signal(run: Results) -> Finding:
    return _row_ratio(run, "uncalibrated", ("eor",))


REMOVED = Sentence(
    "systematics-removed",
    "after running CALAMITY, these systematics are effectively removed, and over most cylindrical modes, these "
    "residuals are roughly consistent with the injected EoR signal level",
)


@RESULTS.states(
    REMOVED,
    "|P^V| in the window over |P^R|; medians",
    AtLeast(100),
    "what is effectively removed is lower by two orders of magnitude at least",
)
def systematics_removed_from_window(run: Results) -> Finding:
    return _row_ratio(run, "uncalibrated", ("residual",))


@SIMULATED.states(
    "clear positive and negative fluctuations arising from noise",
    "part of the window in which P^N is negative",
    Within(0.4, 0.6),
    "the product of independent noise has no preferred sign",
)
def noise_has_both_signs(run: Results) -> Finding:
    noise = run.wedge("noise")
    negative = noise.power.real[window(run, noise)] < 0
    return Finding(float(negative.mean()), float(0.5 / np.sqrt(negative.size)))


@RESULTS.states(
    REMOVED,
    "part of the window in which the mean P^R over the delays of each bin of lengths is within a factor of two of that "
    "of P^S",
    AtLeast(0.5),
    "most is more than half, and roughly a factor of two",
)
def calibrated_window_consistent(run: Results) -> Finding:
    residual, signal = (run.wedge(name) for name in ("residual", "eor"))
    chosen = window(run, residual)
    rows = chosen.any(axis=1)
    # The noise of a single mode is as large as the EoR, and would hide a loss of most of it.
    above, below = (np.sum(item.power.real, axis=1, where=chosen)[rows] for item in (residual, signal))
    near = (above > below / 2) & (above < 2 * below)
    return Finding(float(np.average(near, weights=chosen.sum(axis=1)[rows])), float(0.5 / np.sqrt(near.size)))


def agreement(run: Results, k_min: float) -> Finding:
    """Return the part of the bins from `k_min` (h/Mpc) outside the wedge in which P^R is within 95 % errors of P^S."""
    used, (residual, signal) = bins.outside_wedge(run, "residual", "eor", k_min=k_min)
    power, eor, error = residual.power.real[used], signal.power.real[used], residual.error[used]
    found, on_scale = (bins.fraction_within(scale * power - eor, error) for scale in (1.0, run.score.flux_scale**2))
    # All bins share the flux scale, which differs between draws.
    return found._replace(uncertainty=float(np.hypot(found.uncertainty, found.value - on_scale.value)))


BROAD = Sentence(
    "broad-agreement",
    "P^R is in broad agreement with P^S beyond k ≳ 0.2 h/Mpc when we only average modes outside of the wedge",
)
UNBIASED = Sentence(
    "relatively-unbiased",
    "in both scenarios, it recovers relatively unbiased estimates of the power spectrum within the EoR window "
    "(Conclusion)",
)
TENTH = (Within(0.9, 1.1), "relatively unbiased: to a tenth")


@RESULTS.states(
    BROAD,
    "part of the bins at k >= 0.2 in which P^R is within the 95 % errors of P^S",
    AtLeast(0.9),
    "95 % by chance alone; broad agreement may miss a tenth",
)
def residual_agrees_outside_wedge(run: Results) -> Finding:
    return agreement(run, K_AGREEMENT)


@RESULTS.states(
    BROAD,
    "mean P^R/P^S outside the wedge at k >= 0.2",
    *TWOFOLD,
    pooled=over_realizations("ratio", "outside-wedge", K_AGREEMENT),
)
def residual_level_outside_wedge(run: Results) -> Finding:
    return bins.recovered_outside_wedge(run, K_AGREEMENT)


@RESULTS.states(
    UNBIASED,
    "mean P^R/P^S outside the wedge at k >= 0.2",
    *TENTH,
    pooled=over_realizations("ratio", "outside-wedge", K_AGREEMENT),
)
def residual_relatively_unbiased_outside_wedge(run: Results) -> Finding:
    return bins.recovered_outside_wedge(run, K_AGREEMENT)


ONE_DRAW = "where a bias ends differs between draws by some bins; needs realizations"
BIAS = "when we include modes inside of the wedge, we encounter negative bias out to ≈ 0.3 h/Mpc"
BIAS_CAPTION = Sentence("biased-below-0p25", "our calibrated residual is biased below k ≲ 0.25 h/Mpc")


@RESULTS.states(
    BIAS_CAPTION,
    "mean P^R/P^S of all modes at k <= 0.25",
    AtMost(1, 2),
    "a bias beyond the errors",
    pooled=over_realizations("ratio", "all-modes", 0.0, K_BIAS),
)
def residual_biased_with_wedge(run: Results) -> Finding:
    return bins.recovered(run.spherical("residual", "all-modes"), run.spherical("eor", "all-modes"), 0.0, K_BIAS)


def _extent_with_wedge(run: PooledResults) -> Finding:
    return of_one_draw(run.bias_extents("all-modes"))


@RESULTS.states(
    BIAS,
    "k in h/Mpc up to which P^R < P^S beyond 95 % errors, all modes; reading of the text; ± is the scatter of draws",
    Within(0.2, 0.4),
    "≈ 0.3, within 0.1",
    pooled=_extent_with_wedge,
)
def bias_with_wedge_ends_near_0p3(run: Results) -> Finding:
    raise Unevaluated(ONE_DRAW)


@RESULTS.states(
    BIAS_CAPTION,
    "k in h/Mpc up to which P^R < P^S beyond 95 % errors, all modes; reading of the caption; ± is the scatter of draws",
    Within(0.21, 0.29),
    "0.25, within one bin: without a bias there is no end of it",
    pooled=_extent_with_wedge,
)
def bias_with_wedge_ends_below_0p25(run: Results) -> Finding:
    raise Unevaluated(ONE_DRAW)


NOISE_ONLY = Sentence(
    "residual-without-eor",
    "calibration residuals [without EoR] are an order of magnitude lower than the EoR, at a similar level to the noise "
    "only simulations, and ≈ 90 dB below the level of the foregrounds in the power-spectrum domain",
)


def _without_eor(run: Results) -> Finding:
    used, (_, signal) = bins.outside_wedge(run, "residual_without_eor", "eor", k_min=K_AGREEMENT)
    return bins.ratio(bins.rms_without_eor(run, used), Finding(float(np.mean(signal.power.real[used])), 0.0))


@RESULTS.states(
    NOISE_ONLY, "rms P^R without EoR over mean P^S, outside the wedge, k >= 0.2", AtMost(0.1), "an order of magnitude"
)
def residual_without_eor_tenfold_lower(run: Results) -> Finding:
    return _without_eor(run)


@RESULTS.states(
    NOISE_ONLY,
    "rms P^R without EoR over mean P^S, outside the wedge, k >= 0.2; looser reading",
    AtMost(10**-0.5),
    "an order of magnitude, to half an order",
)
def residual_without_eor_lower_within_half_an_order(run: Results) -> Finding:
    return _without_eor(run)


@RESULTS.states(
    NOISE_ONLY,
    "rms of P^R without EoR, in units of its noise error, over the same of P^N; outside the wedge, k >= 0.2",
    *TWOFOLD,
)
def residual_without_eor_at_noise(run: Results) -> Finding:
    used, (residual, noise) = bins.outside_wedge(run, "residual_without_eor", "noise", k_min=K_AGREEMENT)
    of_noise = float(np.sqrt(np.mean((noise.power.real / noise.noise_error)[used] ** 2)))
    left = bins.rms_without_eor(run, used, residual.noise_error[used])
    return bins.ratio(left, Finding(of_noise, of_noise / np.sqrt(2 * used.sum())))


@RESULTS.states(
    NOISE_ONLY,
    "rms P^R without EoR (outside the wedge, k >= 0.2) over the largest P^{S+F+N} of all modes, in dB; "
    "at least as far below",
    AtMost(-85),
    "≈ 90 dB, to half an order of magnitude; lower is better",
)
def residual_without_eor_90_db_below_foregrounds(run: Results) -> Finding:
    return _below_foregrounds(run)


@RESULTS.states(
    NOISE_ONLY,
    "rms P^R without EoR (outside the wedge, k >= 0.2) over the largest P^{S+F+N} of all modes, in dB; neither "
    "less nor more",
    Within(-95, -85),
    "≈ 90 dB, to half an order of magnitude",
)
def residual_without_eor_neither_more_nor_less_than_90_db_below(run: Results) -> Finding:
    return _below_foregrounds(run)


def _below_foregrounds(run: Results) -> Finding:
    used, _ = bins.outside_wedge(run, "residual_without_eor", k_min=K_AGREEMENT)
    found = bins.rms_without_eor(run, used)
    highest = float(np.nanmax(run.spherical("uncorrupted", "all-modes").power.real))
    return Finding(10 * np.log10(found.value / highest), 10 / np.log(10) * found.uncertainty / found.value)


POSITIVE = Sentence(
    "positive-bias",
    "our noise residuals show a slight positive bias that is at roughly the same level as the thermal noise at small k",
)


def _over_eor(run: Results, k_min: float, k_max: float, by_noise: bool = False) -> Finding:
    """Return the mean over bins of P^R without EoR, perhaps weighted `by_noise` variances, over that of P^S."""
    used, (residual, signal) = bins.outside_wedge(run, "residual_without_eor", "eor", k_min=k_min, k_max=k_max)
    level = float(np.mean(signal.power.real[used]))
    weights = residual.noise_error[used] ** -2.0 if by_noise else np.ones(used.sum())
    left = bins.power_without_eor(run, used, weights)
    return Finding(left.value / level, left.uncertainty / level)


@RESULTS.states(
    POSITIVE,
    "mean P^R without EoR at k <= 0.5 outside the wedge, in units of P^S; the run's own solver",
    AtLeast(0, 2),
    "positive beyond the errors",
    pooled=over_realizations("bias", "outside-wedge", 0.0, K_SMALL),
)
def positive_bias_at_small_k(run: Results) -> Finding:
    return _over_eor(run, 0.0, K_SMALL, by_noise=True)


@RESULTS.states(
    POSITIVE,
    "mean P^R without EoR at k <= 0.5 outside the wedge, in units of P^S; the paper's solver",
    AtLeast(0, 2),
    "positive beyond the errors",
    roles=("paper_solver",),
)
def positive_bias_at_small_k_with_papers_solver(run: Results) -> Finding:
    return _over_eor(run, 0.0, K_SMALL, by_noise=True)


TAPERED = Sentence(
    "better-than-taper",
    "our residual does significantly better than a tapered estimator, contaminated by Blackman-Harris sidelobes",
)


@RESULTS.states(
    TAPERED,
    "rms of P^{S+F+N} - P^S over that of P^R - P^S in dB, outside the wedge, k <= 0.25",
    AtLeast(0, 2),
    "better beyond the errors",
)
def residual_beats_taper_outside_wedge(run: Results) -> Finding:
    # With the modes of the wedge the tapered estimator has the foregrounds themselves, which any calibration beats.
    used, (tapered, residual, signal) = bins.outside_wedge(run, "uncorrupted", "residual", "eor", k_max=K_BIAS)
    errors = [np.sqrt(np.mean((item.power - signal.power).real[used] ** 2)) for item in (tapered, residual)]
    # The ratio of few bins is uncertain by a factor, so that errors are symmetric in dB.
    return Finding(float(10 * np.log10(errors[0] / errors[1])), float(10 / np.log(10) / np.sqrt(used.sum())))


SLIGHT = "a slight bias is lower than the EoR; so is none"


def _above(k: float) -> float:
    """Return the lowest wavenumber above this one, because a bin belongs to one band only."""
    return float(np.nextafter(k, np.inf))


def _over_noise(run: Results, k_min: float, k_max: float) -> Finding:
    """Return the mean over bins of P^R without EoR in units of its noise error."""
    return bins.pull_without_eor(run, bins.outside_wedge(run, "residual_without_eor", k_min=k_min, k_max=k_max)[0])


@RESULTS.states(
    POSITIVE,
    "mean over bins of P^R without EoR in units of its noise error, outside the wedge, k <= 0.2",
    *TWOFOLD,
    pooled=over_realizations("pull_without_eor", "outside-wedge", 0.0, K_AGREEMENT),
)
def bias_at_level_of_noise_below_0p2(run: Results) -> Finding:
    return _over_noise(run, 0.0, K_AGREEMENT)


@RESULTS.states(
    POSITIVE,
    "mean over bins of P^R without EoR in units of its noise error, outside the wedge, k from 0.2 to 0.5",
    *TWOFOLD,
    pooled=over_realizations("pull_without_eor", "outside-wedge", _above(K_AGREEMENT), K_SMALL),
)
def bias_at_level_of_noise_from_0p2_to_0p5(run: Results) -> Finding:
    return _over_noise(run, _above(K_AGREEMENT), K_SMALL)


@RESULTS.states(
    POSITIVE,
    "mean P^R without EoR over mean P^S, outside the wedge, k <= 0.2",
    Within(-1, 1),
    SLIGHT,
    pooled=over_realizations("bias", "outside-wedge", 0.0, K_AGREEMENT),
)
def bias_lower_than_eor_below_0p2(run: Results) -> Finding:
    return _over_eor(run, 0.0, K_AGREEMENT)


@RESULTS.states(
    POSITIVE,
    "mean P^R without EoR over mean P^S, outside the wedge, k from 0.2 to 0.5",
    Within(-1, 1),
    SLIGHT,
    pooled=over_realizations("bias", "outside-wedge", _above(K_AGREEMENT), K_SMALL),
)
def bias_lower_than_eor_from_0p2_to_0p5(run: Results) -> Finding:
    return _over_eor(run, _above(K_AGREEMENT), K_SMALL)
