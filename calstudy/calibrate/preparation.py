"""Prepare the calibration problems of an observation for the settings of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.gains import read_gains
from calstudy.base.observation import Observation
from calstudy.calibrate.delay_start import delay_start
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, fitted_baselines
from calstudy.calibrate.settings import ForegroundFit, GainFit, GainWeights
from calstudy.calibrate.standard_formats import require_parallel_hands
from calstudy.calibrate.starts import redundant_start, starting_gains
from calstudy.calibrate.structure import make_structure, repeat_structure
from calstudy.calibrate.weights import inverse_variances, make_weights

NOTHING = Assumed()


@dataclass(frozen=True, eq=False)
class PreparedFit:
    """The arrays of a fit, of all integrations.

    Attributes
    ----------
    data
        The calibrated visibilities: without the autocorrelations, unless they are fitted. Indices of antennas in the
        structure are those of `data.numbers`.
    fitted
        Mask of these baselines in the observation, bool, (Nbls,).
    structure
        Structure of the fit of one integration.
    weights
        Shape (Ntimes, Nbls, Nfreqs, Npols). Inverse variances if the foregrounds have a finite prior. Weights that
        come from the gains are those of unity gains.
    used
        Mask of the calibrated samples, bool, of the same shape: all unflagged samples with weight, also on baselines
        outside the range to which gains are fitted.
    start
        Gains to start from, (Nants, Nfreqs, Ntimes, Npols).
    sky
        The sky model like the visibilities, or None.
    """

    data: Observation
    fitted: np.ndarray
    structure: FitStructure
    weights: np.ndarray
    used: np.ndarray
    start: np.ndarray
    sky: np.ndarray | None


def prepare(observation: Observation, settings: GainFit, assumed: Assumed = NOTHING) -> PreparedFit:
    """Check data and settings, and compute the arrays of a fit.

    Raises InputError if there are polarizations that are not parallel hands, or unflagged data that are not finite, or
    if weights or gains do not fit the data.
    """
    require_parallel_hands(observation.uvd)
    fitted = fitted_baselines(observation, settings.autos)
    weights = make_weights(observation, fitted, settings.weights)
    if isinstance(settings, ForegroundFit) and settings.foreground_prior.finite:
        weights = inverse_variances(observation, fitted, weights, settings, assumed.noise)
    data, used = observation.baselines(fitted), weights > 0
    if settings.baselines is not None:
        weights = weights * settings.baselines.factors(data.lengths)[:, None, None]
    sky = None if assumed.sky_model is None else assumed.sky_model.baselines(fitted).visibilities
    _require_finite(data)
    structure = make_structure(data, settings)
    gains = assumed.gains
    if gains is None and settings.initial_gains.kind == "file":
        gains = read_gains(settings.initial_gains.path, "calibration.initial_gains.path")
    if gains is None and settings.initial_gains.kind == "redundant":
        start = redundant_start(data, weights, settings.initial_gains, settings.redundancy_tolerance)
    elif gains is None and settings.initial_gains.kind == "delays":
        start = delay_start(data, weights, settings.initial_gains, sky)
    else:
        start = starting_gains(data, gains)
    return PreparedFit(data, fitted, structure, weights, used, start, sky)


def problem_at(
    prepared: PreparedFit, settings: GainFit, times: slice, polarization: int, gains: np.ndarray
) -> CalibrationProblem | str:
    """Return the problem whose solution are gains (Nants, Nfreqs), with the weights from them, or why there is none."""
    problem = make_problem(prepared, settings, times, polarization)
    if isinstance(problem, str) or not isinstance(settings.weights, GainWeights):
        return problem
    return problem.weighted_by(gains)


def make_problem(prepared: PreparedFit, settings: GainFit, times: slice, polarization: int) -> CalibrationProblem | str:
    """Return the problem of some consecutive integrations together, or the reason why there is none.

    Weights that come from the gains are those of unity gains.
    """
    structure = repeat_structure(prepared.structure, times.stop - times.start)

    def rows(cube: np.ndarray) -> np.ndarray:
        return cube[times, :, :, polarization].reshape(structure.n_baselines, structure.n_frequencies)

    weights, visibilities = rows(prepared.weights), rows(prepared.data.visibilities)
    if not weights.any():
        return "every sample is flagged or has no weight"
    if not np.any(visibilities, where=weights > 0):
        return "the data are zero"
    sky = None if prepared.sky is None else rows(prepared.sky)
    deviations = _deviations(sky, weights, settings)
    if deviations == (0, 0):
        return "the sky model is zero, and the deviations of the foregrounds' prior are fractions of it"
    return CalibrationProblem(
        structure,
        visibilities,
        weights,
        prepared.start[:, :, times.start, polarization],
        sky,
        settings.prior if isinstance(settings, ForegroundFit) else "sum",
        frozen=settings.frozen,
        deviations=deviations,
    )


def _deviations(sky: np.ndarray | None, weights: np.ndarray, settings: GainFit) -> tuple[float, float]:
    """Return the own and shared deviations of the foregrounds' prior, in the unit of the data.

    They are those of the integrations that are solved together: results must not depend on the chunks of a run.
    """
    if not isinstance(settings, ForegroundFit) or not settings.foreground_prior.finite or sky is None:
        return math.inf, math.inf
    prior = settings.foreground_prior
    rms = float(np.sqrt(np.mean(np.abs(sky[weights > 0]) ** 2)))
    own, shared = (float(value) * rms for value in (prior.deviation, prior.shared_deviation))
    return own, shared


def _require_finite(data: Observation) -> None:
    bad = ~(np.isfinite(data.visibilities) | data.flags)
    if bad.any():
        t, baseline, channel, _ = np.argwhere(bad)[0]
        a, b = data.pairs[baseline]
        raise InputError(
            f"{bad.sum()} unflagged visibilities are not finite, the first on baseline ({a}, {b}), integration {t}, "
            f"channel {channel}; flag them"
        )
