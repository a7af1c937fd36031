"""Claims on the limits of the method (paper §Caveats and Limitations)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.claims.bins import difference_of_losses
from calstudy.papers.calamity2022.method import HUNDREDTH, K_WINDOW
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding
from calstudy.verdicts.statement import Source, Unevaluated

CAVEATS = Source("Caveats and Limitations", ("minimally_redundant",))


@replace(CAVEATS, roles=("minimally_redundant", "other_channels")).states(
    "the degree and extent of this signal loss will also depend on the bandwidth and channelization resolution",
    "T free of the flux scale with channels of another width in the same band minus that with the paper's, outside the "
    "wedge, k >= 0.2; absolute value",
    AtLeast(HUNDREDTH),
    "depends is more than a hundredth of the EoR",
)
def loss_depends_on_channels(run: Results, other: Results) -> Finding:
    first, second = (item.experiment.instrument.channels for item in (run, other))
    if first.width == second.width or not np.isclose(first.width * first.count, second.width * second.count):
        raise Unevaluated("the runs have the same channels, or not the same band")
    found = difference_of_losses(other, run, K_WINDOW)
    return found._replace(value=abs(found.value))


@CAVEATS.states(
    "we do not expect CALAMITY to be able to correct high-delay systematics that are direction dependent: high RM "
    "polarization leakage",
    "mean P^R without EoR over mean P^S outside the wedge, with polarized foregrounds that leak into xx",
    AtLeast(1, 2),
    "what is not corrected stays above the EoR",
)
def leakage_is_not_corrected(run: Results) -> Finding:
    raise Unevaluated("the simulated sky is not polarized")


@CAVEATS.states(
    "main-lobe filtering prior to bandpass calibration could still allow for CALAMITY to remove fine-frequency "
    "bandpass features",
    "mean P^R without EoR over mean P^S outside the wedge, with coupled antennas and data filtered in fringe rate",
    AtMost(1, 2),
    "what is removed is below the EoR",
)
def filter_rescues_coupling(run: Results) -> Finding:
    raise Unevaluated("there is no filter in fringe rate before calibration")
