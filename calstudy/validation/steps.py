"""The steps of the validation ladder: each is a file with experiments, a measurement and criteria."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.package_files import published
from calstudy.base.schema import Section, fault
from calstudy.experiment.files import override, parse_override, validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment
from calstudy.experiment.yaml_files import read_mapping
from calstudy.validation.measurement import MEASUREMENTS, Measurement
from calstudy.verdicts.criterion import AtLeast, AtMost, Criterion, Equal, Threshold, Within

LADDER = published("experiments") / "validation"
"""Folder of the published steps."""
SCALES = ("full", "small")


class Must(Section):
    """The condition on a measured number: one of the four."""

    at_most: float | None = None
    at_least: float | None = None
    within: Annotated[tuple[float, float], Field(strict=False)] | None = Field(None, description="Between these two.")
    equal: float | None = Field(None, description="This, within `sigmas` times the uncertainty.")
    sigmas: float = Field(3.0, gt=0)

    @model_validator(mode="after")
    def _one_condition(self) -> Must:
        given = [name for name in ("at_most", "at_least", "within", "equal") if getattr(self, name) is not None]
        if len(given) != 1:
            raise fault("", "must have exactly one of at_most, at_least, within, equal")
        return self

    @property
    def threshold(self) -> Threshold:
        """The condition."""
        if self.at_most is not None:
            return AtMost(self.at_most)
        if self.at_least is not None:
            return AtLeast(self.at_least)
        if self.within is not None:
            return Within(*self.within)
        assert self.equal is not None
        return Equal(self.equal, self.sigmas)


class StepCriterion(Section):
    """One number that decides whether a step passes."""

    measures: str = Field(description="Name of the finding of the step's measurement.")
    quantity: str = Field(description="What that is, in words.")
    must: Must
    small: Must | None = Field(None, description="What it must be at small scale, where sampling errors are larger.")
    full_only: bool = Field(False, description="Whether it does not apply at small scale; `why` gives the reason.")
    why: str = Field(description="Why this threshold.")

    def condition(self, scale: str) -> Threshold:
        """Return the condition on the number at a scale."""
        return (self.small if scale == "small" and self.small is not None else self.must).threshold


class StepExperiment(Section):
    """One experiment of a step."""

    file: Path = Field(strict=False, description="The experiment file; a relative path starts at the step's file.")
    overrides: dict[str, Any] = Field(default_factory=dict, description="Fields to change (dotted path: value).")
    small: Path | None = Field(None, strict=False, description="The experiment file at small scale.")
    small_overrides: dict[str, Any] = Field(default_factory=dict, description="The same at small scale.")


class StepFile(Section):
    """One step of the ladder."""

    step: str = Field(pattern=r"^-?[0-9]+(\.[0-9]+)?$", description="Its number.")
    title: str
    proves: str
    measurement: str = Field(description="What is measured: a module of `calstudy.validation.measurements`, or a file.")
    parameters: dict[str, Any] = Field(default_factory=dict, description="Fields of the measurement.")
    small_parameters: dict[str, Any] = Field(default_factory=dict, description="Others of these at small scale.")
    experiments: dict[str, StepExperiment] = Field(default_factory=dict)
    criteria: Annotated[tuple[StepCriterion, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _one_criterion_per_finding(self) -> StepFile:
        names = [item.measures for item in self.criteria]
        if len(set(names)) != len(names):
            raise fault("criteria", f"names a finding twice: {', '.join(names)}")
        return self


@dataclass(frozen=True)
class Step:
    """One step at one scale, its measurement and experiments validated.

    `experiments` are by their names in the step, and `criteria` by the names of the findings that they judge. `scale`
    is "full" or "small".
    """

    name: str
    title: str
    proves: str
    measurement: Measurement
    experiments: Mapping[str, Experiment]
    criteria: Mapping[str, Criterion]
    scale: str


def load_step(path: Path, scale: str = "full", overrides: Sequence[str] = ()) -> Step:
    """Read one step of the ladder from its YAML file.

    Scale "small" selects the experiments and parameters under `small`. `overrides` are ``path=value`` texts, applied to
    every experiment after all other changes. Raises InputError if a file cannot be read, and ExperimentError if fields
    of the step or of an experiment are unknown, missing, or have values that are not allowed.
    """
    data = read_mapping(path)
    try:
        file = StepFile.model_validate(data)
    except ValidationError as error:
        raise ExperimentError([f"{path}: {sentence}" for sentence in sentences(error, StepFile, data)]) from None
    small, folder = scale == "small", path.resolve().parent
    parameters = {**file.parameters, **(file.small_parameters if small else {})}
    experiments = {
        name: _load_experiment(name, item, folder, small, overrides) for name, item in file.experiments.items()
    }
    criteria = {
        item.measures: Criterion(
            f"{file.step} {item.measures}", "", file.proves, item.quantity, item.condition(scale), item.why
        )
        for item in file.criteria
        if not (small and item.full_only)
    }
    measurement = _load_measurement(path, file.measurement, parameters)
    return Step(file.step, file.title, file.proves, measurement, experiments, criteria, scale)


def _load_measurement(path: Path, name: str, parameters: Mapping[str, Any]) -> Measurement:
    block = {**parameters, MEASUREMENTS.tag: name}
    try:
        return MEASUREMENTS.make(block, folder=path.resolve().parent)
    except InputError as error:
        raise ExperimentError([f"{path}: measurement: {error}"]) from None
    except ValidationError as error:
        faults = sentences(error, MEASUREMENTS.find(name), block)
        raise ExperimentError([f"{path}: parameters.{sentence}" for sentence in faults]) from None


def _load_experiment(name: str, item: StepExperiment, base: Path, small: bool, overrides: Sequence[str]) -> Experiment:
    file = item.small if small and item.small is not None else item.file
    path = base / file
    data = read_mapping(path)
    for dotted, value in (item.small_overrides if small else item.overrides).items():
        data = override(data, dotted, value)
    for text in overrides:
        data = override(data, *parse_override(text))
    try:
        return validate(data, path.resolve().parent)
    except ExperimentError as error:
        raise ExperimentError([f"experiments.{name} ({file}): {sentence}" for sentence in error.faults]) from None


def load_ladder(
    names: Sequence[str] = (), scale: str = "full", overrides: Sequence[str] = (), folder: Path = LADDER
) -> list[Step]:
    """Read the steps with these names from a folder, or all of them, in the order of their numbers; see `load_step`.

    Raises InputError as `load_step`, and if the folder contains no steps, or none of a given name.
    """
    if scale not in SCALES:
        raise InputError(f"--scale {scale}: not a scale of the ladder (allowed: {', '.join(SCALES)})")
    files = {str(read_mapping(path).get("step")): path for path in sorted(folder.glob("*.yaml"))}
    if not files:
        raise InputError(f"{folder}: holds no steps of the ladder")
    unknown = [name for name in names if name not in files]
    ordered = sorted(files, key=float)
    if unknown:
        raise InputError(f"{unknown[0]}: not a step of the ladder (there are: {', '.join(ordered)})")
    return [load_step(files[name], scale, overrides) for name in ordered if not names or name in names]
