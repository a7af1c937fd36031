"""Step 4.0: from the sky to the power spectrum: is the EoR recovered, bin by bin?

Pulls (P^R - P^S) / sigma outside wedge and buffer, with two readings of sigma: the paper's error bar sigma_N + sigma_S,
and the error of the difference, from which the sample variance that P^R and P^S share is gone
(`calstudy.claims.bins.difference_error`). The second is the harder.
"""

from __future__ import annotations

import numpy as np

from calstudy.claims.bins import difference_error, recovered, used_bins
from calstudy.claims.statement import Finding
from calstudy.validation.evidence import Evidence, Measurement

SIGMAS = 2
EXPECTED = 0.954
"""Part of a normal distribution within two sigma."""


def measure(evidence: Evidence) -> Measurement:
    """Return for every experiment which part of the bins has a pull within two sigma, for both readings."""
    k_min = evidence.parameters["k_min"]
    findings, remarks = {}, []
    for name in evidence.experiments:
        study = evidence.study(name, "spectra")
        residual, signal = (study.spherical(variant, "outside-wedge") for variant in ("residual", "eor"))
        used = used_bins(residual, signal, k_min=k_min)
        difference = (residual.power - signal.power).real[used]
        for reading, error in (("bars", residual.error), ("difference", difference_error(residual))):
            within = np.abs(difference / error[used]) <= SIGMAS
            sampling = np.sqrt(EXPECTED * (1 - EXPECTED) / within.size)
            findings[f"{name}_{reading}"] = Finding(float(within.mean()), float(sampling))
        ratio = recovered(residual, signal, k_min)
        findings[f"{name}_ratio"] = ratio
        remarks.append(f"{name}: P^R / P^S = {ratio.value:.3f} ± {ratio.uncertainty:.3f} in {used.sum()} bins")
    return Measurement(findings, tuple(remarks))
