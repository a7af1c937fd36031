"""Power spectra, transfer functions and scores as labelled arrays of xarray, with units in the attributes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from calstudy.power.score import Score
    from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
    from calstudy.power.transfer import TransferFunction, TransferMap

OF_DELAY = ("delay", "k_parallel")
"""Fields of spectra by baseline length and delay that have one value for each delay."""
COORDINATES = ("k", "baseline_length", "k_perp", *OF_DELAY, "horizon_delay")


def by_wavenumber(spectrum: SphericalSpectrum | TransferFunction | Score) -> xarray.Dataset:
    """Return quantities in bins of |k| with the coordinates `k`, `k_from` and `k_to`, h/Mpc.

    Numbers that hold for all bins, such as the flux scale, are attributes.
    """
    arrays = {item.name: (("k",), getattr(spectrum, item.name)) for item in _arrays(spectrum)}
    edges = spectrum.bin_edges
    arrays |= {"k_from": (("k",), edges[:-1]), "k_to": (("k",), edges[1:])}
    return _dataset(spectrum, arrays, ("k", "k_from", "k_to"))


def by_length_and_delay(spectrum: CylindricalSpectrum | TransferMap) -> xarray.Dataset:
    """Return quantities in bins of baseline length, m, and delay, s, with `k_perp` and `k_parallel`, h/Mpc."""
    arrays = {}
    for item in _arrays(spectrum):
        values = getattr(spectrum, item.name)
        two = ("baseline_length", "delay")
        arrays[item.name] = (two if values.ndim == 2 else (two[item.name in OF_DELAY],), values)
    edges = spectrum.bin_edges
    arrays |= {f"length_{end}": (("baseline_length",), edges[:, place]) for place, end in enumerate(("from", "to"))}
    return _dataset(spectrum, arrays, (*COORDINATES, "length_from", "length_to"))


def gain_errors(path: Path) -> xarray.Dataset:
    """Return standard deviations `amplitude`, of |g|, and `phase`, rad, of a file of gains; raises InputError if none.

    Coordinates are `antenna` (number), `frequency` (Hz), `time` (JD) and `feed` (AIPS number of the Jones element).
    """
    import xarray
    from pyuvdata import UVCal

    from calstudy.base.gains import read_gain_errors

    amplitude, phase = read_gain_errors(path)
    gains = UVCal.from_file(path)
    places = {"antenna": gains.ant_array, "frequency": gains.freq_array, "time": gains.time_array}
    coordinates = {**places, "feed": gains.jones_array}
    found = xarray.Dataset(
        {"amplitude": (tuple(coordinates), amplitude), "phase": (tuple(coordinates), phase)}, coordinates
    )
    for name, unit in (("phase", "rad"), ("frequency", "Hz"), ("time", "JD")):
        found[name].attrs["units"] = unit
    return found


def _arrays(spectrum: object) -> list[dataclasses.Field]:
    fields = dataclasses.fields(spectrum)  # type: ignore[arg-type]
    return [item for item in fields if item.name != "bin_edges" and np.ndim(getattr(spectrum, item.name)) > 0]


def _dataset(
    spectrum: object, arrays: Mapping[str, tuple[tuple[str, ...], np.ndarray]], coordinates: tuple[str, ...]
) -> xarray.Dataset:
    import xarray

    fields = {item.name: item for item in dataclasses.fields(spectrum)}  # type: ignore[arg-type]
    edges = fields["bin_edges"].metadata["unit"]
    units = {name: fields[name].metadata["unit"] if name in fields else edges for name in arrays}
    variables = {
        name: xarray.Variable(dims, values, {"units": units[name]} if units[name] else {})
        for name, (dims, values) in arrays.items()
    }
    single = {name: getattr(spectrum, name) for name in fields if name not in arrays and name != "bin_edges"}
    return xarray.Dataset(
        {name: value for name, value in variables.items() if name not in coordinates},
        {name: value for name, value in variables.items() if name in coordinates},
        {name: value for name, value in single.items() if np.ndim(value) == 0},
    )
