"""Read experiment files: YAML, scales and overrides, validation, and input files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.package_files import find_experiment
from calstudy.base.paths import texts, value_at, with_value
from calstudy.base.plugins import FILE_REFERENCE
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.experiment.assumed import FIELD, SKY_MODEL, AssumedFile, assumed_changes, assumed_world
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment
from calstudy.instrument.interface import model_of
from calstudy.instrument.layouts import antenna_count
from calstudy.instrument.settings import InstrumentSettings, nominal_beams


# PyYAML comes with dask and pyuvdata. ruamel.yaml, for YAML 1.2, would be a second library for thirty lines less here,
# and reads 010 as ten and 6:24 as a text, which the fields of numbers would have to refuse.
class _Loader(yaml.SafeLoader):
    """Safe YAML that refuses duplicate keys and reads 1e-9 as a number (as YAML 1.2 does)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str) or key in keys:
                why = "appears twice" if isinstance(key, str) else "is not a text; put it in quotes"
                raise _refused(key_node, f"key {key!r} {why}")
            keys.add(key)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Safe YAML that quotes the texts which `_Loader` would read as numbers."""


_REAL = re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$")
for _side in (_Loader, _Dumper):
    _side.add_implicit_resolver("tag:yaml.org,2002:float", _REAL, list("-+0123456789."))
OCTAL = re.compile(r"[-+]?0[0-7_]+")


def _refused(node: yaml.Node, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def _number(loader: _Loader, node: yaml.ScalarNode) -> float:
    """Read a number; refuse texts that YAML 1.1 and a reader take for different numbers."""
    text, whole = str(node.value), node.tag.endswith(":int")
    number = loader.construct_yaml_int(node) if whole else loader.construct_yaml_float(node)
    if whole and OCTAL.fullmatch(text):
        hint = f"leave out the zero in front, or write {number} if that is meant"
        raise _refused(node, f"{text} is an octal number in YAML, {number}; {hint}")
    if ":" in text:
        hint = "write a number with a unit, such as 6.4 h"
        raise _refused(node, f"{text} is a number to the base 60 in YAML, {number:g}; {hint}")
    return number


def _date(loader: _Loader, node: yaml.ScalarNode) -> None:
    """Refuse a date, which no field takes: they are texts."""
    del loader
    raise _refused(node, f"{node.value} is a date in YAML; write it in quotes")


# Tags that YAML knows and no field takes are refused as those that it does not know.
_CONSTRUCTORS = dict.fromkeys(("binary", "set", "omap", "pairs"), _Loader.construct_undefined)
for _kind, _read in {**_CONSTRUCTORS, "timestamp": _date, "int": _number, "float": _number}.items():
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _read)


KINDS_OF_YAML: dict[type, str] = {list: "a list", str: "a text", int: "a number", float: "a number", bool: "a word"}
UNKNOWN_TAG = re.compile(r"could not determine a constructor for the tag '(.*)'")


def parse_yaml(text: str, origin: str) -> Any:
    """Parse YAML text; raises InputError with one sentence (origin, line, problem) if it is not valid."""
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        raise InputError(f"{origin}:{line} {_problem(error)}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{origin}: not valid YAML ({str(error).splitlines()[0]})") from None


def dump_yaml(content: Any, in_line: bool = False) -> str:
    """Return plain values as YAML that `parse_yaml` reads back as the same; if `in_line`, in brackets."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100, default_flow_style=in_line
    )


def _problem(error: yaml.MarkedYAMLError) -> str:
    tag = UNKNOWN_TAG.search(error.problem or "")
    if tag is None:
        return error.problem or "not valid YAML"
    if tag[1] == "tag:yaml.org,2002:merge":
        return "merge keys (<<) are not read; write the block out"
    return f"the tag {tag[1]} is refused: only texts, numbers, lists and blocks of keys are read, never objects"


