"""The assumptions of the calibrator: the sky and the instrument of an experiment, with some fields changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from calstudy.base.errors import ExperimentError
from calstudy.base.schema import Section
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import Experiment
from calstudy.instrument.settings import InstrumentSettings
from calstudy.sky.settings import SkySettings

FIELD = "calibration.assumed"
SKY_MODEL = "sky_model"
"""The key under which `calibration.assumed` names a file of visibilities."""
OF_THE_DATA = ("channels", "times", "polarizations")
"""Fields of the instrument in which a sky model cannot differ from the data."""


class AssumedWorld(Section):
    """The sky and the instrument that the calibrator assumes."""

    sky: SkySettings
    instrument: InstrumentSettings


def assumed_changes(assumed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of `calibration.assumed` as one dotted path for each value.

    A block without `kind` is split into its fields, so that ``sky: {foregrounds: {count: 3}}`` is
    ``sky.foregrounds.count: 3``; a block with a `kind` is a value, and so is an empty one.

    Raises ExperimentError, with one sentence per fault, for a path that is not of the sky or the instrument or is given
    twice, and for a file of visibilities besides other changes.
    """
    found: dict[str, Any] = {}
    faults = []
    for path, value in _flat(assumed):
        if path in found:
            faults.append(f"{FIELD}.{path}: is given twice")
        elif path != SKY_MODEL and not (path.startswith(("sky.", "instrument.")) and all(path.split("."))):
            faults.append(
                f"{FIELD}.{path}: is not a field of the sky or the instrument (allowed: dotted paths such as "
                f"sky.foregrounds.flux_limit or instrument.beam; or {SKY_MODEL}, a file of visibilities)"
            )
        elif path.startswith("sky.eor"):
            faults.append(f"{FIELD}.{path}: has no effect, for no sky model contains the EoR")
        found[path] = value
    if SKY_MODEL in found and not isinstance(found[SKY_MODEL], str | Path):
        faults.append(f"{FIELD}.{SKY_MODEL} = {found[SKY_MODEL]!r}: must be a path")
    if SKY_MODEL in found and len(found) > 1:
        other = next(path for path in found if path != SKY_MODEL)
        faults.append(f"{FIELD}.{SKY_MODEL}: stands for the whole sky model, so that {other} cannot be given as well")
    if faults:
        raise ExperimentError(faults)
    return found


def _flat(block: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in block.items():
        if isinstance(value, Mapping) and value and "kind" not in value:
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def assumed_world(experiment: Experiment, folder: Path | None = None) -> AssumedWorld:
    """Return the sky and the instrument from which the sky model of the calibrator is simulated.

    The instrument is the nominal one, with changes: no calibrator knows `instrument.as_built`. A file of visibilities
    in `calibration.assumed` changes neither. Relative paths of plug-ins start at `folder`.

    Raises ExperimentError, with one sentence per fault: see `assumed_changes`; fields that do not exist or have invalid
    values; and channels, times or polarizations that are not those of the data.
    """
    changes = {path: value for path, value in assumed_changes(experiment.calibration.assumed).items() if "." in path}
    if not changes:
        return AssumedWorld(sky=experiment.sky, instrument=experiment.instrument.nominal())
    content = assumed_content(experiment, changes)
    try:
        world = AssumedWorld.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        raise ExperimentError([f"{FIELD}.{sentence}" for sentence in sentences(error, AssumedWorld, content)]) from None
    others = [name for name in OF_THE_DATA if getattr(world.instrument, name) != getattr(experiment.instrument, name)]
    if others:
        raise ExperimentError(
            [
                f"{FIELD}.instrument.{name}: must be that of the data, with which the sky model is compared"
                for name in others
            ]
        )
    return world


def assumed_content(experiment: Experiment, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sky and the nominal instrument of an experiment as plain values, with changes (dotted path: value)."""
    content: dict[str, Any] = {
        "sky": experiment.sky.model_dump(mode="json"),
        "instrument": experiment.instrument.nominal().model_dump(mode="json"),
    }
    for path, value in changes.items():
        block = content
        *parents, last = path.split(".")
        for step in parents:
            inner = block.get(step)
            block[step] = inner if isinstance(inner, dict) else {}
            block = block[step]
        block[last] = value.model_dump(mode="json") if isinstance(value, BaseModel) else value
    return content


def value_at(content: Mapping[str, Any], path: str) -> Any:
    """Return the value at a dotted path of nested plain values; None if there is none."""
    value: Any = content
    for step in path.split("."):
        value = value.get(step) if isinstance(value, Mapping) else None
    return value
