"""Step 3.0: reflections below the noise of a baseline, which the calibration must remove."""

from __future__ import annotations

import numpy as np

from calstudy.claims.low_snr import reflection_bins
from calstudy.claims.statement import Finding
from calstudy.validation.evidence import Evidence, Measurement

SUPPRESSION = 100
NOISE_SIGMAS = 2


def measure(evidence: Evidence) -> Measurement:
    """Return what is left of the artefact at the reflections' delays, outside the wedge.

    With means over those bins, weighted by their inverse noise variance, *left* is |P^R| over the larger of P^V / 100
    and 2 sigma of the noise: one or less is suppression by 100, or down to noise.
    """
    study = evidence.study(evidence.only, "spectra")
    corrupted, residual = (study.spherical(name, "outside-wedge") for name in ("uncalibrated", "residual"))
    chosen = reflection_bins(study, residual)
    weights = residual.noise_error[chosen] ** -2.0
    artefact, left = (
        float(np.sum(weights * spectrum.power.real[chosen]) / weights.sum()) for spectrum in (corrupted, residual)
    )
    sigma = float(weights.sum() ** -0.5)
    allowed = max(abs(artefact) / SUPPRESSION, NOISE_SIGMAS * sigma)
    return Measurement(
        {
            "left": Finding(abs(left) / allowed, sigma / allowed),
            "left_sigmas": Finding(left / sigma, 1.0),
            "artefact_sigmas": Finding(artefact / sigma, 1.0),
        },
        (f"artefact {artefact / sigma:.1f} sigma of the noise before calibration, {left / sigma:.1f} after",),
    )
