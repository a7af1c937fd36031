"""Run times of the solvers: measured for each array, their table, their scaling, and what statements read of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.base.schema import Section
from calstudy.base.table import Table
from calstudy.calibrate.cost import ADAMAX_STEP, PAPER_SAMPLES, Dimensions, basis_vectors, solve_memory
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.calibrate.settings import BasisSettings, GainFit
from calstudy.instrument.layouts import antenna_count
from calstudy.instrument.settings import Channels, Layout
from calstudy.products.files import read_json, write_json
from calstudy.run.task import Input, Inputs, Task
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

CASE, LOSSES, DESCENT, RUNTIME = "case.json", "losses.npz", "descent.json", "runtime.json"
# The paper's padded step, per byte of its basis.
PADDED_SECONDS = 1e-9
PADDED_COPIES = 7
EXCESSES = ("0.05", "0.01", "0.002")
"""Fractions above the minimum to which steps are counted."""
QUANTILES = (0.025, 0.5, 0.975)
"""The limits of the central 95 %, and the median."""
MEASURING = "calstudy.products.step_times"
"""Module of the separate process in which solvers are timed: it has one thread, and its memory is that of this work."""
THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "TF_NUM_INTRAOP_THREADS",
    "TF_NUM_INTEROP_THREADS",
)
ENVIRONMENT = {
    **dict.fromkeys(THREADS, "1"),
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "TF_CPP_MIN_LOG_LEVEL": "3",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}
"""One thread, no start-up messages, and huge pages for large temporary arrays where the system has them: the allocation
of small pages can take longer than the measured work."""
COLUMNS = ("panel", "size", "device", "antennas", "baselines", "longest [m]", "vectors", "coefficients", "timed")


def measured_apart(array: TimedArray, **request: Any) -> dict[str, Any]:
    """Return what `step_times` answers in a separate process; raises InputError with its last line if it fails."""
    text = json.dumps({"array": array.model_dump(mode="json"), **request})
    result = subprocess.run(
        [sys.executable, "-m", MEASURING, text],
        env={**os.environ, **ENVIRONMENT},
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        reason = (result.stderr.strip().splitlines() or [f"exit status {result.returncode}"])[-1]
        raise InputError(f"the measurement of {text} failed: {reason}")
    return json.loads(result.stdout.splitlines()[-1])


def steps_to(losses: np.ndarray, floor: float, excess: float) -> int | None:
    """Return the number of steps until a loss is within a fraction of its minimum, `floor`; None if it never is."""
    reached = np.flatnonzero(losses <= (1 + excess) * floor)
    return int(reached[0]) if reached.size else None


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
    def memory(self) -> float:
        """Memory of a solve, bytes."""
        return solve_memory(self.dimensions, cast(GainFit, CALIBRATORS.make("calamity")))

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
        found = measured_apart(self.array, samples=dict(self.samples), device=self.device)
        case = {name: getattr(self, name) for name in ("panel", "size", "device", "machine")}
        write_json(output / CASE, {**case, **found})
        return {f"median {name}": float(np.median(samples)) for name, samples in found["seconds"].items()}

    def _cost(self) -> Cost:
        dimensions, samples = self.dimensions, self.samples
        padded = 4 * dimensions.coefficients * self.array.channels.count
        solves = samples["solves"] * (0.4 + 1.3 * self.work)
        steps = PADDED_SECONDS * padded * samples["steps"] + 50 * ADAMAX_STEP * self.work * samples["calls"]
        return Cost(30 + steps + solves, self.memory + PADDED_COPIES * padded, 1e5)


class CountSteps(Timed, stage="descent", version=2):
    """The descent of the paper's solver to the minimum."""

    max_steps: int

    def make(self, output: Path) -> Mapping[str, Any]:
        """Run the solver for `max_steps`, and count the steps to each of `EXCESSES`."""
        found = measured_apart(self.array, max_steps=self.max_steps)
        losses, floor = np.array(found["losses"]), found["floor"]
        np.savez(output / LOSSES, allow_pickle=False, losses=losses, floor=floor)
        counted = {
            "antennas": found["antennas"],
            "max_steps": self.max_steps,
            "steps_to": {excess: steps_to(losses, floor, float(excess)) for excess in EXCESSES},
            "best": float(losses.min() / floor - 1),
        }
        write_json(output / DESCENT, counted)
        return counted

    def _cost(self) -> Cost:
        return Cost(20 + ADAMAX_STEP * self.work * self.max_steps, self.memory, 1e6)


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
    if len(size) != len(value) or np.unique(size).size < 3 or min(*size, *value) <= 0:
        raise ValueError(f"a power law needs positive values at three sizes or more, got {len(value)} at {len(size)}")
    (exponent, logarithm), covariance = np.polyfit(np.log(size), np.log(value), 1, cov=True)
    return PowerLaw(float(np.exp(logarithm)), float(exponent), float(covariance[0, 0] ** 0.5))


RUN_TIME = "run_time"
"""Role of a run-time study."""


@dataclass(frozen=True)
class RunTimeTable:
    """One run-time study: the name of the run with the machine, and its table, with ``cases`` and ``descent``."""

    name: str
    table: Mapping[str, Any]

    @classmethod
    def read(cls, name: str, path: Path) -> RunTimeTable:
        """Read the table of a run."""
        table = read_json(path)
        return cls(f"{name} on {machine_in_words(table['machine'])}", table)

    def cases(self, panel: str, device: str = "cpu") -> list[Mapping[str, Any]]:
        """Return the arrays of one panel, the smallest first; raises Unevaluated if that device was not timed."""
        found = [case for case in self.table["cases"] if (case["panel"], case["device"]) == (panel, device)]
        if not found:
            raise Unevaluated(f"needs run times on a {device}; run it with --scale {device} where there is one")
        return sorted(found, key=lambda case: case["size"])

    def medians(self, panel: str, kind: str, device: str = "cpu") -> np.ndarray:
        """Return the median seconds of a kind of step or solve for each array of "rows" or "line", (Nsizes,)."""
        return np.array([case["seconds"][kind]["median"] for case in self.cases(panel, device)])

    def column(self, panel: str, name: str, device: str = "cpu") -> np.ndarray:
        """Return a property of each array, (Nsizes,), such as "size"; panel and device as for `medians`."""
        return np.array([case[name] for case in self.cases(panel, device)], float)

    def scaling(self, panel: str, kind: str, against: str = "size", device: str = "cpu") -> PowerLaw:
        """Fit the medians as a power of a property of the arrays; panel, kind and device as for `medians`."""
        return fit_power_law(self.column(panel, against, device), self.medians(panel, kind, device))

    def steps_to(self, excess: str) -> Finding:
        """Return the steps of the paper's solver to within a fraction of the minimum, or its steps as a lower bound."""
        descent = self.table["descent"]
        steps = descent["steps_to"][excess]
        return Finding(descent["max_steps"], 0.0, "at least") if steps is None else Finding(steps, 0.0)


def machine_in_words(machine: Mapping[str, Any]) -> str:
    """Return processor, cores and memory of a machine, and its GPU if it was timed."""
    words = f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB"
    return f"{words}, {machine['gpu']}" if machine.get("gpu") else words
