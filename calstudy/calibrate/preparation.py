"""Prepare the calibration problems of an observation for the settings of a fit, and the gains that they start from."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from pyuvdata import UVCal

from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gains
from calstudy.base.gains import closest_solutions, gains_for
from calstudy.base.observation import Observation
from calstudy.base.quiet import without_warnings
from calstudy.calibrate.degeneracy import FEED, POL, gradient_turns
from calstudy.calibrate.delay_start import delay_start
from calstudy.calibrate.interface import Assumed
from calstudy.calibrate.problem import (
    NOTHING_WEIGHTED,
    CalibrationProblem,
    FitStructure,
    fitted_baselines,
    make_structure,
    model_rms,
    repeat_structure,
)
from calstudy.calibrate.records import Solve, require_parallel_hands
from calstudy.calibrate.settings import RUNAWAY, START_DEVIATION, ForegroundFit, GainFit, GainWeights, RedundantStart
from calstudy.calibrate.weights import inverse_variances, make_weights, require_finite
from calstudy.instrument.layouts import redundant_groups

NOTHING = Assumed()


@dataclass(frozen=True, eq=False)
class PreparedFit:
    """The arrays of a fit, of all integrations.

    Data are the calibrated visibilities: without the autocorrelations, unless they are fitted; `fitted` is the mask of
    these baselines in the observation, bool, (Nbls,). Indices of antennas in the structure, which is that of an
    integration with data at both ends of the band, are those of `data.numbers`. Weights, (Ntimes, Nbls, Nfreqs, Npols),
    are inverse variances if the foregrounds have a finite prior, and those of unity gains if they come from the gains.
    Samples that are `used`, bool, of the same shape, are all unflagged ones with weight, also on baselines outside the
    range to which gains are fitted. Gains to start from are (Nants, Nfreqs, Ntimes, Npols).
    """

    data: Observation
    fitted: np.ndarray
    structure: FitStructure
    weights: np.ndarray
    used: np.ndarray
    start: np.ndarray
    sky: np.ndarray | None
    _of_bands: dict[tuple[int, int], FitStructure] = field(default_factory=dict, repr=False)

    def structure_between(self, first: int, end: int, settings: GainFit) -> FitStructure:
        """Return the structure of an integration with data in channels `first` to `end` - 1.

        It is that of all channels where neither foregrounds are free nor gains restricted. Raises InputError as
        `make_structure`.
        """
        free = isinstance(settings, ForegroundFit) and not settings.frozen and not settings.foreground_prior.finite
        if not (free or settings.gain_delay is not None) or (first, end) == (0, self.structure.n_frequencies):
            return self.structure
        if (first, end) not in self._of_bands:
            self._of_bands[first, end] = make_structure(self.data, settings, slice(first, end))
        return self._of_bands[first, end]


def prepare(observation: Observation, settings: GainFit, assumed: Assumed = NOTHING) -> PreparedFit:
    """Check data and settings, and compute the arrays of a fit.

    Raises InputError if there are polarizations that are not parallel hands, or unflagged data that are not finite, or
    if weights or gains do not fit the data.
    """
    require_parallel_hands(observation.uvd)
    fitted = fitted_baselines(observation, settings.autos)
    weights = make_weights(observation, fitted, settings.weights, settings.solves(observation.n_times))
    if isinstance(settings, ForegroundFit) and settings.foreground_prior.finite:
        weights = inverse_variances(observation, fitted, weights, settings, assumed.noise)
    data, used = observation.baselines(fitted), weights > 0
    if settings.baselines is not None:
        weights = weights * settings.baselines.factors(data.lengths, data.antennas)[:, None, None]
    sky = None if assumed.sky_model is None else assumed.sky_model.baselines(fitted).visibilities
    require_finite(data)
    structure = make_structure(data, settings)
    gains = assumed.gains
    if gains is None and settings.initial_gains.kind == "file":
        gains = read_gains(settings.initial_gains.path, "calibration.initial_gains.path", data.uvd)
    if gains is None and settings.initial_gains.kind == "redundant":
        start = redundant_start(data, weights, settings.initial_gains, settings.redundancy_tolerance, sky)
    elif gains is None and settings.initial_gains.kind == "delays":
        start = delay_start(data, weights, settings.initial_gains, sky)
    else:
        start = starting_gains(data, gains)
    return PreparedFit(data, fitted, structure, weights, used, start, sky)


def problem_at(
    prepared: PreparedFit,
    settings: GainFit,
    times: slice,
    polarization: int,
    gains: np.ndarray,
    record: Solve | None = None,
) -> CalibrationProblem | str:
    """Return the problem whose solution are gains (Nants, Nfreqs), or why there is none.

    Weights that come from the gains are those of these gains, or equal if those of the solve ran away. Deviations of
    the foregrounds that were estimated are those in the record of the solve.
    """
    problem = make_problem(prepared, settings, times, polarization)
    if isinstance(problem, str):
        return problem
    if settings.estimates_deviation:
        if record is None:
            raise ValueError("record: is needed where the deviations of the foregrounds are estimated")
        problem = problem.with_fractions(record.diagnostics.get("deviation", problem.fractions))
    if not isinstance(settings.weights, GainWeights):
        return problem
    ran_away = record is not None and record.diagnostics.get("weight_change", 0) > RUNAWAY
    return problem.weighted_by(np.ones_like(gains) if ran_away else gains)


def make_problem(prepared: PreparedFit, settings: GainFit, times: slice, polarization: int) -> CalibrationProblem | str:
    """Return the problem of some consecutive integrations together, or the reason why there is none.

    Weights that come from the gains are those of unity gains. Free foregrounds and restricted gains have sequences from
    the first channel with data to the last.
    """

    def rows(cube: np.ndarray) -> np.ndarray:
        return cube[times, :, :, polarization].reshape(-1, cube.shape[2])

    weights, visibilities = rows(prepared.weights), rows(prepared.data.visibilities)
    with_data = np.flatnonzero(weights.any(axis=0))
    if not with_data.size:
        return NOTHING_WEIGHTED
    try:
        one = prepared.structure_between(int(with_data[0]), int(with_data[-1]) + 1, settings)
    except InputError as error:
        return f"between flagged edges of the band: {error}"
    n_times = times.stop - times.start
    structure = repeat_structure(one, n_times)
    if not np.any(visibilities, where=weights > 0):
        return "the data are zero"
    sky = None if prepared.sky is None else rows(prepared.sky)
    deviations = _deviations(sky, weights, settings)
    if deviations == (0, 0):
        return "the sky model is zero, and the deviations of the foregrounds' prior are fractions of it"
    # The start is that of the integration with the most data.
    fullest = times.start + np.argmax(np.count_nonzero(weights.reshape(n_times, -1), axis=1))
    return CalibrationProblem(
        structure,
        visibilities,
        weights,
        prepared.start[:, :, fullest, polarization],
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
    prior, rms = settings.foreground_prior, model_rms(sky, weights)
    given = prior.deviation, prior.shared_deviation
    own, shared = (START_DEVIATION if value == "estimated" else float(value) for value in given)
    return own * rms, shared * rms


Key = tuple[int, int, str]
"""A baseline and a polarization, as in hera_cal."""


def starting_gains(data: Observation, gains: UVCal | None) -> np.ndarray:
    """Return the gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols); unity if `gains` is None.

    Of several integrations the closest in time is used; flagged, zero and infinite gains are replaced by unity. Raises
    InputError if an antenna, channel or polarization of the data has no gain, if all are replaced, or if the gains are
    delays.
    """
    if gains is None:
        return np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    values = gains_for(gains, data.uvd)[:, :, closest_solutions(gains, data.times)]
    known = np.isfinite(values) & (values != 0)
    if not known.any():
        raise InputError("gains: all are flagged, zero or not finite; take others, or none to start from unity")
    return np.where(known, values, 1)


def redundant_start(
    data: Observation, weights: np.ndarray, settings: RedundantStart, tolerance: float, sky: np.ndarray | None = None
) -> np.ndarray:
    """Solve redundant baselines for gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols).

    Redundant baselines measure the same sky, so that the ratios of their visibilities are ratios of gains (Liu et al.
    2010). A delay and a phase for each antenna (firstcal) bring phases within reach of the logarithm, in which the
    equations are linear (logcal). Redundancy does not determine amplitude, phase and phase gradients of the whole
    array. Gradients are those of the sky model, as `data.visibilities`, if there is one: foregrounds that groups share
    would follow any other. The rest is set to unity, or stays as firstcal has it.

    Autocorrelations and samples of weight zero, (Ntimes, Nbls, Nfreqs, Npols), have no influence. Baselines that differ
    by less than `tolerance`, in m, are redundant. Gains are unity for antennas without redundant baselines, and where
    the solution is not finite. Raises InputError if no two baselines are redundant.
    """
    groups = redundant_groups(data.vectors, tolerance)
    members = [np.flatnonzero(groups.index == group) for group in range(groups.index.max() + 1)]
    members = [rows for rows in members if rows.size > 1 and not data.autos[rows[0]]]
    if not members:
        raise InputError(
            "calibration.initial_gains: 'redundant' needs redundant baselines, and no two differ by less than "
            f"redundancy_tolerance = {tolerance:g} m; start from unity or a file"
        )
    ends = np.where(groups.conjugated[:, None], data.pairs[:, ::-1], data.pairs).tolist()
    keys = {row: (*ends[row], POL) for rows in members for row in rows.tolist()}
    reds = [[keys[row] for row in rows.tolist()] for rows in members]
    gains = np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    for p in range(data.n_polarizations):
        used = {keys[row]: weights[:, row, :, p] for row in keys}
        measured = _turned(data.visibilities[..., p], keys, groups.conjugated)
        # The logarithm must not be taken of zeros, even where the weight is zero.
        visibilities = {key: np.where(used[key] > 0, values, 1) for key, values in measured.items()}
        solved = _solve(reds, visibilities, used, data.frequencies, settings.delays)
        if sky is not None:
            model = _turned(np.nan_to_num(sky[..., p]), keys, groups.conjugated)
            overlap = {
                (a, b, pol): used[a, b, pol] * values * model[a, b, pol].conj() * solved[a].conj() * solved[b]
                for (a, b, pol), values in visibilities.items()
            }
            with without_warnings():
                turns = {a: turn for (a, _), turn in gradient_turns(reds, overlap).items()}
            solved = {
                a: gain * np.where(np.isfinite(turns[a]) & (turns[a] != 0), turns[a], 1) for a, gain in solved.items()
            }
        for number, gain in solved.items():
            gains[np.searchsorted(data.numbers, number), :, :, p] = gain.T
    return np.where(np.isfinite(gains) & (gains != 0), gains, 1)


def _turned(cube: np.ndarray, keys: dict[int, Key], conjugated: np.ndarray) -> dict[Key, np.ndarray]:
    """Return the rows (Ntimes, Nfreqs) of a cube (Ntimes, Nbls, Nfreqs) by key, conjugated where they must be."""
    return {key: np.conj(cube[:, row]) if conjugated[row] else cube[:, row] for row, key in keys.items()}


def _solve(
    reds: list[list[Key]],
    visibilities: dict[Key, np.ndarray],
    weights: dict[Key, np.ndarray],
    frequency: np.ndarray,
    delays: bool,
) -> dict[int, np.ndarray]:
    """Solve for the gains (Ntimes, Nfreqs) of every antenna with redundant baselines."""
    from hera_cal.datacontainer import DataContainer
    from hera_cal.redcal import RedundantCalibrator

    calibrator = RedundantCalibrator(reds)
    data = DataContainer(visibilities)
    # Channels without data make singular equations; their gains are replaced by unity.
    with without_warnings():
        first = calibrator.firstcal(data, frequency)[1].gains if delays else defaultdict(lambda: np.ones(1))
        # Degeneracies are fixed where phases are small: elsewhere they may jump by a lattice's worth between channels.
        rest = {(a, b, pol): values / (first[a, FEED] * first[b, FEED].conj()) for (a, b, pol), values in data.items()}
        _, solution = calibrator.logcal(DataContainer(rest), wgts=DataContainer(weights))
        solution.remove_degen(degen_sol={antenna: np.ones_like(gain) for antenna, gain in solution.gains.items()})
    return {key[0]: np.asarray(gain * first[key], complex) for key, gain in solution.gains.items()}
