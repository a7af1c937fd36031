"""Step 4.0: recovery of the EoR in each bin, from the sky to the power spectrum.

Pulls (P^R - P^S) / sigma outside wedge and buffer are computed with two definitions of sigma: the paper's error bar
sigma_N + sigma_S, and the error of the difference, without the sample variance that P^R and P^S share
(`calstudy.power.spectra.SphericalSpectrum.difference_error`). The second is the more severe. P^R / P^S is reported as
it is, and without the flux scale s of the fit, by whose square P^R is divided.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from calstudy.base.units import Wavenumber
from calstudy.claims.bins import recovered, used_bins
from calstudy.products import signal_loss, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.measurement import Findings, Inputs, Measurement
from calstudy.verdicts.criterion import Finding

SIGMAS = 2
EXPECTED = 0.954
"""Fraction of a normal distribution within two sigma."""


class EndToEnd(Measurement):
    """The fraction of the bins of every experiment with a pull within two sigma, for both definitions of sigma."""

    k_min: Wavenumber = Field(0.0, description="Bins below are left out.")

    def products(self, graph: Graph) -> Mapping[str, Task]:
        """Return the averaged spectra of all variants, and the transfer function, if any, which has the flux scale."""
        transfer = signal_loss.transfer(graph)
        return {"spectra": spectra.spectra(graph), **({} if transfer is None else {"transfer": transfer})}

    def measure(self, inputs: Inputs) -> Findings:
        """Compare the spectrum of the residual with that of the EoR."""
        values, remarks = {}, []
        for name in inputs.experiments:
            residual, signal = (inputs.spherical(name, variant) for variant in ("residual", "eor"))
            used = used_bins(residual, signal, k_min=self.k_min)
            difference = (residual.power - signal.power).real[used]
            for reading, error in (("bars", residual.error), ("difference", residual.difference_error)):
                within = np.abs(difference / error[used]) <= SIGMAS
                sampling = np.sqrt(EXPECTED * (1 - EXPECTED) / within.size)
                values[f"{name}_{reading}"] = Finding(float(within.mean()), float(sampling))
            ratio = recovered(residual, signal, self.k_min)
            values[f"{name}_ratio"] = ratio
            remarks.append(f"{name}: {_sentence(ratio, int(used.sum()), inputs.flux_scale(name))}")
        return Findings(values, tuple(remarks))


def _sentence(ratio: Finding, n_bins: int, scale: float | None) -> str:
    text = f"P^R / P^S = {ratio.value:.3f} ± {ratio.uncertainty:.3f} in {n_bins} bins"
    if scale is None:
        return f"{text}; the flux scale is not known"
    free = f"{scale**2 * ratio.value:.3f} ± {scale**2 * ratio.uncertainty:.3f}"
    return f"{text}; without the flux scale, {scale:.3f}: {free}"
