"""Goodness of fit of a calibration: chi^2 of the fitted integrations, and of integrations that were not fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from astropy.time import Time

from calstudy.base.visibilities import antenna_pairs, flag_cube, from_cube, to_cube
from calstudy.calibrate.settings import ForegroundFit, GainFit
from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.measured.noise import radiometer_variance

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData

    from calstudy.calibrate.problem import CalibrationProblem

NEIGHBOURS = 1.5
"""Largest distance of compared integrations, in integration times."""


def count_unknowns(problem: CalibrationProblem, settings: GainFit) -> float | None:
    """Return the number of complex unknowns of a fit that the data determine; None if a prior determines some.

    Unknowns of channels and antennas without data are left out, and the phase of each channel, which nothing
    determines. The overall scale is one real number and is not counted.
    """
    structure = problem.structure
    if isinstance(settings, ForegroundFit) and settings.foreground_prior.finite:
        return None
    used = problem.weights > 0
    antennas = np.unique(structure.antennas[used.any(axis=1)]).size
    vectors = structure.gain_vectors
    per_antenna = int(used.any(axis=0).sum()) if vectors is None else vectors.shape[1]
    coefficients = 0 if settings.frozen else structure.basis.n_coefficients
    return coefficients + (antennas - 0.5) * per_antenna


def predicted(gains: UVCal, model: UVData) -> UVData:
    """Return the visibilities that a solution predicts, g_a g_b* F, flagged where there is no solution.

    `gains` are of all antennas of the model F, which is calibrated.
    """
    order = np.argsort(gains.ant_array)
    first, second = (order[np.searchsorted(gains.ant_array, column, sorter=order)] for column in antenna_pairs(model).T)
    products = gains.gain_array[first] * gains.gain_array[second].conj()
    unsolved = gains.flag_array[first] | gains.flag_array[second]
    found = from_cube(model, to_cube(model) * np.moveaxis(products, 2, 0))
    flag_cube(found)[:] |= np.moveaxis(unsolved, 2, 0)
    return found


def chi_squared(data: UVData, prediction: UVData) -> tuple[float, int]:
    """Return chi^2, the sum of |V - prediction|^2 / sigma^2, and the number of samples.

    sigma is from the autocorrelations of `data`. The prediction is of some of the baselines, at the same times.
    """
    pairs, total, count = antenna_pairs(prediction), 0.0, 0
    rows = _rows(data, pairs)
    misfit = np.abs(to_cube(data)[:, rows] - to_cube(prediction)) ** 2
    unused = flag_cube(data)[:, rows] | flag_cube(prediction)
    for pol in range(data.Npols):
        variance = radiometer_variance(data, pairs, pol)
        if variance is None:
            raise ValueError("chi^2 needs the autocorrelations of all antennas")
        used = ~unused[..., pol] & np.isfinite(variance)
        total += float(np.sum(misfit[..., pol][used] / variance[used]))
        count += int(used.sum())
    return total, count


def _rows(data: UVData, pairs: np.ndarray) -> list[int]:
    places = {tuple(pair): row for row, pair in enumerate(antenna_pairs(data).tolist())}
    return [places[tuple(pair)] for pair in pairs.tolist()]


def held_out(data: UVData, prediction: UVData) -> tuple[float, int]:
    """Return chi^2 of integrations that were not fitted, from the solutions of the integrations before and after.

    g_a g_b* F does not depend on the degeneracies of a fit. That of the two neighbours, fringe-stopped to the
    integration between them, is averaged: the sky that moves linearly in between cancels. `data`, with
    autocorrelations, was not fitted; `prediction` is g_a g_b* F of the other integrations. The number of samples is
    zero if no integration lies between two others.
    """
    use_bundled_earth_orientation()
    total, count = 0.0, 0
    times, known = (np.unique(uvd.time_array) for uvd in (data, prediction))
    longest = NEIGHBOURS * float(np.max(data.integration_time)) / 86400
    for time in times:
        before, after = known[known < time], known[known > time]
        if not before.size or not after.size or max(time - before[-1], after[0] - time) > longest:
            continue
        own = _stopped(_at(data, [time]), time)
        moved = [_stopped(_at(prediction, [other]), time) for other in (before[-1], after[0])]
        mean = from_cube(_at_rows(own, antenna_pairs(prediction)), (to_cube(moved[0]) + to_cube(moved[1])) / 2)
        mean.flag_array = moved[0].flag_array | moved[1].flag_array
        found, samples = chi_squared(own, mean)
        total, count = total + found, count + samples
    return total, count


def _at(data: UVData, times: list[float]) -> UVData:
    return data.select(blt_inds=np.flatnonzero(np.isin(data.time_array, times)), inplace=False, run_check=False)


def _at_rows(data: UVData, pairs: np.ndarray) -> UVData:
    return data.select(blt_inds=_rows(data, pairs), inplace=False, run_check=False)


def _stopped(data: UVData, time: float) -> UVData:
    """Return data phased to the point that is at the zenith at the given Julian date."""
    found = data.copy()
    found.phase_to_time(Time(time, format="jd", scale="utc"))
    return found
