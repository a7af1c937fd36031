"""Stage `validate`: what a rung of the validation ladder finds on products."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calstudy.stages.files import write_json
from calstudy.stages.registry import Job
from calstudy.validation.evidence import Evidence
from calstudy.validation.rungs import RUNGS

MEASUREMENT = "measurement.json"


def measure(job: Job) -> Mapping[str, Any]:
    """Write the findings of a rung to measurement.json, besides its figures and tables."""
    evidence = Evidence(job.settings["experiments"], job.settings["parameters"], job.inputs, job.output)
    found = RUNGS[job.settings["rung"]].load()(evidence)
    findings = {
        name: {"value": _number(finding.value), "uncertainty": _number(finding.uncertainty)}
        for name, finding in found.findings.items()
    }
    write_json(job.output / MEASUREMENT, {"findings": findings, "remarks": list(found.remarks)})
    return {"findings": findings}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
