"""CALAMITY (Ewall-Wice et al. 2022): visibilities in, gains, foreground model and calibrated residual out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, flag_weights, gain_products
from calstudy.calibrate.products import make_uvcal, make_visibilities, parallel_hands
from calstudy.calibrate.settings import CalibrationSettings, GaussNewtonSettings
from calstudy.calibrate.solution import Solution
from calstudy.calibrate.solvers.first_order import FirstOrder
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import Solver, WarmStart, solve_warm
from calstudy.instrument.layouts import redundant_groups
from calstudy.visibilities import antenna_pairs, baseline_vectors, flag_cube, to_cube

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SolveRecord:
    """How the solve of one integration and polarization went; fields as in `calstudy.calibrate.solution.Solution`.

    Attributes
    ----------
    integration
        Index of the integration.
    time
        Its Julian date.
    polarization
        Polarization number of the AIPS convention, such as -5 for XX.
    """

    integration: int
    time: float
    polarization: int
    status: str
    message: str
    n_steps: int
    loss_history: np.ndarray
    seconds: float

    def summary(self) -> dict[str, Any]:
        """Return everything but the full loss history, as plain JSON types."""
        losses = self.loss_history
        return {
            "integration": self.integration,
            "time": self.time,
            "polarization": self.polarization,
            "status": self.status,
            "message": self.message,
            "n_steps": self.n_steps,
            "first_loss": float(losses[0]) if losses.size else None,
            "last_loss": float(losses[-1]) if losses.size else None,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """What `calibrate` returns.

    Attributes
    ----------
    gains
        Gains g of each antenna, channel and integration, gain convention ``divide``: V = g_a g_b* m. Flagged where
        an antenna has no data in a channel, and where a solve was skipped or failed; unity there.
    model
        The intrinsic foregrounds F, in the unit of the data.
    residual
        R = V / (g_a g_b*) - F, zero where flagged.
    solutions
        One record per solve, polarization by polarization, each in the order of time.
    """

    gains: UVCal
    model: UVData
    residual: UVData
    solutions: tuple[SolveRecord, ...]

    def summary(self) -> dict[str, Any]:
        """Return the number of solves by status, total seconds, and every record, as plain JSON types."""
        statuses = [record.status for record in self.solutions]
        return {
            "solves": len(statuses),
            "by_status": {status: statuses.count(status) for status in sorted(set(statuses))},
            "seconds": sum(record.seconds for record in self.solutions),
            "records": [record.summary() for record in self.solutions],
        }


def make_solver(settings: CalibrationSettings) -> Solver:
    """Return the solver of the `calibration.solver` section."""
    solver = settings.solver
    if isinstance(solver, GaussNewtonSettings):
        return GaussNewton(solver.tolerance, solver.max_steps)
    return FirstOrder(solver.name, solver.learning_rate, solver.tolerance, solver.max_steps, solver.precision)


def make_structure(data: UVData, settings: CalibrationSettings) -> tuple[FitStructure, np.ndarray]:
    """Return the structure of the fit of `data`, and the antenna numbers that its antenna indices stand for.

    A redundant group is modelled with the basis of its longest baseline.

    Raises
    ------
    ValueError
        If the basis does not fit into the channels (see `calstudy.calibrate.basis.make_basis`).
    """
    numbers, antennas = np.unique(antenna_pairs(data), return_inverse=True)
    antennas = antennas.reshape(-1, 2)
    vectors = baseline_vectors(data)
    lengths = np.linalg.norm(vectors, axis=1)
    frequencies = data.freq_array
    if settings.calibrator == "calamity":
        basis = make_basis(lengths, frequencies, settings.basis)
        return FitStructure.per_baseline(antennas, len(numbers), basis), numbers
    groups = redundant_groups(vectors, settings.redundancy_tolerance)
    longest = np.zeros(groups.index.max() + 1)
    np.maximum.at(longest, groups.index, lengths)
    basis = make_basis(longest, frequencies, settings.basis)
    return FitStructure(antennas, len(numbers), basis, groups.index, groups.conjugated), numbers


def calibrate(
    data: UVData,
    settings: CalibrationSettings,
    sky_model: UVData | None = None,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Solve for gains and foregrounds, independently for every integration and polarization.

    Parameters
    ----------
    data
        Visibilities, rectangular and time-major, with parallel-hand polarizations only; not changed. Flagged samples
        have no influence. Autocorrelations are left out, also of the results, unless `settings.autos` is set.
    settings
        Calibrator, foreground basis, solver and prior.
    sky_model
        Visibilities whose weighted sum fixes the overall scale, with the baselines, times, channels and polarizations
        of `data`; the data themselves if none is given, which makes gains of about unity.
    progress
        Called after each solve with the number done and the total.

    Raises
    ------
    ValueError
        If the data are not rectangular, not finite where unflagged, of cross-hand polarizations, without any baseline
        to fit, or differ from the sky model in shape; or if the basis does not fit into the channels.
    """
    data = _fitted_part(data, settings.autos)
    sky = None if sky_model is None else _matching_cube(_fitted_part(sky_model, settings.autos), data)
    _require_finite(data)
    structure, numbers = make_structure(data, settings)
    visibilities, flags = to_cube(data), flag_cube(data)
    n_times, _, n_frequencies, n_polarizations = visibilities.shape
    gains = np.ones((len(numbers), n_frequencies, n_times, n_polarizations), complex)
    gain_flags = np.ones(gains.shape, bool)
    model = np.zeros_like(visibilities)
    residual = np.zeros_like(visibilities)
    residual_flags = flags.copy()
    records = []
    for t, p, solution in _solve_all(structure, settings, visibilities, flags, sky):
        records.append(_record(data, t, p, solution))
        if solution.usable:
            used = ~flags[t, :, :, p]
            gain_flags[:, :, t, p] = ~_has_data(structure, used)
            gains[:, :, t, p] = np.where(gain_flags[:, :, t, p], 1, solution.gains)
            model[t, :, :, p] = solution.model
            products = gain_products(gains[:, :, t, p], structure.antennas)
            calibrated = np.where(used, visibilities[t, :, :, p], 0) / products
            residual[t, :, :, p] = np.where(used, calibrated - solution.model, 0)
        else:
            residual_flags[t, :, :, p] = True
        if progress is not None:
            progress(len(records), n_times * n_polarizations)
    return CalibrationResult(
        make_uvcal(data, numbers, gains, gain_flags),
        make_visibilities(data, model, residual_flags),
        make_visibilities(data, residual, residual_flags),
        tuple(records),
    )


