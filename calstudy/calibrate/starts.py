"""Starting points of a solve: unity, gains from a file, or redundant calibration by hera_cal's firstcal and logcal.

Redundant baselines measure the same sky, so that the ratios of their visibilities are ratios of gains (Liu et al.
2010). A delay and a phase for each antenna (firstcal) bring phases within reach of the logarithm, in which the
equations are linear (logcal). Redundancy does not determine amplitude, phase and phase gradients of the whole array.
These are set to unity, or stay as firstcal has them.
"""

from __future__ import annotations

import warnings

import numpy as np
from pyuvdata import UVCal

from calstudy.base.errors import InputError
from calstudy.base.gains import gains_for
from calstudy.base.observation import Observation
from calstudy.calibrate.settings import RedundantStart
from calstudy.instrument.layouts import redundant_groups

# hera_cal wants a name for the polarization; solves are one polarization at a time.
POL = "nn"


def starting_gains(data: Observation, gains: UVCal | None) -> np.ndarray:
    """Return the gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols); unity if `gains` is None.

    Of several integrations the closest in time is used; flagged, zero and infinite gains are replaced by unity. Raises
    InputError if an antenna, channel or polarization of the data has no gain, or if the gains are delays.
    """
    if gains is None:
        return np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    values = gains_for(gains, data.uvd)
    rows = {int(number): row for row, number in enumerate(data.uvd.telescope.antenna_numbers)}
    values = values[[rows[int(number)] for number in data.numbers]]
    centres = gains.time_array if gains.time_array is not None else np.mean(gains.time_range, axis=1)
    closest = np.abs(centres[None] - data.times[:, None]).argmin(axis=1)
    values = values[:, :, closest]
    return np.where(np.isfinite(values) & (values != 0), values, 1)


def redundant_start(data: Observation, weights: np.ndarray, settings: RedundantStart, tolerance: float) -> np.ndarray:
    """Solve redundant baselines for gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols).

    Autocorrelations and samples of weight zero, (Ntimes, Nbls, Nfreqs, Npols), have no influence. Baselines that differ
    by less than `tolerance`, in m, are redundant. Gains are unity for antennas without redundant baselines, and where
    the solution is not finite. Raises InputError if no two baselines are redundant.
    """
    pairs, cube = data.pairs, data.visibilities
    groups = redundant_groups(data.vectors, tolerance)
    members = [np.flatnonzero(groups.index == group) for group in range(groups.index.max() + 1)]
    members = [rows for rows in members if rows.size > 1 and pairs[rows[0], 0] != pairs[rows[0], 1]]
    if not members:
        raise InputError(
            "calibration.initial_gains: 'redundant' needs redundant baselines, and no two differ by less than "
            f"redundancy_tolerance = {tolerance:g} m; start from unity or a file"
        )
    turned = {row: groups.conjugated[row] for rows in members for row in rows}
    ends = {row: pairs[row][::-1] if back else pairs[row] for row, back in turned.items()}
    keys = {row: (int(first), int(second), POL) for row, (first, second) in ends.items()}
    reds = [[keys[row] for row in rows] for rows in members]
    gains = np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    for p in range(data.n_polarizations):
        used = {keys[row]: weights[:, row, :, p] for row in keys}
        # The logarithm must not be taken of zeros, even where the weight is zero.
        visibilities = {
            keys[row]: np.where(used[keys[row]] > 0, np.conj(cube[:, row, :, p]) if back else cube[:, row, :, p], 1)
            for row, back in turned.items()
        }
        solved = _solve(reds, visibilities, used, data.frequencies, settings.delays)
        for row, number in enumerate(data.numbers):
            if int(number) in solved:
                gains[row, :, :, p] = solved[int(number)].T
    return np.where(np.isfinite(gains) & (gains != 0), gains, 1)


def _solve(
    reds: list[list[tuple[int, int, str]]],
    visibilities: dict[tuple[int, int, str], np.ndarray],
    weights: dict[tuple[int, int, str], np.ndarray],
    frequency: np.ndarray,
    delays: bool,
) -> dict[int, np.ndarray]:
    """Solve for the gains (Ntimes, Nfreqs) of every antenna with redundant baselines."""
    from hera_cal.datacontainer import DataContainer
    from hera_cal.redcal import RedundantCalibrator

    calibrator = RedundantCalibrator(reds)
    data = DataContainer(visibilities)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # Channels without data make singular equations; their gains are replaced by unity.
        warnings.simplefilter("ignore")
        first = calibrator.firstcal(data, frequency)[1].gains if delays else {}
        # Degeneracies are fixed where phases are small: elsewhere they may jump by a lattice's worth between channels.
        rest = {key: values / _product(first, key, values) for key, values in data.items()}
        _, solution = calibrator.logcal(DataContainer(rest), wgts=DataContainer(weights))
        solution.remove_degen(degen_sol={antenna: np.ones_like(gain) for antenna, gain in solution.gains.items()})
    return {key[0]: np.asarray(gain * first.get(key, 1), complex) for key, gain in solution.gains.items()}


def _product(gains: dict[tuple[int, str], np.ndarray], key: tuple[int, int, str], like: np.ndarray) -> np.ndarray:
    """Return g_a g_b* of a baseline; unity if there are no gains."""
    from hera_cal.utils import split_bl

    first, second = split_bl(key)
    return gains.get(first, np.ones_like(like)) * np.conj(gains.get(second, np.ones_like(like)))
