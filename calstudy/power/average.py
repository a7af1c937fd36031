"""Fringe stopping and coherent averaging over a run (paper §Reduction of Simulation Products and Power Spectra)."""

from __future__ import annotations

import warnings

import numpy as np
from astropy.time import Time
from pyuvdata import UVData

from calstudy.base.visibilities import require_rectangular
from calstudy.instrument.telescope import use_bundled_earth_orientation


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


def _positions(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Where each of `wanted` is in `values`, both 1D of unique entries."""
    order = np.argsort(values)
    return order[np.searchsorted(values, wanted, sorter=order)]
