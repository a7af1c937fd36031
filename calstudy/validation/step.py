"""Steps of the validation ladder: what each proves, its experiments, and the limits of the numbers that it measures.

The built-in ones are the modules of `calstudy.validation.steps`; a user's own is the path of a Python file.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, NamedTuple, cast

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.files import json_number
from calstudy.base.plugins import Plugin, Registry, guarded
from calstudy.base.resources import Cost
from calstudy.base.schema import UNKEYED
from calstudy.claims.bins import clustered_mean
from calstudy.corrupt.levels import Levels
from calstudy.experiment.model import Experiment
from calstudy.power.cosmology import input_power
from calstudy.power.spectra import DelaySpectra
from calstudy.products.corruption import LEVELS
from calstudy.products.files import read_json, write_json
from calstudy.products.graph import Graph
from calstudy.products.spectra import read_delay_spectra
from calstudy.results.reader import Tables
from calstudy.run.task import Inputs, Task
from calstudy.verdicts.criterion import Criterion, Finding, Threshold, Verdict
from calstudy.verdicts.statement import Unevaluated

STEPS: Registry[Step] = Registry("step", "calstudy.validation.steps", "calstudy.validation.step:Step", families=True)
FINDINGS = "measurement.json"
CHAIN = "validation/small/chain.yaml"
"""The experiment of all steps at small scale."""


class Case(NamedTuple):
    """An experiment of a step: the published file, or any other; at small scale `CHAIN` with other overrides."""

    file: str
    overrides: Mapping[str, Any] = {}
    small: Mapping[str, Any] = {}


MINREDUNDANT = Case("minredundant.yaml")
SIXTEEN = {"instrument.layout": "mwa-compact-hex-east", "instrument.layout.count": 16}
REDUNDANT = Case("redundant.yaml", small={**SIXTEEN, "power.pairs": "redundant-group"})


class Limit(NamedTuple):
    """The condition on a number, in words and as a threshold, and the reason for it.

    At small scale, where sampling errors are larger, it may be another, or none ("full scale only").
    """

    quantity: str
    threshold: Threshold
    why: str
    small: Threshold | Literal["the same", "full scale only"] = "the same"


@dataclass(frozen=True)
class Findings:
    """Numbers with their uncertainties, by the names of the step's limits, and remarks on them."""

    values: Mapping[str, Finding]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class StepInput(Tables):
    """What a step reads of one of its experiments: the sections that it names, and `products` by its names for them."""

    experiment: Experiment
    products: Mapping[str, Path]

    @property
    def levels(self) -> Levels:
        """The levels of the components, from the product "levels"."""
        return Levels(**read_json(self.products["levels"] / LEVELS))

    @property
    def flux_scale(self) -> float | None:
        """The flux scale of the calibration, from the transfer function; None if it is not known."""
        try:
            scale = self.transfer("outside-wedge").flux_scale
        except Unevaluated:
            return None
        return scale if np.isfinite(scale) else None

    def input_power(self, k: np.ndarray) -> np.ndarray:
        """Return the input P(k), scaled as the data are, mK^2 h^-3 Mpc^3, at `k` in h/Mpc."""
        power = input_power(self.experiment.sky.eor, k, self.experiment.power.cosmology)
        return self.levels.eor_factor**2 * power

    def delay_spectra(self, product: str) -> DelaySpectra:
        """Return the delay spectra of a `power` product."""
        return read_delay_spectra(self.products[product])