def read_mapping(path: Path, example: str = "name: quickstart") -> dict[str, Any]:
    """Read a YAML file with a block of keys, such as the example; raises InputError for any other file."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file in UTF-8") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a file (YAML) of an experiment") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    data = parse_yaml(text, str(path))
    if not isinstance(data, dict):
        held = "is empty" if data is None else f"holds {KINDS_OF_YAML.get(type(data), 'something else')}"
        raise InputError(f"{path}: must hold a block of keys such as {example!r}, and {held}")
    return data


M = TypeVar("M", bound=BaseModel)
TAGS = {"solver": "name", "calibration": CALIBRATORS.tag}
"""Field that a bare string sets, where a block may be written as a string; elsewhere its `kind`."""
NAMES = ("calibrators", "kind", "study", *TAGS.values())
"""Keys of names, which are no paths even where a folder has such a name."""


def parse_override(text: str) -> tuple[str, Any]:
    """Split ``path=value`` of the option --set; the value is read as YAML."""
    path, equals, value = text.partition("=")
    if not equals or not all(map(str.strip, path.split("."))):
        raise InputError(f"--set {text}: write a dotted path and a value, such as --set instrument.times.count=8")
    return path.strip(), parse_yaml(value, f"--set {text}")


def override(data: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy of `data`, the content of an experiment file, with the field at the dotted path set to `value`.

    A list that is missing in the data, or a mapping of names such as ``variants``, starts as the default of an
    experiment; for the rest see `with_value`.
    """
    return with_value(data, path, value, _block_for)


