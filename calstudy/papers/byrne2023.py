"""Byrne 2023: delay-weighted calibration with a sky model that lacks sources.

The statements are in our words, after the paper's abstract.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from calstudy.claims.bins import bias, ratio
from calstudy.claims.paper import Paper
from calstudy.claims.roles import require_long_baselines, require_same_world, unsuitable
from calstudy.experiment.model import Experiment
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, Finding, Within
from calstudy.verdicts.statement import Source, Unevaluated

WINDOW = (0.2, 0.5)
MEASURED = 5.0
"""Standard deviations of a bias from zero, below which a ratio to it is a lower limit."""
HUNDRED = Within(10**1.5, 10**2.5)
BOTH = Source("Abstract", ("sky_based", "delay_weighted"))


@BOTH.states(
    "delay weighting substantially reduces the error of calibration if the sky model has realistic errors",
    "error of g_a g_b* beyond the horizon over the noise, median of baselines: sky-based over delay-weighted",
    AtLeast(2),
    "substantially: by half at least",
)
def error_of_calibration_is_reduced(sky_based: Results, delay_weighted: Results) -> Finding:
    require_same_world(sky_based, delay_weighted)
    first, second = (run.measured("correction_over_noise_outside") for run in (sky_based, delay_weighted))
    return ratio(*(Finding(median.value, median.scatter / median.count**0.5) for median in (first, second)))


@BOTH.states(
    "it improves the sensitivity of the power spectrum by about two orders of magnitude",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc: sky-based over delay-weighted, or a lower "
    "limit of two standard deviations of both where the latter may be zero",
    HUNDRED,
    "a hundred, to half an order of magnitude",
)
def sensitivity_improves_hundredfold(sky_based: Results, delay_weighted: Results) -> Finding:
    require_same_world(sky_based, delay_weighted)
    require_long_baselines(sky_based, WINDOW[1])
    first, second = (bias(run, *WINDOW) for run in (sky_based, delay_weighted))
    least = first.value - 2 * first.uncertainty
    if least <= 0:
        raise Unevaluated(
            f"the bias of sky-based calibration, {first.value:.2g} ± {first.uncertainty:.2g}, is not above its error"
        )
    if second.value >= MEASURED * second.uncertainty:
        return ratio(first, second)
    # A ratio to what may be zero has no error that could be propagated.
    return Finding(least / (max(second.value, 0) + 2 * second.uncertainty), 0.0, "at least")


class Byrne2023(Paper):
    """Statements on delay-weighted calibration."""

    version: ClassVar[int] = 2
    citation = (
        "Byrne, R. 2023, Delay-weighted calibration: precision calibration for 21 cm cosmology with resilience to sky "
        "model error, arXiv:2208.04406"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "sky_based": "a run of sky-based calibration whose sky model lacks sources, with inverse variances as weights "
        "or gains that are smooth in frequency",
        "delay_weighted": "a run of delay-weighted calibration whose sky model lacks sources",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "sky_based": "long-sky-based-incomplete",
        "delay_weighted": "long-delay-weighted-incomplete",
    }

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        allowed = ("delay-weighted",) if role == "delay_weighted" else ("sky-based", "skycal")
        return unsuitable(experiment, allowed, incomplete=True)