class Step(Plugin):
    """Base class of the steps; fields of subclasses are parameters of their measurements.

    Attributes
    ----------
    number, proves : its place in the ladder, such as "2.1", and what it proves, in words
    experiments : the experiments on whose products it measures, by name
    sections : those of the experiments that the measurement itself reads, not those that only affect products
    parameters, small_parameters : values of the fields, and others of these at small scale
    limits : the conditions on its numbers, by name
    """

    registry: ClassVar = STEPS
    number: ClassVar[str] = ""
    proves: ClassVar[str] = ""
    experiments: ClassVar[Mapping[str, Case]] = {}
    sections: ClassVar[tuple[str, ...]] = ()
    parameters: ClassVar[Mapping[str, Any]] = {}
    small_parameters: ClassVar[Mapping[str, Any]] = {}
    limits: ClassVar[Mapping[str, Limit]] = {}

    kind: str
    scale: Literal["full", "small"] = Field("full", json_schema_extra=UNKEYED)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the products of one experiment that the measurement reads, by names of its own."""
        return {}

    @abstractmethod
    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Measure on the experiments, and write figures and tables, if any, to the folder `output`."""

    @property
    def criteria(self) -> dict[str, Criterion]:
        """The limits that apply at the scale of the step."""
        found = {}
        for name, limit in self.limits.items():
            threshold = limit.threshold if self.scale == "full" or limit.small == "the same" else limit.small
            if not isinstance(threshold, str):
                texts = (f"{self.number} {name}", "", self.proves, limit.quantity)
                found[name] = Criterion(*texts, threshold, limit.why)
        return found

    def judge(self, findings: Mapping[str, Mapping[str, float | None]]) -> list[Verdict]:
        """Return the verdicts on measured numbers, as `Validate` writes them: null if not finite."""
        runs, verdicts = (", ".join(self.experiments) or self.label,), []
        for name, criterion in self.criteria.items():
            if name in findings:
                value, uncertainty = (math.nan if item is None else item for item in findings[name].values())
                verdicts.append(criterion.judge(Finding(value, uncertainty), runs))
            else:
                verdicts.append(criterion.unevaluated("not measured", runs))
        return verdicts


def only(runs: Mapping[str, StepInput]) -> StepInput:
    """Return the input of the single experiment of a step."""
    (run,) = runs.values()
    return run


def largest(values: Iterable[float]) -> float:
    """Return the largest of some numbers, NaN if one of them is NaN, so that it cannot pass."""
    return float(np.max(list(values)))


def mean_over(values: np.ndarray, used: np.ndarray) -> Finding:
    """Return `clustered_mean` over the modes used, (Nunits, Nmodes) bool; NaN if one of them is not finite."""
    if not np.isfinite(values[used]).all():
        return Finding(math.nan, math.nan)
    return clustered_mean(np.where(used, values, np.nan))


def required(task: Task | None, what: str) -> Task:
    """Return a task, or raise InputError if the experiment does not have it."""
    if task is None:
        raise InputError(f"the measurement needs {what}, which the experiment does not have")
    return task


def inputs_of(step: Step, experiment: Experiment) -> Mapping[str, Task]:
    """Return the products of an experiment that a step reads; raises InputError if it lacks one."""
    try:
        with guarded(step):
            return step.inputs(Graph(experiment))
    except InputError as error:
        raise InputError(f"step {step.number}: {experiment.name}: {error}") from None


def step_task(step: Step, experiments: Mapping[str, Experiment]) -> Task:
    """Return the task that measures a step; raises InputError if an experiment lacks a product."""
    return Validate(
        f"step {step.number}",
        measurement=step,
        version=step.version,
        experiments={
            name: {section: getattr(experiment, section) for section in step.sections}
            for name, experiment in experiments.items()
        },
        products={
            f"{name}:{product}": task
            for name, experiment in experiments.items()
            for product, task in inputs_of(step, experiment).items()
        },
    )


class Validate(Task, stage="validate", version=4, cost=Cost(60, 3e9, 1e6)):
    """The numbers of a step, measured on the sections of its experiments and their products."""

    measurement: Step
    version: int
    experiments: Mapping[str, Mapping[str, Any]]
    products: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the numbers to measurement.json, with the figures and tables of the step.

        Raises InputError if a user's own step fails, or does not return Findings.
        """
        step, runs = self.measurement, {}
        for name, sections in self.experiments.items():
            start = f"{name}:"
            products = {key.removeprefix(start): path for key, path in self.products.items() if key.startswith(start)}
            experiment = cast(Experiment, SimpleNamespace(name=name, **sections))
            runs[name] = StepInput(tuple(products.values()), experiment, products)
        with guarded(step):
            found = step.measure(runs, output)
        if not isinstance(found, Findings):
            raise InputError(f"{step.label}: its measure returned a {type(found).__name__}, expected Findings")
        findings = {
            name: {"value": json_number(finding.value), "uncertainty": json_number(finding.uncertainty)}
            for name, finding in found.values.items()
        }
        write_json(output / FINDINGS, {"findings": findings, "remarks": list(found.remarks)})
        return {"findings": findings}
