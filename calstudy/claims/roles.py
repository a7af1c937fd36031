"""What papers ask of the runs that play their roles: the calibrator, what it is told, and what is true."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calstudy.corrupt.interface import GainEffect
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment
from calstudy.instrument.as_built import AsBuilt
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    from calstudy.claims.results import RunResults

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


def other_faults(experiment: Experiment, allowed: str | None = None) -> str | None:
    """Return in words what is wrong with the instrument as built or with the data, besides gains, or None.

    Parameters
    ----------
    experiment
        That would play the role.
    allowed
        The field of `instrument.as_built` in which the role wants it to differ, such as "dipoles.dead_tiles".
    """
    nominal = dict(_fields(AsBuilt().model_dump()))
    for path, value in _fields(experiment.instrument.as_built.model_dump()):
        if path != allowed and not path.endswith("seed") and value != nominal.get(path):
            return f"instrument.as_built.{path} is {value}"
    others = [effect.label for effect in experiment.corruption.effects if not isinstance(effect, GainEffect)]
    return f"corruption.effects has {others[0]}" if others else None


def _fields(block: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in block.items():
        if isinstance(value, Mapping):
            yield from _fields(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def require_same_world(first: RunResults, second: RunResults) -> None:
    """Raise Unevaluated unless sky, instrument, data and sky model of two runs are the same."""
    one, other = first.experiment, second.experiment
    for section in ("sky", "instrument", "corruption"):
        if getattr(one, section) != getattr(other, section):
            raise Unevaluated(f"the runs differ in {section}")
    if assumed_changes(one.calibration.assumed) != assumed_changes(other.calibration.assumed):
        raise Unevaluated("the runs differ in calibration.assumed")


def first_refusal(*refusals: str | None) -> str | None:
    """Return the first reason that there is."""
    return next((refusal for refusal in refusals if refusal is not None), None)
