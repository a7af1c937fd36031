"""Stages of a run-time study: measurements, their table, and the figures."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.bench.scaling import QUANTILES, RuntimeSeries, summarize_runtime
from calstudy.bench.step_times import Samples, descend_apart, time_steps_apart
from calstudy.claims.run_times import RUNTIME
from calstudy.stages.files import read_json, write_json
from calstudy.stages.registry import Job

CASE, LOSSES = "case.json", "losses.npz"
EXCESSES = ("0.05", "0.01", "0.002")
"""Fractions above the minimum to which steps are counted."""
SHOWN = {
    "paper-step": "paper's Adamax, step",
    "adamax-step": "our Adamax, step",
    "default-step": "default solver, step",
    "default-solve": "default solver, solve",
}
"""What the figures show of what was timed."""
AXES = {"rows": ("number of antennas", r"N_\mathrm{ant}"), "line": ("longest baseline (m)", r"b_\mathrm{max}")}
CLOCKS = {"cpu": "one core", "gpu": "GPU"}
COLUMNS = ("panel", "size", "device", "antennas", "baselines", "longest [m]", "vectors", "coefficients", "timed")


def time_steps(job: Job) -> Mapping[str, Any]:
    """Time all solvers on one array, in a process of its own."""
    settings = job.settings
    found = asdict(time_steps_apart(settings["array"], Samples(**settings["samples"]), settings["device"]))
    case = {name: settings[name] for name in ("panel", "size", "device", "machine")}
    write_json(job.output / CASE, {**case, **found})
    return {f"median {name}": float(np.median(samples)) for name, samples in found["seconds"].items()}


def count_steps(job: Job) -> Mapping[str, Any]:
    """Run the paper's solver for all its steps, and count how many it needs."""
    found = descend_apart(job.settings["array"], job.settings["max_steps"])
    np.savez(job.output / LOSSES, allow_pickle=False, losses=found.losses, floor=found.floor)
    counted = {
        "antennas": found.antennas,
        "max_steps": job.settings["max_steps"],
        "steps_to": {excess: found.steps_to(float(excess)) for excess in EXCESSES},
        "best": float(found.losses.min() / found.floor - 1),
    }
    write_json(job.output / "descent.json", counted)
    return counted


def summarize(job: Job) -> Mapping[str, Any]:
    """Write runtime.json and runtime.csv: medians and the ends of the central 95 % of all that was timed."""
    cases = [read_json(folder / CASE) for name, folder in sorted(job.inputs.items()) if name != "descent"]
    descent = read_json(job.inputs["descent"] / "descent.json")
    for case in cases:
        del case["machine"]
        case["seconds"] = {name: _quantiles(samples) for name, samples in case["seconds"].items()}
    write_json(job.output / RUNTIME, {"machine": job.settings["machine"], "cases": cases, "descent": descent})
    _write_csv(job.output / "runtime.csv", cases)
    return {}


def _quantiles(samples: Sequence[float]) -> dict[str, float]:
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


def draw(job: Job) -> Mapping[str, Any]:
    """Draw the time per step against the number of antennas, or against the longest baseline."""
    from calstudy.figures.runtime import draw_runtime
    from calstudy.figures.save import figure_arrays, save_figure

    panel = job.settings["panel"]
    series = _series([read_json(folder / CASE) for folder in job.inputs.values()])
    label, symbol = AXES[panel]
    clock = "time" if len(series) > len(SHOWN) else "processor time"
    figure = draw_runtime(series, label, symbol, job.settings["notes"], f"{clock} per step, or solve (s)")
    save_figure(figure, figure_arrays(series), job.output, f"runtime-{panel}")
    return {item.label: f"{item.fit.exponent:.2f} ± {item.fit.error:.2f}" for item in series}


def _series(cases: Sequence[Mapping[str, Any]]) -> list[RuntimeSeries]:
    """Return what is shown, solver after solver, for each device."""
    devices = sorted({case["device"] for case in cases})
    series = []
    for device in devices:
        found = sorted((case for case in cases if case["device"] == device), key=lambda case: case["size"])
        sizes = [case["size"] for case in found]
        for kind, label in SHOWN.items():
            told = label if len(devices) == 1 else f"{label}, {CLOCKS[device]}"
            series.append(summarize_runtime(told, sizes, [case["seconds"][kind] for case in found]))
    return series
