"""Calibrators of your own beside CALAMITY: a function from visibilities to gains and a model of the foregrounds."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.calamity import calibrate
from calstudy.calibrate.products import make_gains, make_visibilities
from calstudy.calibrate.records import CalibrationResult, SolveRecord
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.errors import InputError
from calstudy.plugins import Plugin, load_function
from calstudy.resources import Usage
from calstudy.visibilities import antenna_pairs, flag_cube, to_cube


def run_calibrator(data: UVData, settings: CalibrationSettings, sky_model: UVData | None) -> CalibrationResult:
    """Calibrate with the calibrator that the settings name, CALAMITY or one's own; parameters as for both."""
    if settings.code is None:
        return calibrate(data, settings, sky_model)
    return calibrate_with(settings.code, data, sky_model)


def calibrate_with(plugin: Plugin, data: UVData, sky_model: UVData | None) -> CalibrationResult:
    """Calibrate with a function of one's own.

    The function is called as ``function(data, sky_model, **options)`` with copies of both, and returns the pair
    ``(gains, model)``:

    gains
        UVCal (see `calstudy.gains.make_uvcal`) for all antennas, channels, integrations (or one for all of them) and
        polarizations of the data, V = g_a g_b* F. Flagged gains flag what they calibrate.
    model
        UVData: the intrinsic foregrounds F for the samples of the data, or None for the sky model itself.

    The residual is R = V / (g_a g_b*) - F, as for CALAMITY.

    Parameters
    ----------
    plugin
        Where the function is, and its options.
    data
        Visibilities, rectangular and time-major.
    sky_model
        Visibilities of the foregrounds that are known, with the samples of `data`, or None.

    Raises
    ------
    InputError
        If the function cannot be loaded, or returns something else.
    """
    function = load_function(plugin)
    where = f"{plugin.function} of {plugin.path.name}"
    copy = None if sky_model is None else sky_model.copy()
    with Usage() as usage:
        returned = function(data.copy(), copy, **plugin.options)
    if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[0], UVCal)):
        raise InputError(f"{where}: must return the pair (gains, model), a UVCal and a UVData or None")
    gains, model = returned[0], sky_model if returned[1] is None else returned[1]
    if model is None:
        raise InputError(f"{where}: returns no model, and there is no sky model to take its place")
    values, gain_flags = _gain_values(gains, data, where)
    numbers = {int(number): row for row, number in enumerate(gains.ant_array)}
    rows = np.array([[numbers[int(number)] for number in pair] for pair in antenna_pairs(data)])
    products = _by_time(values[rows[:, 0]] * values[rows[:, 1]].conj())
    flags = _by_time(gain_flags[rows[:, 0]] | gain_flags[rows[:, 1]])
    visibilities, foregrounds = to_cube(data), _model_cube(model, data, where)
    flags = flags | flag_cube(data)
    residual = np.where(flags, 0, visibilities / products - foregrounds)
    seconds = usage.seconds / (data.Ntimes * data.Npols)
    return CalibrationResult(
        make_gains(data, gains.ant_array, values, gain_flags),
        make_visibilities(data, np.where(flags, 0, foregrounds), flags),
        make_visibilities(data, residual, flags),
        tuple(_records(data, where, seconds, usage.peak_memory)),
    )


def _gain_values(gains: UVCal, data: UVData, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and their flags for every integration, (Nants, Nfreqs, Ntimes, Npols)."""
    missing = sorted(set(antenna_pairs(data).ravel().tolist()) - set(gains.ant_array.tolist()))
    if missing:
        raise InputError(f"{where}: returns no gains for antenna {missing[0]}")
    shape = (data.Nfreqs, data.Ntimes, data.Npols)
    if gains.gain_array.shape[1:] not in (shape, (data.Nfreqs, 1, data.Npols)):
        raise InputError(
            f"{where}: returns gains of shape {gains.gain_array.shape} (antennas, channels, integrations, "
            f"polarizations) for data of {shape} (channels, integrations, polarizations)"
        )
    if gains.gain_convention != "divide":
        raise InputError(f"{where}: returns gains of the convention {gains.gain_convention!r}; it must be 'divide'")
    values = np.broadcast_to(gains.gain_array, (gains.Nants_data, *shape))
    flags = np.broadcast_to(gains.flag_array, values.shape)
    if not np.isfinite(values[~flags]).all() or (values[~flags] == 0).any():
        raise InputError(f"{where}: returns gains that are zero or not finite, and not flagged")
    return np.where(flags, 1, values), flags


def _by_time(products: np.ndarray) -> np.ndarray:
    """Return (Nbls, Nfreqs, Ntimes, Npols) as (Ntimes, Nbls, Nfreqs, Npols)."""
    return np.moveaxis(products, 2, 0)


def _model_cube(model: UVData, data: UVData, where: str) -> np.ndarray:
    if not isinstance(model, UVData) or model.data_array.shape != data.data_array.shape:
        raise InputError(f"{where}: the model must be a UVData with the samples of the data, or None")
    cube = to_cube(model)
    if not np.isfinite(cube).all():
        raise InputError(f"{where}: returns a model that is not finite")
    return cube


def _records(data: UVData, where: str, seconds: float, peak_memory: int) -> list[SolveRecord]:
    times = np.unique(data.time_array)
    return [
        SolveRecord(
            integration=index,
            n_integrations=1,
            time=float(moment),
            polarization=int(polarization),
            status="converged",
            message=f"returned by {where}",
            n_steps=0,
            loss_history=np.zeros(0),
            seconds=seconds,
            remaining=np.nan,
            remaining_rms=np.nan,
            peak_memory=peak_memory,
        )
        for polarization in data.polarization_array
        for index, moment in enumerate(times)
    ]
