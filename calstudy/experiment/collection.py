"""What a collection file says: several experiments that are run together, share products, and are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from calstudy.claims.facts import ExperimentRole
from calstudy.errors import ExperimentError, InputError
from calstudy.experiment.files import apply_scale, load, override, parse_override, read_mapping, validate
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment
from calstudy.experiment.runtime import KEY, RuntimeStudy, validate_runtime
from calstudy.schema import Section, choice, fault

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
CombinedFigure = Literal["layouts", "spherical-comparison"]
USUAL_MEMBERS: dict[ExperimentRole, str] = {
    "minimally_redundant": "minredundant",
    "redundant": "redundant",
    "redundant_modelling": "redundant-modelling",
    "low_snr": "lowsnr",
    "paper_solver": "paper-solver",
}
"""Members that play the roles if the file says nothing else."""
COMPARED: tuple[ExperimentRole, ...] = ("minimally_redundant", "redundant")


class Member(Section):
    """One experiment of the collection; its file name alone stands for it."""

    file: Path = Field(strict=False, description="The experiment file; a relative path starts at the collection file.")
    name: str | None = Field(None, pattern=NAME, description="Replaces the experiment's own name.")
    overrides: dict[str, Any] = Field(default_factory=dict, description="Fields to change (dotted path: value).")


class CollectionFile(Section):
    """Several experiments that are run together, share products, and are compared."""

    name: str = Field(pattern=NAME, description="Names the folder of the combined figures and claims.")
    description: str = ""
    experiments: Annotated[tuple[Annotated[Member, choice("file")], ...], Field(strict=False, min_length=1)] = Field(
        description="Experiment files, each with its own run folder."
    )
    figures: Annotated[tuple[CombinedFigure, ...], Field(strict=False)] = ()
    roles: dict[ExperimentRole, str] = Field(
        default_factory=dict, description="Which member is which run of the paper, where its name does not say so."
    )

    @model_validator(mode="after")
    def _names_no_one_twice(self) -> CollectionFile:
        names = [member.name for member in self.experiments if member.name]
        for name in names:
            if names.count(name) > 1:
                raise fault("experiments", f"gives the name {name!r} twice")
        return self


@dataclass(frozen=True)
class Collection:
    """A collection whose members are validated.

    Attributes
    ----------
    name, description
        As in the file.
    members
        The experiments by name, in the order of the file; all with the same store and folder of runs.
    roles
        Members by the part they play in the paper.
    figures
        Combined figures.
    """

    name: str
    description: str
    members: Mapping[str, Experiment]
    roles: Mapping[ExperimentRole, str]
    figures: tuple[CombinedFigure, ...]

    @property
    def outputs(self) -> Any:
        """Store and folder of runs, the same for all members."""
        return next(iter(self.members.values())).outputs


def load_study(
    path: Path, scale: str | None = None, overrides: Sequence[str] = ()
) -> Experiment | Collection | RuntimeStudy:
    """Read an experiment, a collection or a run-time study, whichever the file holds.

    Parameters
    ----------
    path
        The YAML file; one with the key `experiments` is a collection, one with `runtime` a run-time study.
    scale, overrides
        As for `calstudy.experiment.files.load`; those of a collection go to every member.

    Raises
    ------
    InputError
        If a file cannot be read, or a scale or override cannot be applied.
    ExperimentError
        If fields are unknown, missing, or hold values that are not allowed.
    """
    data = read_mapping(path)
    if KEY in data:
        return validate_runtime(data, scale, overrides)
    if "experiments" not in data:
        return load(path, scale, overrides)
    try:
        file = CollectionFile.model_validate(data)
    except ValidationError as error:
        raise ExperimentError(sentences(error, CollectionFile, data)) from None
    members = _load_members(file, path.resolve().parent, scale, overrides)
    roles = _roles(file, members)
    for figure in file.figures:
        missing = [role for role in COMPARED if role not in roles]
        if missing:
            raise ExperimentError(
                [f"figures: asks for {figure!r}, which needs a member in the role(s) {', '.join(missing)}"]
            )
    return Collection(file.name, file.description, members, roles, file.figures)


def _load_members(
    file: CollectionFile, base: Path, scale: str | None, overrides: Sequence[str]
) -> dict[str, Experiment]:
    members: dict[str, Experiment] = {}
    faults = []
    for index, member in enumerate(file.experiments):
        path = member.file.expanduser() if member.file.expanduser().is_absolute() else base / member.file
        try:
            experiment = _load_member(member, path, scale, overrides)
        except ExperimentError as error:
            faults += [f"experiments.{index} ({member.file}): {sentence}" for sentence in error.faults]
            continue
        except InputError as error:
            raise InputError(f"experiments.{index} ({member.file}): {error}") from None
        if experiment.name in members:
            faults.append(f"experiments.{index}: a second {experiment.name!r}; give it a `name` of its own")
        members[experiment.name] = experiment
    if faults:
        raise ExperimentError(faults)
    first, *others = members.values()
    for experiment in others:
        for field in ("store", "runs"):
            if getattr(experiment.outputs, field) != getattr(first.outputs, field):
                raise ExperimentError(
                    [
                        f"experiments: {experiment.name} and {first.name} have different outputs.{field}; members "
                        f"share one (--set outputs.{field}=DIR sets it for all)"
                    ]
                )
    return members


def _load_member(member: Member, path: Path, scale: str | None, overrides: Sequence[str]) -> Experiment:
    data = read_mapping(path)
    if "experiments" in data:
        raise InputError("is a collection itself; members must be experiments")
    data = apply_scale(data, scale)
    for dotted, value in member.overrides.items():
        data = override(data, dotted, value)
    if member.name:
        data["name"] = member.name
    for text in overrides:
        data = override(data, *parse_override(text))
    experiment = validate(data, path.resolve().parent)
    if experiment.sweep:
        raise InputError("has a sweep; run it by itself, or leave the sweep out with overrides: {sweep: []}")
    return experiment


def _roles(file: CollectionFile, members: Mapping[str, Experiment]) -> dict[ExperimentRole, str]:
    """Return who plays which role; raises ExperimentError if a member is named that is not there or cannot play it."""
    roles = {role: name for role, name in USUAL_MEMBERS.items() if name in members} | file.roles
    for role, name in roles.items():
        if name not in members:
            raise ExperimentError([f"roles.{role} = {name!r}: not a member (there are: {', '.join(members)})"])
        wanted = "reflection" if role == "low_snr" else "per-channel"
        found = members[name].corruption.gains.kind
        if found != wanted:
            raise ExperimentError(
                [f"roles.{role} = {name!r}: its corruption.gains are {found!r}, this role needs {wanted!r}"]
            )
    return roles
