"""Read experiment files: scales and overrides, validation, and input files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.package_files import find_experiment
from calstudy.base.plugins import load_function
from calstudy.base.schema import FOLDER
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.experiment.assumed import FIELD, SKY_MODEL, AssumedWorld, assumed_changes, assumed_world, value_at
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment
from calstudy.experiment.yaml_files import parse_yaml, read_mapping
from calstudy.instrument.distinct_beams import nominal_beams
from calstudy.instrument.interface import model_of
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.size import antenna_count
from calstudy.sky.settings import SkySettings

M = TypeVar("M", bound=BaseModel)
TAGS = {"solver": "name", "calibration": CALIBRATORS.tag}
"""Field that a bare string sets, where a block may be written as a string; elsewhere its `kind`."""


def parse_override(text: str) -> tuple[str, Any]:
    """Split ``path=value`` of the option --set; the value is read as YAML."""
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise InputError(f"--set {text}: write a dotted path and a value, such as --set instrument.times.count=8")
    return path.strip(), parse_yaml(value, f"--set {text}")


def override(data: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy of `data`, the content of an experiment file, with the field at the dotted path set to `value`.

    Items of a list are counted from 0: ``corruption.effects.0.sigma``. A list that is missing in the data starts as the
    default of an experiment. Keys of the data may themselves be dotted paths, as those of ``calibration.assumed`` are.
    """
    result = deepcopy(dict(data))
    block: dict | list = result
    above: list[str] = []
    rest = path.split(".")
    while True:
        step, rest = _split(block, rest)
        key = _key(block, step, path)
        if not rest:
            block[key] = value
            return result
        above += step.split(".")
        inner = block.get(key) if isinstance(block, dict) else block[key]
        if isinstance(inner, str):
            inner = {TAGS.get(above[-1], "kind"): inner}
        elif inner is None:
            inner = (_default_items(above) if rest[0].isdigit() else None) or {}
        elif not isinstance(inner, dict | list):
            raise InputError(f"{path}: cannot be set, for {step!r} is {inner!r} and not a block of keys")
        block[key] = inner
        block = inner


def _split(block: dict | list, steps: list[str]) -> tuple[str, list[str]]:
    """Split a path after its first step, or, where a block has a dotted key of several steps, after these."""
    if isinstance(block, dict):
        for count in range(len(steps), 1, -1):
            if ".".join(steps[:count]) in block:
                return ".".join(steps[:count]), steps[count:]
    return steps[0], steps[1:]


def _key(block: dict | list, step: str, path: str) -> Any:
    """Return the key of a block, or the index in a list, for a step of a dotted path."""
    if isinstance(block, dict):
        return step
    if not step.isdigit() or int(step) >= len(block):
        raise InputError(
            f"{path}: cannot be set, for {step!r} is not an item of a list of {len(block)}, counted from 0"
        )
    return int(step)


