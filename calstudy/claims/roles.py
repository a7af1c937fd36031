"""Conditions of papers on the runs that play their roles: calibrator, weights, sky model, array, and true world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.distance import pdist

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.paths import differences
from calstudy.calibrate.settings import WeightedFit
from calstudy.claims.bins import bias
from calstudy.corrupt.drift import Correlated, Delays
from calstudy.corrupt.effects.gains import Bandpass
from calstudy.corrupt.interface import GainEffect
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment
from calstudy.instrument.as_built import AsBuilt
from calstudy.instrument.layouts import make_array
from calstudy.power.cosmology import k_parallel, make_cosmology
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    from calstudy.results.reader import Results

INCOMPLETE = ("sky.foregrounds.flux_limit", "sky.foregrounds.count")
"""Fields of the assumed sky that leave sources out."""
INVERSE_VARIANCES = ("gains", "autos")
EXPECTED_AT, EXPECTED = 0.3, (2.0, 200.0)
"""Wavenumber, h/Mpc, and Delta^2 = k^3 P / (2 pi^2) there, mK^2, of an EoR as expected: about 20, to an order of
magnitude."""
SMOOTH = 100e-9
"""Largest delay of gains that are smooth in frequency, s."""


def unsuitable(
    experiment: Experiment,
    calibrators: Sequence[str],
    *others: str | None,
    incomplete: bool | None,
    fault: str | None = None,
) -> str | None:
    """Return the first refusal of an experiment, or None.

    The calibrator must be one of `calibrators`, and weights must be inverse variances or gains smooth in frequency;
    there may be no fault but one (its field of the instrument as built), and the sky model must be `incomplete` or
    complete, or may be any (None). Refusals of a paper's own, `others`, come after that of the calibrator.
    """
    sky_model = None if incomplete is None else _other_sky_model(experiment, incomplete)
    found = (_other_weights(experiment), _other_faults(experiment, fault), sky_model)
    refusals = (_other_calibrator(experiment, calibrators), *others, *found)
    return next((refusal for refusal in refusals if refusal is not None), None)


def _other_calibrator(experiment: Experiment, allowed: Sequence[str]) -> str | None:
    found = experiment.calibration.label
    return None if found in allowed else f"calibration.calibrator is {found!r}, not {' or '.join(map(repr, allowed))}"


def structured_gains(experiment: Experiment) -> str | None:
    """Return in words which gains are not smooth in frequency, or None if all are."""
    for effect in experiment.corruption.effects:
        if isinstance(effect, GainEffect) and not (isinstance(effect, Bandpass) and _is_smooth(effect)):
            return f"corruption.effects has {effect.label}, whose gains are not smooth in frequency"
    return None


def _is_smooth(effect: Bandpass) -> bool:
    shape = effect.shape
    if isinstance(shape, Delays):
        return shape.max_delay <= SMOOTH
    if isinstance(shape, Correlated):
        # The delay spectrum is a Gaussian of this standard deviation.
        return shape.form == "gaussian" and 2 / (2 * math.pi * SMOOTH) <= shape.length
    return True


def _other_weights(experiment: Experiment) -> str | None:
    """Return a refusal if the weights are not inverse variances and the gains are not smooth, or None.

    With such weights, a smooth error of the model causes white errors of the gains, and no paper is about these.
    """
    calibration = experiment.calibration
    rough = structured_gains(experiment)
    if rough is None or not isinstance(calibration, WeightedFit) or calibration.weights.kind in INVERSE_VARIANCES:
        return None
    return f"calibration.weights is {calibration.weights.kind!r}, which is no inverse variance, and {rough}"


def _other_sky_model(experiment: Experiment, incomplete: bool) -> str | None:
    """Return a refusal of the sky model, or None.

    With `incomplete`, sources have to be missing and no other assumption may be wrong; otherwise the sky model has
    to be that of the nominal instrument and the true sky.
    """
    changes = assumed_changes(experiment.calibration.assumed)
    others = [path for path in changes if path not in INCOMPLETE]
    if others:
        return f"calibration.assumed has {others[0]}"
    if bool(changes) == incomplete:
        return None
    return f"calibration.assumed: {'no sources are missing' if incomplete else f'has {next(iter(changes))}'}"


def _other_faults(experiment: Experiment, allowed: str | None = None) -> str | None:
    """Return in words a fault of the instrument as built, but in the field `allowed`, or of the data, or None."""
    for path, _, value in differences(AsBuilt().model_dump(), experiment.instrument.as_built.model_dump()):
        if path != allowed and not path.endswith("seed"):
            return f"instrument.as_built.{path} is {value}"
    others = [effect.label for effect in experiment.corruption.effects if not isinstance(effect, GainEffect)]
    return f"corruption.effects has {others[0]}" if others else None


def k_of_delay(experiment: Experiment, delay: float) -> float:
    """Return k_parallel (h/Mpc) of a delay (s) at the centre of the band."""
    channels, cosmology = experiment.instrument.channels, make_cosmology(experiment.power.cosmology)
    return float(k_parallel(cosmology, np.array(delay), channels.first + channels.width * (channels.count - 1) / 2))


def require_long_baselines(run: Results, k: float) -> None:
    """Raise Unevaluated unless the horizon of the longest baseline plus the buffer of the wedge reaches k (h/Mpc).

    Errors of a sky model, and the errors of gains they cause, have delays up to the horizon of the longest baseline
    in the fit of the gains.
    """
    experiment = run.experiment
    enu = make_array(experiment.instrument).enu
    lengths, antennas = pdist(enu), np.stack(np.triu_indices(len(enu), 1), axis=1)
    fitted = experiment.calibration.baselines if isinstance(experiment.calibration, WeightedFit) else None
    longest = float((lengths if fitted is None else lengths[fitted.factors(lengths, antennas) > 0]).max())
    reached = k_of_delay(experiment, longest / SPEED_OF_LIGHT + experiment.power.wedge_buffer)
    if reached < k:
        raise Unevaluated(
            f"the longest baseline that gains are fitted to has {longest:.0f} m; its horizon and the buffer reach "
            f"{reached:.2f} h/Mpc, not {k:g}, so that errors of the model cannot reach all of the window"
        )


def require_expected_signal(run: Results) -> None:
    """Raise Unevaluated unless the simulated EoR is as strong as the signal that is expected of reionization."""
    eor, (low, high) = run.spherical("eor", "outside-wedge"), EXPECTED
    known = np.flatnonzero(np.isfinite(eor.power.real))
    if not known.size:
        raise Unevaluated("no bins have power of the EoR")
    place = known[np.argmin(np.abs(eor.k[known] - EXPECTED_AT))]
    found = float(eor.k[place] ** 3 * eor.power.real[place] / (2 * np.pi**2))
    if not low <= found <= high:
        raise Unevaluated(
            f"the EoR has Delta^2 = {found:.2g} mK^2 at k = {eor.k[place]:.2g} h/Mpc, and the sentence is on the "
            f"expected signal, {low:g} to {high:g}: choose another corruption.eor_level"
        )


def require_same_world(first: Results, second: Results) -> None:
    """Raise Unevaluated unless sky, instrument, data and sky model of two runs are the same."""
    one, other = first.experiment, second.experiment
    for section in ("sky", "instrument", "corruption"):
        if getattr(one, section) != getattr(other, section):
            raise Unevaluated(f"the runs differ in {section}")
    if assumed_changes(one.calibration.assumed) != assumed_changes(other.calibration.assumed):
        raise Unevaluated("the runs differ in calibration.assumed")


def bias_of_expected_signal(run: Results, k_min: float, k_max: float) -> Finding:
    """Return the `bias` of a run whose baselines reach `k_max`, h/Mpc, and whose EoR is as strong as expected."""
    require_long_baselines(run, k_max)
    require_expected_signal(run)
    return bias(run, k_min, k_max)
