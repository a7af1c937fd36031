"""The stages by name: where their code is, and its version.

A version is raised when the stage's results change, so that products of older code are not taken for new ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a stage is given to make one product.

    Attributes
    ----------
    settings
        The part of the experiment that it reads, as in `calstudy.graph.tasks.Task`.
    inputs
        Folders of the products it reads.
    output
        Empty folder to put its files in.
    """

    settings: Mapping[str, Any]
    inputs: Mapping[str, Path]
    output: Path


@dataclass(frozen=True)
class Stage:
    """A stage's code, imported only when it runs, and the version of its results."""

    module: str
    function: str
    version: int

    def load(self) -> Callable[[Job], Mapping[str, Any]]:
        """Import and return the function that makes a product and returns JSON-able notes about it."""
        return getattr(import_module(f"calstudy.stages.{self.module}"), self.function)


STAGES: Mapping[str, Stage] = {
    "simulate-chunk": Stage("simulation", "simulate_chunk_product", 1),
    "simulate": Stage("simulation", "assemble_product", 1),
    "gains": Stage("corruption", "draw_gains", 1),
    "levels": Stage("corruption", "measure_levels", 1),
    "corrupt": Stage("corruption", "corrupt", 1),
    "calibrate-chunk": Stage("calibration", "calibrate_chunk", 3),
    "calibrate": Stage("calibration", "assemble", 1),
    "average": Stage("power", "average", 1),
    "power": Stage("power", "estimate", 1),
    "spectra": Stage("power", "spectra", 1),
    "difference": Stage("signal_loss", "difference", 1),
    "transfer": Stage("signal_loss", "transfer", 1),
    "transfer-figure": Stage("signal_loss", "draw", 1),
    "expected-loss": Stage("expected_loss", "expect", 1),
    "expected-loss-figure": Stage("expected_loss", "draw", 1),
    "convergence": Stage("convergence", "follow", 2),
    "convergence-figure": Stage("convergence", "draw", 1),
    "sweep": Stage("sweep", "summarize", 1),
    "agreement": Stage("agreement", "measure", 1),
    "claims": Stage("claims", "evaluate", 3),
    "combined-claims": Stage("claims", "evaluate_combined", 3),
    "step-times": Stage("runtime", "time_steps", 3),
    "descent": Stage("runtime", "count_steps", 1),
    "runtime": Stage("runtime", "summarize", 1),
    "runtime-figure": Stage("runtime", "draw", 1),
    "runtime-claims": Stage("claims", "evaluate_run_times", 1),
    "figure": Stage("figures", "draw", 1),
    "combined-figure": Stage("combined_figures", "draw", 1),
    "validate": Stage("validation", "measure", 2),
}