def _default_items(steps: Sequence[str]) -> list[Any] | None:
    """Return the default of a field that is a list of blocks, as plain values; None for any other field."""
    section: type = Experiment
    value: Any = None
    for step in steps:
        field = section.model_fields.get(step) if issubclass(section, BaseModel) else None
        if field is None:
            return None
        value = field.get_default(call_default_factory=True)
        section = type(value)
    if not isinstance(value, tuple) or not all(isinstance(item, BaseModel) for item in value):
        return None
    return [item.model_dump(mode="json") for item in value]


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Return the last word of each dotted path, or the last two where that alone would be ambiguous."""
    last = [path.rpartition(".")[2] for path in paths]
    return {
        path: word if last.count(word) == 1 else ".".join(path.split(".")[-2:])
        for path, word in zip(paths, last, strict=True)
    }


def apply_scale(data: Mapping[str, Any], scale: str | None) -> dict[str, Any]:
    """Return `data` with the overrides of the named scale applied; raises InputError if the file has no such scale."""
    result = dict(data)
    if scale is None:
        return result
    scales = data.get("scales") or {}
    if not isinstance(scales, dict) or not isinstance(scales.get(scale), dict):
        names = list(scales) if isinstance(scales, dict) else []
        listed = f"the file has: {', '.join(names)}" if names else "the file has no scales"
        raise InputError(f"--scale {scale}: not a scale of this experiment{nearest(scale, names)} ({listed})")
    for path, value in scales[scale].items():
        result = override(result, path, value)
    return result


def _require_scales(data: Mapping[str, Any], base: Path) -> None:
    """Raise ExperimentError if any scale of the file, selected or not, has invalid overrides."""
    scales = data.get("scales")
    if not isinstance(scales, dict):
        return
    faults: list[str] = []
    try:
        Experiment.model_validate(data, context={"folder": base})
    except ValidationError:
        return  # The faults of the file itself are reported first.
    for name in [name for name, changes in scales.items() if isinstance(changes, dict)]:
        try:
            changed = apply_scale(data, name)
            Experiment.model_validate(changed, context={"folder": base})
        except ValidationError as error:
            faults += [f"scales.{name}: {sentence}" for sentence in sentences(error, Experiment, changed)]
        except InputError as error:
            faults.append(f"scales.{name}: {error}")
    if faults:
        raise ExperimentError(faults)


def input_files(section: BaseModel, prefix: str = "") -> Iterator[tuple[str, BaseModel, str]]:
    """Yield (dotted path, block, field) of every input file of the experiment."""
    for field in type(section).model_fields:
        value, path = getattr(section, field), f"{prefix}{field}"
        if isinstance(value, BaseModel) and field != "outputs":
            yield from input_files(value, f"{path}.")
        elif isinstance(value, Mapping | tuple):
            for name, block in value.items() if isinstance(value, Mapping) else enumerate(value):
                if isinstance(block, BaseModel):
                    yield from input_files(block, f"{path}.{name}.")
        elif isinstance(value, Path):
            yield path, section, field


def expand_user(path: Path, field: str) -> Path:
    """Replace a leading ~ by the home folder.

    Raises InputError, with the field, if there is no such user, or if no file can have this name.
    """
    if "\0" in str(path):
        raise InputError(f"{field} = {str(path)!r}: no file can have this name")
    try:
        return path.expanduser()
    except RuntimeError:
        raise InputError(f"{field} = {str(path)!r}: there is no such home folder") from None


def _resolve_files(data: dict[str, Any], experiment: Experiment, base: Path) -> Experiment:
    """Make the paths of input files absolute, relative to `base`, and check that the files can be read."""
    resolved = _absolute(data, experiment, experiment.sky, base)
    resolved_experiment = Experiment.model_validate(resolved, context={"folder": base})
    _require_function(resolved_experiment.sky)
    for name in ("store", "runs"):
        expand_user(getattr(experiment.outputs, name), f"outputs.{name}")
    inspected = [place for pair in experiment.outputs.inspect.pairs for place in pair]
    _require_known_antennas(resolved_experiment.instrument, {"outputs.inspect": inspected})
    return resolved_experiment


def _absolute(
    data: dict[str, Any], section: BaseModel, sky: SkySettings, base: Path, prefix: str = ""
) -> dict[str, Any]:
    """Return plain values with absolute paths of input files; raises ExperimentError if one is missing.

    `section` are the same values, validated, and `sky` is the sky that belongs to them. Relative paths start at `base`.
    `prefix` is the path of the section in the experiment file, with a dot at the end, or empty.
    """
    faults, resolved = [], data
    if sky.foregrounds.kind == "gleam" and sky.foregrounds.path is None:
        from calstudy.sky.catalogue import gleam_path

        resolved = override(resolved, "sky.foregrounds.path", str(gleam_path()))
        if not gleam_path().is_file():
            raise ExperimentError(
                [
                    f"{prefix}sky.foregrounds: GLEAM is not on this machine (looked for {gleam_path()}); get it with "
                    "'calstudy data fetch gleam', give a file under sky.foregrounds.path, or use 'g4jy-and-counts'"
                ]
            )
    for path, block, field in input_files(section):
        target = getattr(block, field)
        file = base / expand_user(target, f"{prefix}{path}")
        resolved = override(resolved, path, str(file.resolve()))
        folder = type(block).model_fields[field].json_schema_extra == FOLDER
        faults += _missing(f"{prefix}{path}", target, file, folder)
    if faults:
        raise ExperimentError(faults)
    return resolved


def _missing(field: str, given: Any, file: Path, folder: bool = False) -> list[str]:
    """Return a sentence if a file, or a folder, of a field is missing or cannot be accessed."""
    try:
        found = file.is_dir() if folder else file.is_file()
    except OSError as error:
        return [f"{field} = {str(given)!r}: cannot be read ({error.strerror}; looked for {file})"]
    kind = "folder" if folder else "file"
    return [] if found else [f"{field} = {str(given)!r}: no such {kind} (looked for {file})"]


def _require_function(sky: SkySettings, prefix: str = "") -> None:
    if sky.foregrounds.kind == "code":
        try:
            load_function(sky.foregrounds.path, sky.foregrounds.function)
        except InputError as error:
            raise ExperimentError([f"{prefix}sky.foregrounds: {error}"]) from None


def _require_known_antennas(
    instrument: InstrumentSettings, named: Mapping[str, Sequence[int]], prefix: str = ""
) -> None:
    """Raise ExperimentError if `named`, or a set of antennas with another beam, has an antenna that does not exist."""
    count = antenna_count(instrument.layout)
    groups = {
        f"{prefix}instrument.antenna_beams.{name}.antennas": group.antennas
        for name, group in instrument.antenna_beams.items()
    } | {
        f"{prefix}instrument.as_built.dipoles.dead.{name}.antennas": tiles.antennas
        for name, tiles in instrument.as_built.dipoles.dead.items()
    }
    if instrument.as_built.beams.swapped:
        groups[f"{prefix}instrument.as_built.beams.swapped"] = instrument.as_built.beams.swapped
    faults = [
        f"{field}: names antenna {max(places)}, but the layout has {count} antennas, counted from 0"
        for field, places in {**named, **groups}.items()
        if max(places) >= count
    ]
    without = [model_of(beam) for beam in nominal_beams(instrument) if not model_of(beam).dipoles]
    if instrument.as_built.dipoles.differ and without:
        field = f"{prefix}instrument.as_built.dipoles"
        faults.append(f"{field}: the beam {without[0].label!r} has no dipoles; use 'mwa-embedded-element'")
    if faults:
        raise ExperimentError(faults)


def _resolve_assumed(experiment: Experiment, base: Path) -> Experiment:
    """Check the assumptions of the calibrator, and make the paths of input files in them absolute."""
    changes = assumed_changes(experiment.calibration.assumed)
    if not changes:
        return experiment
    prefix = f"{FIELD}."
    if SKY_MODEL in changes:
        file = base / expand_user(Path(changes[SKY_MODEL]), f"{prefix}{SKY_MODEL}")
        if faults := _missing(f"{prefix}{SKY_MODEL}", changes[SKY_MODEL], file):
            raise ExperimentError(faults)
        resolved = {SKY_MODEL: file.resolve()}
    else:
        world = assumed_world(experiment, base)
        content = _absolute(world.model_dump(mode="json"), world, world.sky, base, prefix)
        resolved_world = AssumedWorld.model_validate(content)
        _require_known_antennas(resolved_world.instrument, {}, prefix)
        _require_function(resolved_world.sky, prefix)
        resolved = {path: value_at(content, path) for path in changes}
    calibration = experiment.calibration.model_copy(update={"assumed": resolved})
    return experiment.model_copy(update={"calibration": calibration})


def checked(model: type[M], data: Mapping[str, Any], base: Path) -> M:
    """Return the content of a file as a section; relative paths of plug-ins start at the folder `base`.

    Raises ExperimentError with one sentence per fault: the field's dotted path, the value, and the allowed values.
    """
    try:
        return model.model_validate(dict(data), context={"folder": base})
    except ValidationError as error:
        raise ExperimentError(sentences(error, model, dict(data))) from None


def validate(data: Mapping[str, Any], base: Path) -> Experiment:
    """Return the experiment of a file, with absolute paths of input files; parameters and errors as for `checked`."""
    return _resolve_assumed(_resolve_files(dict(data), checked(Experiment, data, base), base), base)


@dataclass(frozen=True)
class StudyFile:
    """The content of a file, and the scale and the ``path=value`` overrides of the command line, not yet applied."""

    path: Path
    content: Mapping[str, Any]
    scale: str | None = None
    overrides: Sequence[str] = ()

    @classmethod
    def open(cls, path: Path, scale: str | None = None, overrides: Sequence[str] = ()) -> StudyFile:
        """Read a file, given its path or the name of a published one; raises InputError if it cannot be read."""
        path = find_experiment(path)
        return cls(path, read_mapping(path), scale, overrides)

    @property
    def folder(self) -> Path:
        """The folder where relative paths start."""
        return self.path.resolve().parent

    def changed(self) -> dict[str, Any]:
        """Return the content with scale and overrides applied; raises InputError if one cannot be applied."""
        data = apply_scale(self.content, self.scale)
        for text in self.overrides:
            data = override(data, *parse_override(text))
        return data

    def read(self, model: type[M]) -> M:
        """Return the changed content as a section; errors as for `changed` and `checked`."""
        return checked(model, self.changed(), self.folder)

    def experiment(self) -> Experiment:
        """Return the changed content as an experiment, of which all scales are valid; errors as for `read`."""
        _require_scales(self.content, self.folder)
        data = self.changed()
        if data.get("scales") != self.content.get("scales"):
            _require_scales({**self.content, "scales": data["scales"]}, self.folder)
        return validate(data, self.folder)


def load(path: Path, scale: str | None = None, overrides: Sequence[str] = ()) -> Experiment:
    """Read and validate an experiment file.

    Parameters
    ----------
    path
        The YAML file.
    scale
        Name of a set of overrides in the file's `scales`.
    overrides
        ``path=value`` texts, applied after the scale.

    Raises
    ------
    InputError
        If the file cannot be read or an override cannot be applied.
    ExperimentError
        If fields are unknown or missing, or have invalid values.
    """
    return StudyFile.open(path, scale, overrides).experiment()


def dump(content: BaseModel) -> str:
    """Return the content of a file as YAML; an experiment is read back by `load` as the same experiment."""
    return yaml.safe_dump(content.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=100)
