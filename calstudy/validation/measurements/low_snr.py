"""Step 3.0: reflections below the noise of a baseline, which the calibration must remove."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from calstudy.base.errors import InputError
from calstudy.claims.bins import bins_at_delays
from calstudy.corrupt.effects.reflection_gains import ReflectionGains
from calstudy.products import spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.measurement import Findings, Inputs, Measurement
from calstudy.verdicts.criterion import Finding

SUPPRESSION = 100
NOISE_SIGMAS = 2
WIDTH = 2
"""Reflections are searched for within this many standard deviations of their mean delay."""


class LowSnr(Measurement):
    """The remaining artefact at the reflections' delays, outside the wedge.

    With means over those bins, weighted by their inverse noise variance, *left* is |P^R| over the larger of P^V / 100
    and 2 sigma of the noise: one or less is suppression by 100, or to the noise.
    """

    sections: ClassVar = ("corruption",)

    def products(self, graph: Graph) -> Mapping[str, Task]:
        """Return the averaged spectra of all variants."""
        return {"spectra": spectra.spectra(graph)}

    def measure(self, inputs: Inputs) -> Findings:
        """Compare the spectra before and after calibration."""
        name = inputs.only
        corrupted, residual = (inputs.spherical(name, variant) for variant in ("uncalibrated", "residual"))
        gains = inputs.corruption(name).gains
        if not isinstance(gains, ReflectionGains):
            raise InputError("the measurement needs an experiment with the effect reflection-gains")
        low, high = (gains.delay + sign * WIDTH * gains.delay_scatter for sign in (-1, 1))
        chosen = bins_at_delays(residual, inputs.cylindrical(name, "noise"), low, high)
        weights = residual.noise_error[chosen] ** -2.0
        artefact, left = (
            float(np.sum(weights * spectrum.power.real[chosen]) / weights.sum()) for spectrum in (corrupted, residual)
        )
        sigma = float(weights.sum() ** -0.5)
        allowed = max(abs(artefact) / SUPPRESSION, NOISE_SIGMAS * sigma)
        values = {
            "left": Finding(abs(left) / allowed, sigma / allowed),
            "left_sigmas": Finding(left / sigma, 1.0),
            "artefact_sigmas": Finding(artefact / sigma, 1.0),
        }
        remark = f"artefact {artefact / sigma:.1f} sigma of the noise before calibration, {left / sigma:.1f} after"
        return Findings(values, (remark,))
