"""Fringe stopping and coherent averaging over a run (paper §Reduction of Simulation Products and Power Spectra)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.time import Time
from pyuvdata import UVData

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.visibilities import (
    flag_cube,
    positions,
    require_rectangular,
    to_cube,
    use_bundled_earth_orientation,
)


def fringe_stop_and_average(uvd: UVData, centre: float | None = None) -> UVData:
    """Phase to the zenith at the middle of the run and average all integrations into one.

    Flagged samples do not enter the average; the others weigh by nsamples. `centre` is a Julian date that replaces the
    middle, for data sets that must share a phase centre; integrations may then be missing. The result is phased in
    ICRS, with the unit and the order of baselines of `uvd`, which is not changed. Raise ValueError if `uvd` is not
    rectangular.
    """
    require_rectangular(uvd)
    use_bundled_earth_orientation()
    date = (uvd.time_array.min() + uvd.time_array.max()) / 2 if centre is None else centre
    phased = uvd.copy()
    phased.phase_to_time(Time(date, format="jd", scale="utc"))
    averaged = phased
    if uvd.Ntimes > 1:
        averaged = phased.copy(metadata_only=True)
        with warnings.catch_warnings():
            if centre is not None:
                for message in ("There is a gap in the times", "The time difference between integrations"):
                    warnings.filterwarnings("ignore", message=message)
            averaged.downsample_in_time(n_times_to_avg=uvd.Ntimes, allow_drift=False)
        # pyuvdata sorts by baseline number; bring back the order of the input.
        averaged.reorder_blts(order=positions(averaged.baseline_array, uvd.baseline_array[: uvd.Nbls]))
        averaged.data_array, averaged.flag_array, averaged.nsample_array = _averages(phased)
    averaged.data_array = averaged.data_array.astype(np.complex128, copy=False)
    return averaged


def _averages(uvd: UVData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average data, flags and nsamples over all integrations, (Nbls, Nfreqs, Npols), in their own precision.

    pyuvdata, which goes through the baselines with masked arrays, has the same result in several times the time.
    """
    data, flags = to_cube(uvd), flag_cube(uvd)
    nsamples = uvd.nsample_array.reshape(data.shape)
    durations = uvd.integration_time.reshape(*data.shape[:2], 1, 1)
    flagged: np.ndarray = np.logical_and.reduce(flags, axis=0)
    total, weight = np.zeros(data.shape[1:], complex), np.zeros(data.shape[1:])
    for time in range(uvd.Ntimes):
        # Samples that are flagged in all integrations are averaged as if they were not.
        used = nsamples[time] * durations[time] * (~flags[time] | flagged)
        # Flagged samples may be NaN.
        total += used * np.where(used > 0, data[time], 0)
        weight += used
    kept = weight / durations.sum(axis=0)
    average = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
    return average.astype(data.dtype), flagged, kept.astype(nsamples.dtype)


@dataclass(frozen=True)
class Block:
    """Consecutive integrations, by their indices `times`, (n,), that are averaged into one.

    `centre` is the Julian date at which the phase centre is at the zenith; None for the middle of the integrations.
    `number` is the place of the block in the run, from 0.
    """

    times: np.ndarray
    centre: float | None = None
    number: int = 0


def divide(times_jd: np.ndarray, integration: float, count: int, span: Sequence[float] | None = None) -> list[Block]:
    """Divide a run into `count` blocks of the same duration and return those that have integrations.

    `times_jd` are Julian dates, ascending, (n,), and `integration` is the duration of one, s. `span` is the first and
    the last integration of the run if not those of `times_jd`, for data sets that must share phase centres.
    """
    first, last = span or (times_jd[0], times_jd[-1])
    half = integration / SECONDS_PER_DAY / 2
    edges = np.linspace(first - half, last + half, count + 1)
    place = np.searchsorted(edges[1:-1], times_jd)
    middles = (edges[:-1] + edges[1:]) / 2
    return [
        Block(np.flatnonzero(place == number), float(middles[number]), number) for number in np.unique(place).tolist()
    ]


def average_in_blocks(uvd: UVData, blocks: Sequence[Block]) -> UVData:
    """Average the integrations of each block as `fringe_stop_and_average` does, each block phased to its own centre."""
    if len(blocks) == 1 and blocks[0].times.size == uvd.Ntimes:
        return fringe_stop_and_average(uvd, blocks[0].centre)
    times = np.unique(uvd.time_array)
    averages = [
        fringe_stop_and_average(uvd.select(times=times[block.times], inplace=False, run_check=False), block.centre)
        for block in blocks
    ]
    return averages[0].fast_concat(averages[1:], "blt", inplace=False)
