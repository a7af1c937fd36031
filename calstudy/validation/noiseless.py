"""Step 2.0: noiseless data whose foregrounds lie in the basis: the product of gains and model must equal the data.

The foregrounds are the simulated ones projected on the fit's basis, so that a perfect fit exists. In single precision
the data are rounded to complex64, as stored data are, and the solver is the experiment's own; in double precision they
are not, and the solver goes on as long as its predicted gain exceeds 1e-14 of the loss.
"""

from __future__ import annotations

import numpy as np

from calstudy.claims.statement import Finding
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.scene import Scene, rms

ALL_THE_WAY = 1e-14


def measure(evidence: Evidence) -> Measurement:
    """Return the rms of V - g_a g_b* F over that of V, for both precisions."""
    name = evidence.only
    scene = Scene.of(evidence, name)
    exact = scene.products(scene.true_gains(evidence, name)) * scene.modelled
    findings, remarks = {}, []
    patient = scene.settings.solver.model_copy(update={"tolerance": ALL_THE_WAY})
    cases = {
        "single": (exact.astype(np.complex64).astype(complex), scene.settings),
        "double": (exact, scene.settings.model_copy(update={"solver": patient})),
    }
    for precision, (visibilities, settings) in cases.items():
        result = scene.calibrate(visibilities, settings)
        findings[precision] = Finding(rms(scene.misfit(result, visibilities)) / rms(visibilities), 0.0)
        record = result.solutions[0]
        remarks.append(f"{precision}: {record.status} after {record.n_steps} steps: {record.message}")
    return Measurement(findings, tuple(remarks))
