"""What papers ask of the runs that play their roles: the calibrator, what it is told, and what is true."""

from __future__ import annotations

from collections.abc import Sequence

from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment

INCOMPLETE = ("sky.foregrounds.flux_limit", "sky.foregrounds.count")
"""Fields of the assumed sky that leave sources out."""


def other_calibrator(experiment: Experiment, allowed: Sequence[str]) -> str | None:
    """Return in words that an experiment has none of the allowed calibrators, or None if it has one."""
    found = experiment.calibration.label
    return None if found in allowed else f"calibration.calibrator is {found!r}, not {' or '.join(map(repr, allowed))}"


def other_sky_model(experiment: Experiment, incomplete: bool) -> str | None:
    """Return in words why the sky model is not what it should be, or None.

    Parameters
    ----------
    experiment
        That would play the role.
    incomplete
        Whether sources have to be missing, and nothing else is to be assumed wrongly; otherwise the sky model has to be
        that of the nominal instrument and the true sky.
    """
    changes = assumed_changes(experiment.calibration.assumed)
    others = [path for path in changes if path not in INCOMPLETE]
    if others:
        return f"calibration.assumed has {others[0]}"
    if bool(changes) == incomplete:
        return None
    return f"calibration.assumed: {'no sources are missing' if incomplete else f'has {next(iter(changes))}'}"


def not_as_nominal(experiment: Experiment) -> str | None:
    """Return in words how the instrument as built differs from the nominal one, or None if it does not."""
    note = experiment.instrument.as_built.note
    return f"instrument.as_built: {note}" if note else None


def first_refusal(*refusals: str | None) -> str | None:
    """Return the first reason that there is."""
    return next((refusal for refusal in refusals if refusal is not None), None)
