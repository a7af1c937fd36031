"""The worlds of a file, one experiment each: those of a comparison, or the one of an experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calstudy.base.errors import InputError
from calstudy.base.package_files import find_experiment
from calstudy.experiment.files import load
from calstudy.experiment.yaml_files import read_mapping
from calstudy.studies import collection, comparison, runtime
from calstudy.studies.comparison import LONGEST_LABEL, Comparison, load_comparison


def load_worlds(
    path: Path, scale: str | None, overrides: Sequence[str], calibrators: Mapping[str, Any] | None
) -> Comparison:
    """Return calibrators in the worlds of a comparison, or in the one of an experiment.

    Parameters
    ----------
    calibrators
        Blocks `calibration` by label, in place of those of the file, with the assumptions of the experiment. None
        for the file's own; that of an experiment has its own name as label.

    Raises
    ------
    InputError
        If the file is neither, or cannot be used.
    """
    path = find_experiment(path)
    data = read_mapping(path)
    if comparison.KEY in data:
        return load_comparison(path, data, scale, overrides, calibrators)
    for key, kind in ((collection.KEY, "collection"), (runtime.KEY, "run-time study")):
        if key in data:
            raise InputError(f"{path}: is a {kind}; an experiment or a comparison is needed")
    experiment = load(path, scale, overrides)
    for key in ("sweep", "realizations"):
        if getattr(experiment, key):
            raise InputError(f"{path}: has the key {key!r}; a single experiment or a comparison is needed")
    content = experiment.model_dump(mode="json")
    own = content["calibration"]
    blocks = {own["calibrator"]: own} if calibrators is None else calibrators
    return load_comparison(
        path,
        {
            "name": experiment.name,
            "description": experiment.description,
            "experiment": content,
            "calibrators": {label: {"assumed": own["assumed"], **_block(block)} for label, block in blocks.items()},
            "worlds": {experiment.name[:LONGEST_LABEL]: {}},
        },
    )


def _block(block: Any) -> dict[str, Any]:
    return {"calibrator": block} if isinstance(block, str) else dict(block)
