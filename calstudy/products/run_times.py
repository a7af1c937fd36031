"""Run times of the solvers: measured for each array, their table, and their scaling."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.base.schema import Section
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.cost import ADAMAX_STEP, PAPER_SAMPLES, Dimensions, basis_vectors, solve_memory
from calstudy.calibrate.settings import BasisSettings
from calstudy.instrument.settings import Channels, Layout
from calstudy.instrument.size import antenna_count
from calstudy.products.files import read_json, write_json
from calstudy.run.task import Job, Stage, Task

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


def time_steps(job: Job) -> Mapping[str, Any]:
    """Time all solvers on one array, in a separate process."""
    import numpy as np

    from calstudy.products.step_times import Samples, time_steps_apart

    settings = job.settings
    array = settings["array"].model_dump(mode="json")
    found = asdict(time_steps_apart(array, Samples(**settings["samples"]), settings["device"]))
    case = {name: settings[name] for name in ("panel", "size", "device", "machine")}
    write_json(job.output / CASE, {**case, **found})
    return {f"median {name}": float(np.median(samples)) for name, samples in found["seconds"].items()}


def count_steps(job: Job) -> Mapping[str, Any]:
    """Run the paper's solver for `max_steps`, and count the steps to each of `EXCESSES`."""
    import numpy as np

    from calstudy.products.step_times import descend_apart

    found = descend_apart(job.settings["array"].model_dump(mode="json"), job.settings["max_steps"])
    np.savez(job.output / LOSSES, allow_pickle=False, losses=found.losses, floor=found.floor)
    counted = {
        "antennas": found.antennas,
        "max_steps": job.settings["max_steps"],
        "steps_to": {excess: found.steps_to(float(excess)) for excess in EXCESSES},
        "best": float(found.losses.min() / found.floor - 1),
    }
    write_json(job.output / DESCENT, counted)
    return counted


def summarize(job: Job) -> Mapping[str, Any]:
    """Write medians and central 95 % intervals of all times to runtime.json and runtime.csv."""
    cases = [read_json(folder / CASE) for name, folder in sorted(job.inputs.items()) if name != "descent"]
    descent = read_json(job.inputs["descent"] / DESCENT)
    for case in cases:
        del case["machine"]
        case["seconds"] = {name: _quantiles(samples) for name, samples in case["seconds"].items()}
    write_json(job.output / RUNTIME, {"machine": job.settings["machine"], "cases": cases, "descent": descent})
    _write_csv(job.output / "runtime.csv", cases)
    return {}


def _quantiles(samples: Sequence[float]) -> dict[str, float]:
    import numpy as np

    low, median, high = (float(value) for value in np.quantile(samples, QUANTILES))
    return {"median": median, "low": low, "high": high, "count": len(samples)}


def _write_csv(path: Path, cases: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow((*COLUMNS, "median [s]", "2.5 % [s]", "97.5 % [s]", "samples"))
        for case in cases:
            known = [case[name.partition(" ")[0]] for name in COLUMNS[:-1]]
            for name, found in case["seconds"].items():
                writer.writerow([*known, name, *(found[key] for key in ("median", "low", "high", "count"))])


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


def _cost_of_timing(task: Task) -> Cost:
    array, samples = task.settings["array"], task.settings["samples"]
    antennas, channels = antenna_count(array.layout), array.channels
    vectors = basis_vectors(task.settings["longest"], channels, array.basis)
    baselines = antennas * (antennas - 1) // 2
    padded = 4 * vectors * baselines * channels.count
    work = baselines * channels.count / PAPER_SAMPLES
    solves = samples["solves"] * (0.4 + 1.3 * work)
    steps = PADDED_SECONDS * padded * samples["steps"] + 50 * ADAMAX_STEP * work * samples["calls"]
    dimensions = Dimensions(antennas, baselines, baselines, channels.count, vectors, baselines * vectors)
    memory = solve_memory(dimensions, Calamity()) + PADDED_COPIES * padded
    return Cost(30 + steps + solves, memory, 1e5)


def _cost_of_descent(task: Task) -> Cost:
    array = task.settings["array"]
    antennas = antenna_count(array.layout)
    baselines = antennas * (antennas - 1) // 2
    work = baselines * array.channels.count / PAPER_SAMPLES
    vectors = basis_vectors(task.settings["longest"], array.channels, array.basis)
    dimensions = Dimensions(antennas, baselines, baselines, array.channels.count, vectors, baselines * vectors)
    memory = solve_memory(dimensions, Calamity())
    return Cost(20 + ADAMAX_STEP * work * task.settings["max_steps"], memory, 1e6)


TIME_STEPS = Stage(name="step-times", version=4, make=time_steps, cost=_cost_of_timing)
COUNT_STEPS = Stage(name="descent", version=2, make=count_steps, cost=_cost_of_descent)
SUMMARIZE = Stage(name="runtime", version=2, make=summarize, cost=lambda task: Cost(1, disk=1e5))
