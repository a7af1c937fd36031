"""The realizations of an experiment, pooled by region, and criteria on error bars and corrected power."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.power.corrected import Corrected, correct_realizations
from calstudy.power.realizations import (
    Design,
    PooledRegion,
    coverage,
    inside_bars,
    mean_over_bins,
    pool_region,
)
from calstudy.products import realizations
from calstudy.products.realizations import REGIONS
from calstudy.verdicts.criterion import Criterion, Finding, Verdict, Within

if TYPE_CHECKING:
    from calstudy.power.realizations import Sample

JUDGED_REGION, JUDGED_K = "outside-wedge", 0.2
WHERE = f"outside the wedge, k >= {JUDGED_K:g} h/Mpc"
CRITERIA = {
    "bars-cover-eor": Criterion(
        "bars-cover-eor",
        "Error bars as quoted",
        "the 95 % bars of P^R cover P^S in 95 % of bins",
        f"part of bins with |P^R - P^S| within 1.96 sigma of noise; {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    "bars-cover-input": Criterion(
        "bars-cover-input",
        "Error bars as quoted",
        "the 95 % bars of P^R cover the input power in 95 % of bins",
        f"part of bins with |P^R - input| within 1.96 (sigma_N + sigma_S); {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    "corrected-mean": Criterion(
        "corrected-mean",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average",
        f"mean of P^R / T over the input; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    "corrected-mean-known-scale": Criterion(
        "corrected-mean-known-scale",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average where the flux scale is known",
        f"mean of P^R s^2 / (T s^2) over the input, s of the same realization; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    "corrected-covers-eor": Criterion(
        "corrected-covers-eor",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover P^S in 95 % of bins",
        f"part of bins with |P^R / T - P^S| within 1.96 sigma; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
    "corrected-covers-input": Criterion(
        "corrected-covers-input",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover the input power in 95 % of bins",
        f"part of bins with |P^R / T - input| within 1.96 sigma, sample variance included; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
}
COVERED = {
    "bars-cover-eor": "eor",
    "bars-cover-input": "input",
    "corrected-covers-eor": "corrected_eor",
    "corrected-covers-input": "corrected_input",
}
"""Keys of `RegionResults.covered` for the criteria on coverage."""
DRAWN_FOR = {"eor": "noise", "input": "eor"}
"""Draw that a block needs so that its bars are independent trials of covering P^S (`eor`) or the input."""


@dataclass(frozen=True)
class RegionResults:
    """All results of one region.

    Powers of the input (`put_in`) and P^S (`eor`) are (K, Nk) for K realizations. `covered` is 1 or 0 where bars cover
    or not, and NaN where this is not known, (K, Nk), with the keys ``eor`` and ``input`` for P^R, ``corrected_eor`` and
    ``corrected_input`` for P^R / T. `corrected` is P^R / T, or None where T is not known.
    """

    pooled: PooledRegion
    put_in: np.ndarray
    covered: Mapping[str, np.ndarray]
    corrected: Corrected | None
    eor: np.ndarray

    def coverage(self, kind: str, bins: np.ndarray) -> Finding | None:
        """Return the coverage in some bins over the block with independent trials; None without such a block."""
        place = self.pooled.design.block_of(DRAWN_FOR[kind.removeprefix("corrected_")])
        if place is None or kind not in self.covered:
            return None
        return coverage(self.covered[kind][list(self.pooled.design.blocks[place][1])][:, bins], independent=True)

    def corrected_over(self, power: np.ndarray, bins: np.ndarray, known_scale: bool = False) -> Finding | None:
        """Return the mean of P^R / T over another power, (K, Nk), in some bins; None where T is not known.

        With `known_scale`, it is the mean for P^R s^2 / (T s^2).
        """
        if self.corrected is None:
            return None
        corrected = self.corrected.power_known_scale if known_scale else self.corrected.power
        return mean_over_bins((corrected / power)[:, bins], self.pooled.design)


def read_results(settings: Mapping[str, Any], folders: Mapping[str, Path]) -> dict[str, RegionResults]:
    """Read and pool all realizations, by region; settings and folders as in `calstudy.products.realizations`."""
    design = Design(settings["draws"], [(block["draw"], block["members"]) for block in settings["blocks"]])
    return {
        region: results_of(realizations.read_samples(folders, len(settings["draws"]), region), design)
        for region in REGIONS
    }


def results_of(samples: Sequence[Sample], design: Design) -> RegionResults:
    """Pool the samples of all realizations in one region, and correct P^R where T is known."""
    residual, eor = (np.stack([getattr(sample, name).power.real for sample in samples]) for name in ("residual", "eor"))
    put_in = np.stack([sample.put_in for sample in samples])
    covered = {
        "eor": inside_bars(residual - eor, np.stack([sample.residual.difference_error for sample in samples])),
        "input": inside_bars(residual - put_in, np.stack([sample.residual.error for sample in samples])),
    }
    corrected = None
    if samples[0].transfer is not None:
        corrected = correct_realizations(samples, design)
        covered["corrected_eor"] = inside_bars(corrected.power - eor, corrected.error)
        covered["corrected_input"] = inside_bars(corrected.power - put_in, corrected.error_with_sample)
    return RegionResults(pool_region(samples, design), put_in, covered, corrected, eor)


def judge(results: RegionResults) -> list[Verdict]:
    """Compare the results outside the wedge with the criteria."""
    bins = results.pooled.k >= JUDGED_K
    verdicts = []
    for name, criterion in CRITERIA.items():
        if name in COVERED:
            found = results.coverage(COVERED[name], bins)
            reason = f"no block of the realizations draws the {DRAWN_FOR[COVERED[name].removeprefix('corrected_')]}"
        else:
            found = results.corrected_over(results.put_in, bins, known_scale=name == "corrected-mean-known-scale")
            reason = "there is no bin in which P^R / T is known in all realizations"
        if found is None or not np.isfinite(found.value):
            verdicts.append(criterion.unevaluated(reason))
        else:
            verdicts.append(criterion.judge(found))
    return verdicts