def overridden(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of `data` with fields set by dotted path, one after the other; see `override`."""
    result = dict(data)
    for path, value in changes.items():
        result = override(result, path, value)
    return result


OF_NAMES = ("variants", "outputs.convergence.solvers")
"""Fields whose keys are names that a user chooses."""


def _block_for(path: str, given: Any) -> dict[str, Any] | list[Any] | None:
    """Return the block for a name that stands for it, or the default list, entries or empty block in place of none."""
    if isinstance(given, str):
        return {TAGS.get(path.rpartition(".")[2], "kind"): given}
    if given is not None:
        return None
    default = value_at(Experiment(name="default").model_dump(mode="json"), path)
    return default if isinstance(default, list) or path in OF_NAMES else {}


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Return the last word of each dotted path, or the last two where that alone would be ambiguous."""
    last = [path.rpartition(".")[2] for path in paths]
    return {
        path: word if last.count(word) == 1 else ".".join(path.split(".")[-2:])
        for path, word in zip(paths, last, strict=True)
    }


def apply_scale(data: Mapping[str, Any], scale: str | None) -> dict[str, Any]:
    """Return `data` with the overrides of the named scale applied; raises InputError if the file has no such scale."""
    if scale is None:
        return dict(data)
    scales = _scales(data)
    if scale not in scales:
        listed = f"the file has: {', '.join(scales)}" if scales else "the file has no scales"
        raise InputError(f"--scale {scale}: not a scale of this experiment{nearest(scale, list(scales))} ({listed})")
    return overridden(data, scales[scale])


def _scales(data: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    scales = data.get("scales")
    return (
        {name: found for name, found in scales.items() if isinstance(found, dict)} if isinstance(scales, dict) else {}
    )


def require_scales(
    content: Mapping[str, Any], check: Callable[[str | None], object], valid: Sequence[str | None] = ()
) -> None:
    """Raise ExperimentError if `check` refuses any scale of a file that it accepts without, for which it gets None.

    `valid` are scales, or None, that are known to be valid.
    """
    faults: list[str] = []
    names = _scales(content)
    for name in (None, *names) if names else ():
        try:
            if name not in valid:
                check(name)
        except InputError as error:
            if name is None:
                return  # The faults of the file itself are reported first.
            found = error.faults if isinstance(error, ExperimentError) else [str(error)]
            faults += [f"scales.{name}: {sentence}" for sentence in found]
    if faults:
        raise ExperimentError(faults)


def _require_known_antennas(
    instrument: InstrumentSettings, named: Mapping[str, Sequence[int]], prefix: str = ""
) -> None:
    """Raise ExperimentError if `named`, or a set of antennas with another beam, has an antenna that does not exist."""
    count = antenna_count(instrument.layout)
    built = instrument.as_built
    dead = built.dipoles.dead
    blocks: Mapping[str, Mapping[str, Any]] = {"antenna_beams": instrument.antenna_beams, "as_built.dipoles.dead": dead}
    groups = {
        f"{prefix}instrument.{field}.{name}.antennas": group.antennas
        for field, found in blocks.items()
        for name, group in found.items()
    }
    groups[f"{prefix}instrument.as_built.beams.swapped"] = built.beams.swapped
    faults = [
        f"{field}: names antenna {max(places)}, but the layout has {count} antennas, counted from 0"
        for field, places in {**named, **groups}.items()
        if max(places, default=-1) >= count
    ]
    without = [model_of(beam) for beam in nominal_beams(instrument) if not model_of(beam).dipoles]
    if built.dipoles.differ and without:
        field = f"{prefix}instrument.as_built.dipoles"
        faults.append(f"{field}: the beam {without[0].label!r} has no dipoles; use 'mwa-embedded-element'")
    if faults:
        raise ExperimentError(faults)


def _resolve_assumed(experiment: Experiment, base: Path) -> Experiment:
    """Check the assumptions of the calibrator, and make the paths of input files in them absolute."""
    changes = assumed_changes(experiment.calibration.assumed)
    if not changes:
        return experiment
    if SKY_MODEL in changes:
        resolved = {SKY_MODEL: checked(AssumedFile, changes, base, f"{FIELD}.").sky_model}
    else:
        world = assumed_world(experiment, base)
        _require_known_antennas(world.instrument, {}, f"{FIELD}.")
        content = world.model_dump(mode="json")
        resolved = {path: value_at(content, path) for path in changes}
    calibration = experiment.calibration.model_copy(update={"assumed": resolved})
    return experiment.model_copy(update={"calibration": calibration})


def checked(model: type[M], data: Mapping[str, Any], base: Path, prefix: str = "", files: bool = True) -> M:
    """Return the content of a file as a section; relative paths of plug-ins and input files start at the folder `base`.

    Input files must exist if `files`. Raises ExperimentError with one sentence per fault, after the prefix.
    """
    try:
        return model.model_validate(dict(data), context={"folder": base, "files": files})
    except ValidationError as error:
        raise ExperimentError([f"{prefix}{sentence}" for sentence in sentences(error, model, dict(data))]) from None


def validate(data: Mapping[str, Any], base: Path) -> Experiment:
    """Return the experiment of a file, with absolute paths of input files; parameters and errors as for `checked`."""
    experiment = checked(Experiment, data, base)
    inspected = [place for pair in experiment.outputs.inspect.pairs for place in pair]
    _require_known_antennas(experiment.instrument, {"outputs.inspect": inspected})
    return _resolve_assumed(experiment, base)


@dataclass(frozen=True)
class StudyFile:
    """The content of a file, and the scale and the ``path=value`` overrides of the command line, not yet applied."""

    path: Path
    content: Mapping[str, Any]
    scale: str | None = None
    overrides: Sequence[str] = ()
    base: Path | None = None

    @classmethod
    def open(cls, path: Path, scale: str | None = None, overrides: Sequence[str] = ()) -> StudyFile:
        """Read a file, given its path or the name of a published one; raises InputError if it cannot be read."""
        path = find_experiment(path)
        return cls(path, read_mapping(path), scale, overrides)

    @property
    def folder(self) -> Path:
        """The folder where relative paths start: that of the file, or `base`."""
        return self.base or self.path.resolve().parent

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
        data = self.changed()
        content = {**self.content, "scales": data.get("scales")}

        def check(scale: str | None) -> None:
            checked(Experiment, apply_scale(content, scale), self.folder, files=False)

        try:
            experiment = validate(data, self.folder)
        except ExperimentError:
            require_scales(content, check)
            raise
        require_scales(content, check, () if self.overrides else (self.scale,))
        return experiment


def with_absolute_paths(content: Any, read: Iterable[BaseModel], folder: Path) -> Any:
    """Return the content of a file with absolute paths, from a folder, of all files in what was `read` from it."""
    used = {text for item in read for text in texts(item.model_dump(mode="json")) if text.startswith("/")}

    def absolute(value: Any, at: str = "") -> Any:
        if isinstance(value, Mapping):
            # In place of a block of its settings, a calibrator may have its name alone.
            alone = at == "calibrators"
            return {key: absolute(item, at if alone and isinstance(item, str) else key) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(map(absolute, value))
        if isinstance(value, str):
            file = FILE_REFERENCE.fullmatch(value)
            if file is None and at in NAMES:
                return value
            path = value if file is None else file["path"]
            # A text that is no path may have no home folder, or characters that no path has.
            with suppress(RuntimeError, ValueError, OSError):
                found = f"{(folder / Path(path).expanduser()).resolve()}{value.removeprefix(path)}"
                return found if found in used else value
        return value

    return absolute(content)


def dump(content: BaseModel) -> str:
    """Return the content of a file as YAML; an experiment is read back as the same experiment."""
    return dump_yaml(content.model_dump(mode="json"))
