"""CALAMITY (Ewall-Wice et al. 2022): visibilities in, gains, foreground model and calibrated residual out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.problem import CalibrationProblem, FitStructure, gain_products
from calstudy.calibrate.products import make_gains, make_visibilities, require_parallel_hands
from calstudy.calibrate.records import CalibrationResult, SolveRecord
from calstudy.calibrate.settings import CalibrationSettings, GaussNewtonSettings, LbfgsSettings
from calstudy.calibrate.solution import Solution
from calstudy.calibrate.solvers.first_order import FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solver, WarmStart, solve_warm
from calstudy.calibrate.solvers.lbfgs import Lbfgs
from calstudy.calibrate.starts import read_gains, starting_gains
from calstudy.calibrate.structure import make_structure, repeat_structure
from calstudy.calibrate.weights import make_weights
from calstudy.errors import InputError
from calstudy.resources import Usage
from calstudy.visibilities import antenna_pairs, flag_cube, to_cube

Progress = Callable[[int, int], None]


def make_solver(settings: CalibrationSettings) -> Solver:
    """Return the solver of the `calibration.solver` section."""
    solver = settings.solver
    if isinstance(solver, GaussNewtonSettings):
        return GaussNewton(solver.tolerance, solver.max_steps)
    if isinstance(solver, LbfgsSettings):
        return Lbfgs(solver.tolerance, solver.max_steps, solver.memory)
    optimizer = Optimizer(solver.name, solver.learning_rate, solver.schedule, solver.final_rate, solver.max_steps)
    return FirstOrder(optimizer, solver.tolerance, solver.precision)


class Measured(NamedTuple):
    """The arrays of a calibration.

    Attributes
    ----------
    visibilities, weights
        Shape (Ntimes, Nbls, Nfreqs, Npols).
    start
        Gains to start from, (Nants, Nfreqs, Ntimes, Npols).
    sky
        The sky model like the visibilities, or None.
    """

    visibilities: np.ndarray
    weights: np.ndarray
    start: np.ndarray
    sky: np.ndarray | None


class Solve(NamedTuple):
    """One solve: its integrations, first and one past the last, its polarization, and how it went."""

    first: int
    last: int
    polarization: int
    solution: Solution
    peak_memory: int


def calibrate(
    data: UVData,
    settings: CalibrationSettings,
    sky_model: UVData | None = None,
    gains: UVCal | None = None,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Solve for gains and foregrounds, independently for every polarization and every integration or group of them.

    Parameters
    ----------
    data
        Visibilities, rectangular and time-major, with parallel-hand polarizations only; not changed. Flagged samples
        have no influence. Autocorrelations are left out, also of the results, unless `settings.autos` is set.
    settings
        Calibrator, foreground basis, weights, solver and prior.
    sky_model
        Visibilities whose weighted sum fixes the overall scale, with the baselines, times, channels and polarizations
        of `data`; the data themselves if none is given, which makes gains of about unity. The sky-based calibrator
        takes them for the truth.
    gains
        Where to start, before what `settings.initial_gains` says.
    progress
        Called after each solve with the number done and the total.

    Raises
    ------
    InputError
        If weights or gains do not fit the data, or the sky-based calibrator has no sky model.
    ValueError
        If the data are not rectangular, not finite where unflagged, of cross-hand polarizations, without any baseline
        to fit, or differ from the sky model in shape; or if the basis does not fit into the channels.
    """
    fitted = _fitted_baselines(data, settings.autos)
    weights = make_weights(data, fitted, settings.weights)
    data = _keep(data, fitted)
    sky = None
    if sky_model is not None:
        sky = _matching_cube(fitted_part(sky_model, settings.autos), data)
    elif settings.calibrator == "sky-based":
        raise InputError("calibration.calibrator: 'sky-based' needs a sky model, and there is none")
    _require_finite(data)
    structure, numbers = make_structure(data, settings)
    if gains is None and settings.initial_gains.kind == "file":
        gains = read_gains(settings.initial_gains.path)
    measured = Measured(to_cube(data), weights, starting_gains(data, numbers, gains), sky)
    return _collect(data, numbers, structure, measured, _solve_all(structure, settings, measured, progress))


def _collect(
    data: UVData, numbers: np.ndarray, structure: FitStructure, measured: Measured, solves: Iterator[Solve]
) -> CalibrationResult:
    """Put the solutions together."""
    visibilities, used = measured.visibilities, measured.weights > 0
    gains, gain_flags = np.ones(measured.start.shape, complex), np.ones(measured.start.shape, bool)
    model, residual, flags = np.zeros_like(visibilities), np.zeros_like(visibilities), ~used
    records = []
    for first, last, p, solution, peak_memory in solves:
        records.append(_record(data, Solve(first, last, p, solution, peak_memory)))
        if not solution.usable:
            flags[first:last, :, :, p] = True
            continue
        fitted = solution.model.reshape(last - first, *visibilities.shape[1:3])
        for t in range(first, last):
            present = used[t, :, :, p]
            gain_flags[:, :, t, p] = ~_has_data(structure, present)
            gains[:, :, t, p] = np.where(gain_flags[:, :, t, p], 1, solution.gains)
            model[t, :, :, p] = fitted[t - first]
            products = gain_products(gains[:, :, t, p], structure.antennas)
            calibrated = np.where(present, visibilities[t, :, :, p], 0) / products
            residual[t, :, :, p] = np.where(present, calibrated - fitted[t - first], 0)
    return CalibrationResult(
        make_gains(data, numbers, gains, gain_flags),
        make_visibilities(data, model, flags),
        make_visibilities(data, residual, flags),
        tuple(records),
    )


