"""Step 4.0: recovery of the EoR in each bin, from the sky to the power spectrum.

Pulls (P^R - P^S) / sigma outside wedge and buffer are computed with two definitions of sigma: the paper's error bar
sigma_N + sigma_S, and the error of the difference, without the sample variance that P^R and P^S share
(`calstudy.power.spectra.SphericalSpectrum.difference_error`). The second is the more severe. P^R / P^S is reported as
it is, and without the flux scale s of the fit, by whose square P^R is divided.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.claims.bins import recovered, used_bins
from calstudy.products import signal_loss, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, REDUNDANT, Findings, Limit, Step, StepInput
from calstudy.verdicts.criterion import AtLeast, Finding

SIGMAS = 2
EXPECTED = 0.954
"""Fraction of a normal distribution within two sigma."""


class EndToEnd(Step):
    """The fraction of the bins of every experiment with a pull within two sigma, for both definitions of sigma."""

    number = "4.0"
    proves = "P^R recovers P^S outside wedge and buffer, on both arrays"
    experiments: ClassVar = {"minredundant": MINREDUNDANT, "redundant": REDUNDANT}
    limits: ClassVar = {
        "minredundant_bars": Limit(
            "minimally redundant array, fraction of bins with |P^R - P^S| within 2 sigma; sigma of the paper (sigma_N "
            "+ sigma_S)",
            AtLeast(0.9),
            "95 % are expected; 10 % may miss",
        ),
        "redundant_bars": Limit("redundant array, the same", AtLeast(0.9), "as above"),
        "minredundant_difference": Limit(
            "minimally redundant array, the same with the error of the difference, since both contain the same EoR",
            AtLeast(0.9),
            "as above; stricter, because the paper's error bars contain sample variance that both share",
        ),
        "redundant_difference": Limit("redundant array, the same", AtLeast(0.9), "as above"),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the averaged spectra of all variants, and the transfer function, if any, which has the flux scale."""
        transfer = signal_loss.transfer(graph)
        return {"spectra": spectra.spectra(graph), **({} if transfer is None else {"transfer": transfer})}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the spectrum of the residual with that of the EoR."""
        values, remarks = {}, []
        for name, run in runs.items():
            residual, signal = (run.spherical(variant, "outside-wedge") for variant in ("residual", "eor"))
            used = used_bins(residual, signal)
            difference = (residual.power - signal.power).real[used]
            for reading, error in (("bars", residual.error), ("difference", residual.difference_error)):
                within = np.abs(difference / error[used]) <= SIGMAS
                sampling = np.sqrt(EXPECTED * (1 - EXPECTED) / within.size)
                values[f"{name}_{reading}"] = Finding(float(within.mean()), float(sampling))
            ratio = recovered(residual, signal, 0.0)
            values[f"{name}_ratio"] = ratio
            remarks.append(f"{name}: {_sentence(ratio, int(used.sum()), run.flux_scale)}")
        return Findings(values, tuple(remarks))


def _sentence(ratio: Finding, n_bins: int, scale: float | None) -> str:
    text = f"P^R / P^S = {ratio.value:.3f} ± {ratio.uncertainty:.3f} in {n_bins} bins"
    if scale is None:
        return f"{text}; the flux scale is not known"
    free = f"{scale**2 * ratio.value:.3f} ± {scale**2 * ratio.uncertainty:.3f}"
    return f"{text}; without the flux scale, {scale:.3f}: {free}"
