"""Step 3.0: reflections below the noise of a baseline, which the calibration must remove."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.base.errors import InputError
from calstudy.claims.bins import bins_at_delays
from calstudy.corrupt.effects.gains import ReflectionGains
from calstudy.products import spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import Case, Findings, Limit, Step, StepInput, only
from calstudy.verdicts.criterion import AtMost, Finding

SUPPRESSION = 100
NOISE_SIGMAS = 2
WIDTH = 2
"""Reflections are searched for within this many standard deviations of their mean delay."""


SMALL = {
    "corruption.noise": {"kind": "times-foregrounds", "factor": 0.1},
    "corruption.effects": [
        {"kind": "reflection-gains", "amplitude": 0.1, "delay": "800 ns", "delay_scatter": "50 ns", "seed": 5}
    ],
    "outputs.figures": [],
}


class LowSnr(Step):
    """The remaining artefact at the reflections' delays, outside the wedge.

    With means over those bins, weighted by their inverse noise variance, *left* is |P^R| over the larger of P^V / 100
    and 2 sigma of the noise: one or less is suppression by 100, or to the noise.
    """

    number = "3.0"
    proves = "cable reflections below the noise of a baseline are removed"
    experiments: ClassVar = {"lowsnr": Case("lowsnr.yaml", small=SMALL)}
    sections: ClassVar = ("corruption",)
    limits: ClassVar = {
        "left": Limit(
            "|P^R| at the reflections over the larger of P^V / 100 and 2 sigma of the noise",
            AtMost(1),
            "suppressed by 100, or to the noise",
        ),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the averaged spectra of all variants."""
        return {"spectra": spectra.spectra(graph)}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the spectra before and after calibration."""
        run = only(runs)
        corrupted, residual = (run.spherical(name, "outside-wedge") for name in ("uncalibrated", "residual"))
        gains = run.experiment.corruption.gains
        if not isinstance(gains, ReflectionGains):
            raise InputError("the measurement needs an experiment with the effect reflection-gains")
        low, high = (gains.delay + sign * WIDTH * gains.delay_scatter for sign in (-1, 1))
        chosen = bins_at_delays(residual, run.wedge("noise"), low, high)
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