def _solve_all(
    structure: FitStructure,
    settings: CalibrationSettings,
    visibilities: np.ndarray,
    flags: np.ndarray,
    sky: np.ndarray | None,
) -> Iterator[tuple[int, int, Solution]]:
    """Yield (integration, polarization, solution) for every solve; arrays are (Ntimes, Nbls, Nfreqs, Npols)."""
    solver = make_solver(settings)
    unity = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    for p in range(visibilities.shape[3]):
        warm: WarmStart | None = None
        for t in range(visibilities.shape[0]):
            weights = flag_weights(flags[t, :, :, p])
            if not np.any(visibilities[t, :, :, p], where=weights > 0):
                yield t, p, _skipped(structure, "every sample is flagged" if not weights.any() else "the data are zero")
                continue
            problem = CalibrationProblem(
                structure,
                visibilities[t, :, :, p],
                weights,
                unity,
                None if sky is None else sky[t, :, :, p],
                settings.prior,
            )
            solution, warm = solve_warm(problem, solver, warm if settings.solver.warm_start else None)
            yield t, p, solution


def _skipped(structure: FitStructure, message: str) -> Solution:
    gains = np.ones((structure.n_antennas, structure.n_frequencies), complex)
    model = np.zeros((structure.n_baselines, structure.n_frequencies), complex)
    return Solution(gains, model, np.empty(0), "skipped", message, 0, 0.0)


def _record(data: UVData, t: int, p: int, solution: Solution) -> SolveRecord:
    return SolveRecord(
        integration=t,
        time=float(data.time_array[t * data.Nbls]),
        polarization=int(data.polarization_array[p]),
        status=solution.status,
        message=solution.message,
        n_steps=solution.n_steps,
        loss_history=solution.loss_history,
        seconds=solution.seconds,
    )


def _has_data(structure: FitStructure, used: np.ndarray) -> np.ndarray:
    """Return which antennas and channels, (Nants, Nfreqs), have any baseline that is used, (Nbls, Nfreqs)."""
    found = np.zeros((structure.n_antennas, structure.n_frequencies), bool)
    for column in structure.antennas.T:
        np.logical_or.at(found, column, used)
    return found


def _fitted_part(data: UVData, autos: bool) -> UVData:
    """Return the data without autocorrelations unless these are fitted, after checking the polarizations."""
    parallel_hands(data)
    is_auto = data.ant_1_array == data.ant_2_array
    if autos and not is_auto.any():
        raise ValueError("calibration.autos is true, but the data hold no autocorrelations")
    if autos or not is_auto.any():
        return data
    if is_auto.all():
        raise ValueError("the data hold no cross-correlations, so that there is nothing to calibrate")
    return data.select(ant_str="cross", inplace=False)


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
