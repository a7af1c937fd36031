"""What papers ask of the runs that play their roles: calibrator, weights, sky model, array, and what is true."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.distance import pdist

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.calibrate.settings import WeightedFit
from calstudy.corrupt.effects.bandpass import Bandpass
from calstudy.corrupt.interface import GainEffect
from calstudy.corrupt.shapes import Delays
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment
from calstudy.instrument.as_built import AsBuilt
from calstudy.instrument.layouts import make_array
from calstudy.power.cosmology import k_parallel, make_cosmology
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    from calstudy.claims.results import RunResults

INCOMPLETE = ("sky.foregrounds.flux_limit", "sky.foregrounds.count")
"""Fields of the assumed sky that leave sources out."""
INVERSE_VARIANCES = ("gains", "autos")
"""Kinds of weights."""
SMOOTH = 100e-9
"""s, the largest delay of gains that are smooth in frequency."""


def other_calibrator(experiment: Experiment, allowed: Sequence[str]) -> str | None:
    """Return in words that an experiment has none of the allowed calibrators, or None if it has one."""
    found = experiment.calibration.label
    return None if found in allowed else f"calibration.calibrator is {found!r}, not {' or '.join(map(repr, allowed))}"


def structured_gains(experiment: Experiment) -> str | None:
    """Return in words which gains are not smooth in frequency, or None if all are."""
    for effect in experiment.corruption.effects:
        rough = isinstance(effect, Bandpass) and isinstance(effect.shape, Delays) and effect.shape.max_delay > SMOOTH
        if isinstance(effect, GainEffect) and (rough or not isinstance(effect, Bandpass)):
            return f"corruption.effects has {effect.label}, whose gains are not smooth in frequency"
    return None


def other_weights(experiment: Experiment) -> str | None:
    """Return in words that weights are no inverse variances and gains not smooth, or None.

    A smooth error of the model then becomes errors of the gains that are white, which no paper is about.
    """
    calibration = experiment.calibration
    rough = structured_gains(experiment)
    if rough is None or not isinstance(calibration, WeightedFit) or calibration.weights.kind in INVERSE_VARIANCES:
        return None
    return f"calibration.weights is {calibration.weights.kind!r}, which is no inverse variance, and {rough}"


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


def k_of_delay(experiment: Experiment, delay: float) -> float:
    """Return k_parallel (h/Mpc) of a delay (s) at the centre of the band."""
    channels, cosmology = experiment.instrument.channels, make_cosmology(experiment.power.cosmology)
    return float(k_parallel(cosmology, np.array(delay), channels.first + channels.width * (channels.count - 1) / 2))


def require_long_baselines(run: RunResults, k: float) -> None:
    """Raise Unevaluated unless the horizon of the longest baseline, and the buffer of the wedge, reach k (h/Mpc).

    Errors of a sky model have delays up to the horizon of the longest baseline that gains are fitted to, and so have
    those of the gains.
    """
    experiment = run.experiment
    lengths = pdist(make_array(experiment.instrument).enu)
    fitted = experiment.calibration.baselines if isinstance(experiment.calibration, WeightedFit) else None
    longest = float((lengths if fitted is None else lengths[fitted.factors(lengths) > 0]).max())
    reached = k_of_delay(experiment, longest / SPEED_OF_LIGHT + experiment.power.wedge_buffer)
    if reached < k:
        raise Unevaluated(
            f"the longest baseline that gains are fitted to has {longest:.0f} m; its horizon and the buffer reach "
            f"{reached:.2f} h/Mpc, not {k:g}, so that errors of the model cannot reach all of the window"
        )


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
