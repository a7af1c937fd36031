"""Claims on the positive bias of the residual without EoR: its range of k, and its size (paper §Simulation Results)."""

from __future__ import annotations

import numpy as np

from calstudy.claims.bins import power_without_eor, used_bins
from calstudy.claims.realizations import over_realizations
from calstudy.papers.calamity2022.calibration import FACTOR_OF_TWO, RESULTS
from calstudy.papers.calamity2022.window import K_AGREEMENT, K_SMALL, POSITIVE
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import Equal, Finding, Within

SLIGHT = "a slight bias is lower than the EoR; so is none"


def _above(k: float) -> float:
    """Return the lowest wavenumber above this one, because a bin belongs to one band only."""
    return float(np.nextafter(k, np.inf))


def _over_noise(run: Results, k_min: float, k_max: float) -> Finding:
    """Return the mean over bins of P^R without EoR in units of its noise error."""
    residual = run.spherical("residual_without_eor", "outside-wedge")
    used = used_bins(residual, k_min=k_min, k_max=k_max)
    pulls = residual.power.real[used] / residual.noise_error[used]
    return Finding(float(np.mean(pulls)), float(used.sum() ** -0.5))


def _over_eor(run: Results, k_min: float, k_max: float) -> Finding:
    """Return the mean over bins of P^R without EoR over that of P^S."""
    residual, signal = (run.spherical(name, "outside-wedge") for name in ("residual_without_eor", "eor"))
    used = used_bins(residual, signal, k_min=k_min, k_max=k_max)
    level = float(np.mean(signal.power.real[used]))
    left = power_without_eor(run, used, np.ones(used.sum()))
    return Finding(left.value / level, left.uncertainty / level)


@RESULTS.states(
    POSITIVE,
    "mean over bins of P^R without EoR in units of its noise error, outside the wedge, k <= 0.2",
    Within(0.5, 2),
    FACTOR_OF_TWO,
    pooled=over_realizations("pull_without_eor", "outside-wedge", 0.0, K_AGREEMENT),
)
def bias_at_level_of_noise_below_0p2(run: Results) -> Finding:
    return _over_noise(run, 0.0, K_AGREEMENT)


@RESULTS.states(
    POSITIVE,
    "mean over bins of P^R without EoR in units of its noise error, outside the wedge, k from 0.2 to 0.5",
    Within(0.5, 2),
    FACTOR_OF_TWO,
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


@RESULTS.states(
    POSITIVE,
    "mean over bins of P^R without EoR in units of its noise error, outside the wedge, k > 0.5",
    Equal(0),
    "a bias at small k is not at larger k",
    pooled=over_realizations("pull_without_eor", "outside-wedge", _above(K_SMALL)),
)
def no_bias_beyond_small_k(run: Results) -> Finding:
    return _over_noise(run, _above(K_SMALL), np.inf)
