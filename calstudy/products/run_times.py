"""Run times of the solvers: measured for each array, their table, and their scaling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.base.schema import Section
from calstudy.base.table import Table
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.cost import ADAMAX_STEP, PAPER_SAMPLES, Dimensions, basis_vectors, solve_memory
from calstudy.calibrate.settings import BasisSettings
from calstudy.instrument.settings import Channels, Layout
from calstudy.instrument.size import antenna_count
from calstudy.products.files import read_json, write_json
from calstudy.run.task import Input, Inputs, Task

if TYPE_CHECKING:
    import numpy as np

CASE, LOSSES, DESCENT, RUNTIME = "case.json", "losses.npz", "descent.json", "runtime.json"
# The paper's padded step, per byte of its basis.
PADDED_SECONDS = 1e-9
PADDED_COPIES = 7
EXCESSES = ("0.05", "0.01", "0.002")
"""Fractions above the minimum to which steps are counted."""
QUANTILES = (0.025, 0.5, 0.975)
"""The limits of the central 95 %, and the median."""
COLUMNS = ("panel", "size", "device", "antennas", "baselines", "longest [m]", "vectors", "coefficients", "timed")


class TimedArray(Section):
    """An array on which solvers are timed, with its channels and the foreground basis of every baseline."""

    layout: Layout
    channels: Channels
    basis: BasisSettings


class Timed(Task):
    """Solvers on an array, of which the longest baseline, m, is given."""

    array: TimedArray
    longest: float

    @property
    def antennas(self) -> int:
        """Number of antennas."""
        return antenna_count(self.array.layout)

    @property
    def dimensions(self) -> Dimensions:
        """Size of the problem, in which every baseline has the basis of the longest."""
        vectors = basis_vectors(self.longest, self.array.channels, self.array.basis)
        baselines = self.antennas * (self.antennas - 1) // 2
        channels = self.array.channels.count
        return Dimensions(self.antennas, baselines, baselines, channels, vectors, baselines * vectors)

    @property
    def work(self) -> float:
        """Number of visibilities over that of the paper."""
        return self.dimensions.baselines * self.array.channels.count / PAPER_SAMPLES


class TimeSteps(Timed, stage="step-times", version=4):
    """Times of all solvers on one array, measured in a separate process."""

    machine: Mapping[str, Any]
    panel: str
    size: float
    samples: Mapping[str, int]
    device: str

    def make(self, output: Path) -> Mapping[str, Any]:
        """Time the solvers, and write all samples to case.json."""
        import numpy as np

        from calstudy.products.step_times import Samples, time_steps_apart

        array = self.array.model_dump(mode="json")
        found = asdict(time_steps_apart(array, Samples(**self.samples), self.device))
        case = {name: getattr(self, name) for name in ("panel", "size", "device", "machine")}
        write_json(output / CASE, {**case, **found})
        return {f"median {name}": float(np.median(samples)) for name, samples in found["seconds"].items()}

    def _cost(self) -> Cost:
        dimensions, samples = self.dimensions, self.samples
        padded = 4 * dimensions.coefficients * self.array.channels.count
        solves = samples["solves"] * (0.4 + 1.3 * self.work)
        steps = PADDED_SECONDS * padded * samples["steps"] + 50 * ADAMAX_STEP * self.work * samples["calls"]
        return Cost(30 + steps + solves, solve_memory(dimensions, Calamity()) + PADDED_COPIES * padded, 1e5)


class CountSteps(Timed, stage="descent", version=2):
    """The descent of the paper's solver to the minimum."""

    max_steps: int

    def make(self, output: Path) -> Mapping[str, Any]:
        """Run the solver for `max_steps`, and count the steps to each of `EXCESSES`."""
        import numpy as np

        from calstudy.products.step_times import descend_apart

        found = descend_apart(self.array.model_dump(mode="json"), self.max_steps)
        np.savez(output / LOSSES, allow_pickle=False, losses=found.losses, floor=found.floor)
        counted = {
            "antennas": found.antennas,
            "max_steps": self.max_steps,
            "steps_to": {excess: found.steps_to(float(excess)) for excess in EXCESSES},
            "best": float(found.losses.min() / found.floor - 1),
        }
        write_json(output / DESCENT, counted)
        return counted

    def _cost(self) -> Cost:
        return Cost(20 + ADAMAX_STEP * self.work * self.max_steps, solve_memory(self.dimensions, Calamity()), 1e6)


class RunTimes(Task, stage="runtime", version=2, cost=Cost(1, disk=1e5)):
    """Medians and central 95 % intervals of all times."""

    machine: Mapping[str, Any]
    cases: Inputs
    descent: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the times to runtime.json and runtime.csv."""
        cases = [read_json(folder / CASE) for _, folder in sorted(self.cases.items())]
        descent = read_json(self.descent / DESCENT)
        for case in cases:
            del case["machine"]
            case["seconds"] = {name: _quantiles(samples) for name, samples in case["seconds"].items()}
        write_json(output / RUNTIME, {"machine": self.machine, "cases": cases, "descent": descent})
        rows = [
            (
                *(case[name.partition(" ")[0]] for name in COLUMNS[:-1]),
                *(name, *(found[key] for key in ("median", "low", "high", "count"))),
            )
            for case in cases
            for name, found in case["seconds"].items()
        ]
        columns = (*COLUMNS, "median [s]", "2.5 % [s]", "97.5 % [s]", "samples")
        Table(columns, rows).write_csv(output / "runtime.csv")
        return {}


def _quantiles(samples: Sequence[float]) -> dict[str, float]:
    import numpy as np

    low, median, high = (float(value) for value in np.quantile(samples, QUANTILES))
    return {"median": median, "low": low, "high": high, "count": len(samples)}


@dataclass(frozen=True)
class PowerLaw:
    """A law value = amplitude · size^exponent; the error is one standard deviation of the exponent."""

    amplitude: float
    exponent: float
    error: float

    def at(self, size: np.ndarray | float) -> np.ndarray | float:
        """Return the value at a size."""
        return self.amplitude * size**self.exponent


def fit_power_law(size: np.ndarray, value: np.ndarray) -> PowerLaw:
    """Fit a straight line to the logarithms of positive values at three or more sizes, (Nsizes,).

    Raises ValueError if there are fewer sizes, or a number is not positive.
    """
    import numpy as np

    if len(size) != len(value) or np.unique(size).size < 3 or min(*size, *value) <= 0:
        raise ValueError(f"a power law needs positive values at three sizes or more, got {len(value)} at {len(size)}")
    (exponent, logarithm), covariance = np.polyfit(np.log(size), np.log(value), 1, cov=True)
    return PowerLaw(float(np.exp(logarithm)), float(exponent), float(covariance[0, 0] ** 0.5))