def _solve_all(
    structure: FitStructure, settings: CalibrationSettings, measured: Measured, progress: Progress | None
) -> Iterator[Solve]:
    """Yield every solve, polarization by polarization, each in the order of time."""
    solver = make_solver(settings)
    n_times, _, _, n_polarizations = measured.visibilities.shape
    step = settings.integrations_per_solve
    groups = [(first, min(first + step, n_times)) for first in range(0, n_times, step)]
    for p in range(n_polarizations):
        warm: WarmStart | None = None
        for index, (first, last) in enumerate(groups):
            shared = repeat_structure(structure, last - first)
            with Usage() as usage:
                problem = _problem(shared, settings, measured, slice(first, last), p)
                if isinstance(problem, str):
                    solution = _skipped(shared, problem)
                else:
                    solution, warm = solve_warm(problem, solver, warm if settings.solver.warm_start else None)
            yield Solve(first, last, p, solution, usage.peak_memory)
            if progress is not None:
                progress(p * len(groups) + index + 1, len(groups) * n_polarizations)


def _problem(
    structure: FitStructure, settings: CalibrationSettings, measured: Measured, times: slice, p: int
) -> CalibrationProblem | str:
    """Return the problem of some integrations, or the reason why there is none."""

    def rows(cube: np.ndarray) -> np.ndarray:
        return cube[times, :, :, p].reshape(structure.n_baselines, structure.n_frequencies)

    weights, visibilities = rows(measured.weights), rows(measured.visibilities)
    flagged = float(np.mean(weights == 0))
    if flagged == 1:
        return "every sample is flagged or has no weight"
    if flagged >= settings.skip_flagged:
        return f"{100 * flagged:.0f} % of the samples are flagged, which skip_flagged excludes"
    if not np.any(visibilities, where=weights > 0):
        return "the data are zero"
    return CalibrationProblem(
        structure,
        visibilities,
        weights,
        measured.start[:, :, times.start, p],
        None if measured.sky is None else rows(measured.sky),
        settings.prior,
        settings.calibrator == "sky-based",
    )


def _skipped(structure: FitStructure, message: str) -> Solution:
    gains = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    model = np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    return Solution(gains, model, np.empty(0), "skipped", message, 0, 0.0)


def _record(data: UVData, solve: Solve) -> SolveRecord:
    solution = solve.solution
    return SolveRecord(
        integration=solve.first,
        n_integrations=solve.last - solve.first,
        time=float(data.time_array[solve.first * data.Nbls]),
        polarization=int(data.polarization_array[solve.polarization]),
        status=solution.status,
        message=solution.message,
        n_steps=solution.n_steps,
        loss_history=solution.loss_history,
        seconds=solution.seconds,
        peak_memory=solve.peak_memory,
    )


def _has_data(structure: FitStructure, used: np.ndarray) -> np.ndarray:
    """Return which antennas and channels, (Nants, Nfreqs), have any baseline that is used, (Nbls, Nfreqs)."""
    found = np.zeros((structure.n_antennas, structure.n_frequencies), bool)
    for column in structure.antennas.T:
        np.logical_or.at(found, column, used)
    return found


def _fitted_baselines(data: UVData, autos: bool) -> np.ndarray:
    """Return which baselines are calibrated, shape (Nbls,), after checking that there are some."""
    require_parallel_hands(data)
    to_cube(data)
    is_auto = antenna_pairs(data)[:, 0] == antenna_pairs(data)[:, 1]
    if autos and not is_auto.any():
        raise ValueError("calibration.autos is true, but the data hold no autocorrelations")
    if not autos and is_auto.all():
        raise ValueError("the data hold no cross-correlations, so that there is nothing to calibrate")
    return np.ones(is_auto.shape, bool) if autos else ~is_auto


def fitted_part(data: UVData, autos: bool) -> UVData:
    """Return the baselines that are calibrated; raises as `calibrate` does if there are none."""
    return _keep(data, _fitted_baselines(data, autos))


def _keep(data: UVData, fitted: np.ndarray) -> UVData:
    if fitted.all():
        return data
    return data.select(blt_inds=np.flatnonzero(np.tile(fitted, data.Ntimes)), inplace=False)


def _require_finite(data: UVData) -> None:
    bad = ~(np.isfinite(to_cube(data)) | flag_cube(data))
    if bad.any():
        t, baseline, channel, _ = np.argwhere(bad)[0]
        a, b = antenna_pairs(data)[baseline]
        raise ValueError(
            f"{bad.sum()} unflagged visibilities are not finite, the first on baseline ({a}, {b}), integration {t}, "
            f"channel {channel}; flag them"
        )


def _matching_cube(sky_model: UVData, data: UVData) -> np.ndarray:
    """Return the sky model's cube; ValueError unless it has the baselines, times, channels and hands of the data."""
    sky = to_cube(sky_model)
    if (
        sky.shape != to_cube(data).shape
        or not np.array_equal(antenna_pairs(sky_model), antenna_pairs(data))
        or not np.allclose(sky_model.freq_array, data.freq_array, rtol=1e-9, atol=0)
        or not np.allclose(sky_model.time_array, data.time_array, rtol=0, atol=1e-6)
        or not np.array_equal(sky_model.polarization_array, data.polarization_array)
    ):
        raise ValueError(
            "the sky model must have the baselines, times, channels and polarizations of the data, in the same order"
        )
    return sky
