"""How many gains of a calibration are within their errors of the true ones, for every solve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.experiment.model import Variant
from calstudy.products import corruption
from calstudy.products.calibration import read_result
from calstudy.products.gain_errors import OfSolves, solved
from calstudy.products.graph import Graph, memoize
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from pathlib import Path

    from calstudy.calibrate.gain_coverage import GainCoverage

COVERAGE = "gain-coverage.npz"


@memoize
def gain_coverage(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the coverage of one noise realization ("even" or "odd") of a variant."""
    true = corruption.gains(graph) if variant.effects else None
    return MeasureCoverage(f"coverage {parity}", gains=true, **solved(graph, variant, parity))


class MeasureCoverage(OfSolves, stage="gain-coverage", version=3):
    """Fractions of the gains of each solve that are within their errors of the true gains, unity if there are none."""

    gains: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the fractions; raises InputError if no gains have errors."""
        from dataclasses import asdict

        import numpy as np

        from calstudy.calibrate.gain_coverage import GainCoverage, pulls
        from calstudy.products.selection import read_gains

        result, found, reasons = read_result(self.calibration), [], []
        true = None if self.gains is None else read_gains(self.gains)
        for solve in self.solves(result):
            if isinstance(solve.errors, str):
                reasons.append(solve.errors)
                continue
            numbers = result.gains.ant_array[solve.rows]
            reference = np.ones(solve.gains.shape) if true is None else true.at(solve.times.start, numbers)
            found.append(pulls(solve.errors, solve.gains, reference))
        if not found:
            raise InputError(f"no errors of gains: {'; '.join(sorted(set(reasons)))}")
        np.savez(output / COVERAGE, allow_pickle=False, **asdict(GainCoverage.of(found)))
        lacking = [f"{len(reasons)} solves have no errors of gains: {'; '.join(sorted(set(reasons)))}"]
        return {"solves": len(found), "warnings": lacking if reasons else []}


def read_coverage(folder: Path) -> GainCoverage:
    """Read the fractions of all solves."""
    import numpy as np

    from calstudy.calibrate.gain_coverage import GainCoverage

    with np.load(folder / COVERAGE, allow_pickle=False) as arrays:
        return GainCoverage(**arrays)
