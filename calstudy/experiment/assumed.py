"""The assumptions of the calibrator: the sky and the instrument of an experiment, with some fields changed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import to_jsonable_python

from calstudy.base.errors import ExperimentError
from calstudy.base.paths import leaves, with_value
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


class AssumedFile(Section):
    """The file of visibilities that the calibrator assumes."""

    sky_model: Path


def assumed_changes(assumed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes of `calibration.assumed` as one dotted path for each value.

    A block without `kind` is split into its fields, so that ``sky: {foregrounds: {count: 3}}`` is
    ``sky.foregrounds.count: 3``. Raises ExperimentError, with one sentence per fault.
    """
    found: dict[str, Any] = {}
    faults = []
    for path, value in leaves(assumed, whole=lambda block: "kind" in block):
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


def assumed_world(experiment: Experiment, folder: Path | None = None) -> AssumedWorld:
    """Return the sky and the instrument from which the sky model of the calibrator is simulated.

    The instrument is the nominal one, with changes: no calibrator knows `instrument.as_built`. A file of visibilities
    in `calibration.assumed` changes neither. Relative paths of plug-ins start at `folder`.

    Raises ExperimentError, with one sentence per fault, also if `OF_THE_DATA` would be changed.
    """
    changes = {path: value for path, value in assumed_changes(experiment.calibration.assumed).items() if "." in path}
    nominal = AssumedWorld(sky=experiment.sky, instrument=experiment.instrument.nominal())
    if not changes:
        return nominal
    content = nominal.model_dump(mode="json")
    for path, value in changes.items():
        content = with_value(content, path, to_jsonable_python(value), lambda above, given: {})
    try:
        world = AssumedWorld.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        raise ExperimentError([f"{FIELD}.{sentence}" for sentence in sentences(error, AssumedWorld, content)]) from None
    faults = [
        f"{FIELD}.instrument.{name}: must be that of the data, with which the sky model is compared"
        for name in OF_THE_DATA
        if getattr(world.instrument, name) != getattr(experiment.instrument, name)
    ]
    if faults:
        raise ExperimentError(faults)
    return world
