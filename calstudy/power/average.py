"""Fringe stopping and coherent averaging over a run (paper §Reduction of Simulation Products and Power Spectra)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.time import Time
from pyuvdata import UVData

from calstudy.base.visibilities import require_rectangular
from calstudy.instrument.telescope import use_bundled_earth_orientation

SECONDS_PER_DAY = 86400.0


def fringe_stop_and_average(uvd: UVData, centre: float | None = None) -> UVData:
    """Phase to the zenith at the middle of the run and average all integrations into one.

    Parameters
    ----------
    uvd
        Drift-scan visibilities. Not mutated. Flagged samples do not enter the average; samples weigh by nsamples.
    centre
        Julian date in place of the middle, for data sets that are to have the same phase centre; integrations may then
        be missing.

    Returns
    -------
    UVData with one integration, phased to the ICRS position of the zenith at the middle of the run, in the same unit
    and with the baselines in the same order.

    Raises
    ------
    ValueError
        If the data set is not rectangular.
    """
    require_rectangular(uvd)
    use_bundled_earth_orientation()
    date = (uvd.time_array.min() + uvd.time_array.max()) / 2 if centre is None else centre
    averaged = uvd.copy()
    averaged.phase_to_time(Time(date, format="jd", scale="utc"))
    if averaged.Ntimes > 1:
        with warnings.catch_warnings():
            if centre is not None:
                for message in ("There is a gap in the times", "The time difference between integrations"):
                    warnings.filterwarnings("ignore", message=message)
            averaged.downsample_in_time(n_times_to_avg=averaged.Ntimes, allow_drift=False)
    # pyuvdata sorts by baseline number; bring back the order of the input.
    averaged.reorder_blts(order=_positions(averaged.baseline_array, uvd.baseline_array[: uvd.Nbls]))
    averaged.data_array = averaged.data_array.astype(np.complex128, copy=False)
    return averaged


@dataclass(frozen=True)
class Block:
    """Consecutive integrations that are averaged into one.

    Attributes
    ----------
    times
        Their indices, (n,).
    centre
        Julian date at which the phase centre is at the zenith; None for their middle.
    number
        Of the block among those of the run, from 0.
    """

    times: np.ndarray
    centre: float | None = None
    number: int = 0


def divide(times_jd: np.ndarray, integration: float, count: int, span: Sequence[float] | None = None) -> list[Block]:
    """Divide a run into blocks of the same duration.

    Parameters
    ----------
    times_jd
        Julian dates of the integrations, ascending, (n,).
    integration
        Duration of one, s.
    count
        Number of blocks, see `calstudy.power.settings.PowerSettings.n_blocks`.
    span
        First and last integration of the run, if others than those in `times_jd`, for data sets whose blocks are to
        have the same phase centres.

    Returns
    -------
    The blocks that have integrations.
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
    """Average the integrations of each block as `fringe_stop_and_average` does.

    Parameters
    ----------
    uvd
        Drift-scan visibilities. Not mutated.
    blocks
        From `divide`.

    Returns
    -------
    UVData with one integration for each block, phased to its own centre.
    """
    if len(blocks) == 1 and blocks[0].times.size == uvd.Ntimes:
        return fringe_stop_and_average(uvd, blocks[0].centre)
    times = np.unique(uvd.time_array)
    averages = [
        fringe_stop_and_average(uvd.select(times=times[block.times], inplace=False, run_check=False), block.centre)
        for block in blocks
    ]
    return averages[0].fast_concat(averages[1:], "blt", inplace=False)


def _positions(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Where each of `wanted` is in `values`, both 1D of unique entries."""
    order = np.argsort(values)
    return order[np.searchsorted(values, wanted, sorter=order)]
