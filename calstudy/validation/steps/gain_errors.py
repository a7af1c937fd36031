"""Step 2.4: as many gains are within their errors of the true ones as should be.

Deviations from the true gains, without what no fit can know, in units of their errors by noise; both noise realizations
of every integration are realizations of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from calstudy.experiment.model import Variant
from calstudy.figures.gain_coverage import ALLOWED, PARTS, pooled
from calstudy.products.corruption import PARITIES
from calstudy.products.gain_coverage import gain_coverage, read_coverage
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import Case, Findings, Limit, Step, StepInput, only
from calstudy.verdicts.criterion import Finding, Within

VARIANT = Variant(components=("foregrounds", "noise"), effects=True, calibrate=True)
NAMES = ("within_1", "within_2")
MANY = {"instrument.times.count": 20, "calibration.weights": "gains", "sky.eor.nside": 64}
SMALL = {"instrument.times.count": 12, "calibration.weights": "gains"}

FAILING = (
    "errors that are 7 % too small or too large fail",
    "errors that are 8 % too small or 11 % too large fail",
)
"""What the limits find, for 1 and 1.96 errors."""


class GainErrors(Step):
    """The fractions of amplitudes and phases within 1 and 1.96 errors, of `calamity`."""

    number = "2.4"
    proves = "the errors of the gains by noise cover the deviations from the true gains"
    # The member calamity of gain-errors.yaml, whose products it has.
    experiments: ClassVar = {"calamity": Case("minredundant.yaml", MANY, small=SMALL)}
    limits: ClassVar = {
        f"{part}_{name}": Limit(
            f"fraction of the {part}s of all gains within {sigmas} sigma",
            Within(right - allowed, right + allowed),
            f"{100 * right:.3g} % of a normal distribution; {why}",
        )
        for part in PARTS
        for name, sigmas, (right, allowed), why in zip(NAMES, ("1", "1.96"), ALLOWED, FAILING, strict=True)
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the fractions of both noise realizations."""
        return {parity: gain_coverage(graph, VARIANT, parity) for parity in PARITIES}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Pool the realizations."""
        run = only(runs)
        found = pooled([read_coverage(run.products[parity]) for parity in PARITIES])
        values = {
            f"{part}_{name}": Finding(float(found.within[place, limit]), float(found.within_error[place, limit]))
            for place, part in enumerate(PARTS)
            for limit, name in enumerate(NAMES)
        }
        worst = ", ".join(f"{100 * value:.1f}" for value in found.worst.ravel())
        remark = f"{found.realizations} realizations; of the worst antenna {worst} %"
        return Findings(values, (remark,))
