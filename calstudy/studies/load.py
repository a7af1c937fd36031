"""Read a file, and return the study that it describes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calstudy.base.package_files import find_experiment
from calstudy.experiment.files import load
from calstudy.experiment.yaml_files import read_mapping
from calstudy.studies import collection, comparison, observed, runtime
from calstudy.studies.experiment import ExperimentStudy
from calstudy.studies.realizations import Realizations
from calstudy.studies.study import Study
from calstudy.studies.sweep import expand


def load_study(path: Path, scale: str | None = None, overrides: Sequence[str] = ()) -> Study:
    """Read an experiment, a sweep, a collection, a comparison, a run-time study or measured data.

    Parameters
    ----------
    path
        The YAML file, or the name of a published one, such as ``quickstart``. A file with the key `experiments` is a
        collection, with `calibrators` a comparison, with `runtime` a run-time study, with `observed` one of measured
        data. An experiment with the key `sweep` is the family of its points, with `realizations` all its
        realizations.
    scale
        Name of a set of overrides in the file's `scales`.
    overrides
        ``path=value`` texts, applied after the scale; those of a collection are applied to every member.

    Raises
    ------
    InputError
        If a file cannot be read, or a scale or override cannot be applied.
    ExperimentError
        If fields are unknown, missing, or have values that are not allowed.
    """
    path = find_experiment(path)
    data = read_mapping(path)
    if runtime.KEY in data:
        return runtime.load_runtime(path, data, scale, overrides)
    if collection.KEY in data:
        return collection.load_collection(path, data, scale, overrides)
    if comparison.KEY in data:
        return comparison.load_comparison(path, data, scale, overrides)
    if observed.KEY in data:
        return observed.load_observed(path, data, scale, overrides)
    experiment = load(path, scale, overrides)
    if experiment.realizations:
        return Realizations(experiment)
    return expand(experiment) if experiment.sweep else ExperimentStudy(experiment)
