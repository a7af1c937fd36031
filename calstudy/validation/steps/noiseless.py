"""Step 2.0: noiseless data whose foregrounds lie in the basis: the product of gains and model must equal the data.

The foregrounds are the simulated ones projected on the fit's basis, so that a perfect fit exists. In single precision
the data are rounded to complex64, as stored data are, and the solver is that of the experiment. In double precision the
data are not rounded, and the solver also has double precision and continues until its residual is at rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.corrupt.levels import rms
from calstudy.validation.single_integration import SingleIntegrationStep
from calstudy.validation.step import Findings, Limit, StepInput
from calstudy.verdicts.criterion import AtMost, Finding

PATIENT = {"precision": "double", "tolerance": 1e-14, "max_steps": 300}


class Noiseless(SingleIntegrationStep):
    """The rms of V - g_a g_b* F over that of V, for both precisions."""

    number = "2.0"
    proves = "if the foregrounds are inside the basis, the product of gains and model equals the data"
    small_parameters: ClassVar = {"antennas": 10}
    limits: ClassVar = {
        "single": Limit(
            "rms of V - g g* F over rms of V, data in single precision",
            AtMost(1e-5),
            "float32 resolves 6e-8; 1e-5 is a tenth of the EoR",
        ),
        "double": Limit(
            "the same, data in double precision, solved until the solver makes no more progress",
            AtMost(1e-9),
            "float64 resolves 1e-16; a solver that reaches the minimum has no floor near the EoR",
        ),
    }

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Calibrate in both precisions."""
        integration = self.integration(runs)
        exact = integration.products(integration.true_gains) * integration.modelled
        patient = integration.settings.solver.model_copy(update=PATIENT)
        cases = {
            "single": (exact.astype(np.complex64).astype(complex), integration.settings),
            "double": (exact, integration.settings.model_copy(update={"solver": patient})),
        }
        values, remarks = {}, []
        for precision, (visibilities, settings) in cases.items():
            result = integration.calibrate(visibilities, settings)
            values[precision] = Finding(rms(integration.misfit(result, visibilities)) / rms(visibilities), 0.0)
            record = result.solutions[0]
            remarks.append(f"{precision}: {record.status} after {record.n_steps} steps: {record.message}")
        return Findings(values, tuple(remarks))
