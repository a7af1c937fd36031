"""Every field of an experiment changes the key of some product, or is known not to, for a reason."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic_core import to_jsonable_python

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.plugins import Plugin
from calstudy.base.schema import Section
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.experiment.files import override, validate
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.validation.step import Step

BASE: dict[str, Any] = {
    "name": "fields",
    "instrument": {"layout": {"kind": "hex", "side": 2}, "beam": "gaussian"},
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 10}},
    "papers": ["calamity2022"],
}
TAGS = ("kind", "calibrator", "name")
REQUIRED: dict[str, Any] = {
    "coordinates": {"latitude": "10 deg", "longitude": "20 deg"},
    "DpssSmoothing": {"frequency_scale": "1 MHz", "time_scale": "1 min"},
    "PolynomialSmoothing": {"frequency_degree": 1, "time_degree": 1},
    "g4jy-and-counts": {"spectrum": "catalogue"},
    "Eor": {"spectrum": "power-law"},
    "mutual-coupling": {"autos": None},
    "Autocorrelations": {"effective_area": "100 m2"},
    "ForegroundPrior": {"mean": "sky-model", "deviation": 1.0, "shared_deviation": 1.0},
}
"""What blocks need besides their names, or to have all their fields."""
OTHER: dict[str, list[Any]] = {
    "EngineAgreementFigure.against": ["fftvis"],
    "EngineAgreementFigure.node_tolerance": [1e-6],
    "InstrumentSettings.antenna_beams": [{"set": {"antennas": [0], "beam": "airy"}}],
    "InstrumentSettings.polarizations": [["yy"]],
    "DipoleErrors.dead": [{"set": {"antennas": [0], "x": [1]}}],
    "BeamErrors.swapped": [[0]],
    "DeadAntennas.antennas": [[1]],
    "Bandpass.time": ["1 min"],
    "_Drift.antennas": [[1]],
    "ReflectionGains.antennas": [[1]],
    "Swing.antennas": [[1]],
    "RadiometerNoise.seeds": [[55, 56]],
    "NoiseRelativeToEor.seeds": [[55, 56]],
    "NoiseRelativeToForegrounds.seeds": [[55, 56]],
    "RadiometerNoise.seeds_without_eor": [[57, 58]],
    "NoiseRelativeToEor.seeds_without_eor": [[57, 58]],
    "NoiseRelativeToForegrounds.seeds_without_eor": [[57, 58]],
    "RadiometerNoise.effective_area": ["100 m2"],
    "Calibrator.assumed": [{"sky": {"foregrounds": {"count": 5}}}],
    "GainFit.gain_delay": ["500 ns"],
    "BaselineRange.longest": ["100 m"],
    "BaselineRange.taper": ["100 m"],
    "ForegroundPrior.noise": ["1 Jy"],
    "ForegroundPrior.deviation": [2.0],
    "ForegroundPrior.shared_deviation": [2.0],
    "Ddecal.smoothness": ["1 MHz"],
    "Redcal.steps": [["omnical"]],
    "PowerSettings.coherent_time": ["1 min"],
    "Variant.components": [["eor"]],
    "Inspection.antennas": [[0, 2]],
    "Inspection.baselines": [[[0, 1]]],
    "Convergence.steps": [[1, 2]],
    "Outputs.tables": [["spectra"]],
    "Spherical.limits": ["published"],
}
"""Other values of fields whose types do not tell any."""
FOLLOWED = {**BASE, "calibration": {"weights": "flags"}, "outputs": {"figures": ["convergence"]}}
"""An experiment that follows the convergence of solvers."""
SAME: dict[str, str] = {
    "Experiment.description": "words",
    "Experiment.scales": "are applied before",
    "Experiment.sweep": "makes other experiments of this one",
    "Folders.store": "where products go",
    "Folders.runs": "where products go",
    "Outputs.tables": "adds to the tables of every run; one's own counts by its content (plugins/test_tables)",
    "GainFit.models_at_once": "how much is worked on at a time",
    "PyuvsimEngine.precision": "has one value",
    "Eor.path": "a file, which counts by its content",
    "MwaEmbeddedBeam.path": "a file, which counts by its content",
    "ForegroundPrior.mean": "follows from the deviations",
}
"""Fields that change no key here, and why."""
NOT_TRIED = {
    "missing, and it has no default": "names a file, which counts by its content (test_keys)",
    "needs either a folder, or gains": "names files",
    "GLEAM is not on this machine": "names a file",
    "asks for foregrounds, but": "the variants of the base have foregrounds",
    "asks for noise, but": "the variants of the base have noise",
    "cannot be drawn": "figures of other studies",
    "asks for 'beam-fit'": "the beam of the base is a formula",
    "asks for 'delay-floor'": "the bandwidth of the base is too small",
    "asks for 'unbiased'": "the baselines of the base are crossed with others of their group, if there are some",
    "weights that stay as they are": "in the other experiment",
    "must be null where foregrounds are fitted": "tried with other calibrators",
}
"""Blocks that are not tried, by what they are refused with, and why."""
UNKEYED = {
    ("SimulationSettings", "chunks"),
    ("GainFit", "models_at_once"),
    ("ByFile", "salt"),
    (Step.__name__, "scale"),
    ("Folders", "store"),
    ("Folders", "runs"),
}
"""How results are made. `chunks` is in the keys of the pieces, a salt finds files that count by their content, the
scale of a step is in its experiments, and results do not depend on the folders of products and runs."""


def keys(data: dict[str, Any]) -> set[str]:
    return {task.key for task in ExperimentStudy(validate(data, Path())).tasks}


def types_in(annotation: Any) -> list[Any]:
    """Return the classes in an annotation, and its literal values in tuples of one."""
    if get_origin(annotation) is Literal:
        return [(arg,) for arg in get_args(annotation)]
    return [found for arg in get_args(annotation) for found in types_in(arg)] or [annotation]


def blocks(value: Any, annotation: Any) -> list[dict[str, Any]]:
    """Return the blocks that a field may hold, if it holds blocks."""
    if isinstance(value, Plugin):
        names = type(value).registry.built_in()
        return [{type(value).registry.tag: name, **REQUIRED.get(name, {})} for name in names]
    found = []
    for section in types_in(annotation):
        if isinstance(section, type) and issubclass(section, Section):
            tag = next((name for name in TAGS if name in section.model_fields), None)
            named = {} if tag is None else {tag: types_in(section.model_fields[tag].annotation)[0][0]}
            found.append({**named, **REQUIRED.get(section.__name__, REQUIRED.get(str(named.get(tag)), {}))})
    return found


def values(value: Any, annotation: Any) -> Iterator[Any]:
    """Yield other values of a field, as far as its type tells; a quantity with its unit."""
    written = to_jsonable_python(value)
    quantity = re.fullmatch(r"(-?[\d.]+(?:e[+-]?\d+)?)( .+)", written) if isinstance(written, str) else None
    if quantity is not None:
        number, unit = float(quantity[1]), quantity[2]
        yield from (f"{other:.6g}{unit}" for other in (1.1 * number, 0.9 * number, number + 1))
    for kind in types_in(annotation):
        if isinstance(kind, tuple):
            yield kind[0]
        elif kind is bool:
            yield not value
        elif kind is int:
            yield from ([value + 1, 2 * value, value - 1] if type(value) is int else [0, 1, 2])
        elif kind is float and quantity is None:
            yield from ([1.1 * value, 0.9 * value, value + 0.1] if isinstance(value, float) else [0.1, 1.0])
        elif kind in (str, Path):
            yield "other"
        elif kind is NoneType:
            yield None


def part_of(section: Any, path: str) -> Any:
    for step in path.split("."):
        section = section[int(step)] if isinstance(section, list | tuple) else dict(section)[step]
    return section


def declared(section: type, name: str) -> tuple[str, str]:
    """Return the class that declares a field of a section, and the field."""
    return next(base.__name__ for base in reversed(section.__mro__) if name in getattr(base, "model_fields", {})), name


class Walk:
    """Change fields of an experiment, one by one, and those of all blocks that it may have in place of its own."""

    def __init__(self) -> None:
        self.changed: dict[str, bool | None] = {}
        self.refused: dict[str, str] = {}

    def section(self, data: dict[str, Any], path: str = "") -> None:
        experiment, before = validate(data, Path()), keys(data)
        section = part_of(experiment, path.removesuffix(".")) if path else experiment
        dumped = experiment.model_dump(mode="json")
        for name, field in type(section).model_fields.items():
            called = ".".join(declared(type(section), name))
            if self.changed.get(called) or (name in TAGS and path):
                continue
            value, at = getattr(section, name), f"{path}{name}"
            if isinstance(value, Mapping) and value and isinstance(next(iter(value.values())), Section):
                self.section(override(data, at, part_of(dumped, at)), f"{at}.{next(iter(value))}.")
                continue
            many = isinstance(value, tuple) and bool(value) and isinstance(value[0], Section)
            offered = blocks(value[0] if many else value, field.annotation)
            self.changed[called] = None
            if not offered or called in OTHER:
                found = part_of(dumped, at)
                others = [*OTHER.get(called, []), *values(found, field.annotation)]
                self.leaf(data, at, called, [other for other in others if other != found], before)
                continue
            accepted = []
            for block in offered:
                changed = override(data, at, [block] if many else block)
                accepted.append(self.block(changed, f"{at}.0" if many else at, called, block, before))
            if any(accepted) and not self.changed[called]:
                del self.changed[called]  # Its blocks with their defaults are what it has: their fields count.

    def block(self, data: dict[str, Any], at: str, called: str, block: Any, before: set[str]) -> bool:
        try:
            self.changed[called] = (keys(data) != before) or self.changed[called]
        except (ExperimentError, InputError) as error:
            self.refused[f"{called} {block}"] = str(error)
            return False
        if isinstance(part_of(validate(data, Path()), at), Section):
            self.section(data, f"{at}.")
        return True

    def leaf(self, data: dict[str, Any], at: str, called: str, others: list[Any], before: set[str]) -> None:
        for other in others:
            try:
                self.changed[called] = keys(override(data, at, other)) != before
            except (ExperimentError, InputError, OSError):
                continue
            if self.changed[called]:
                return


def test_every_field_changes_a_key_or_is_known_not_to():
    walk = Walk()
    walk.section(BASE)
    walk.section(FOLLOWED, "outputs.convergence.")
    assert {name for name, changed in walk.changed.items() if not changed} == set(SAME)
    unknown = {block: why for block, why in walk.refused.items() if not any(known in why for known in NOT_TRIED)}
    assert unknown == {}, "give these blocks what they need in REQUIRED, so that their fields are tried"


def test_no_other_field_is_left_out_of_keys():
    # Plug-ins are imported when they are found.
    for name in CALIBRATORS.built_in():
        CALIBRATORS.find(name)
    waiting, found = [Section], set()
    while waiting:
        section = waiting.pop()
        waiting += section.__subclasses__()
        for name, field in section.model_fields.items():
            extra = field.json_schema_extra
            if isinstance(extra, dict) and extra.get("keyed") is False:
                found.add(declared(section, name))
    assert found == UNKEYED
