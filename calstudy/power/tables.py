"""Averaged power spectra on disk: HDF5 with units for programs, CSV for people."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from calstudy.power.spherical import SphericalSpectrum
from calstudy.power.wedge import WedgeSpectrum

Spectrum = TypeVar("Spectrum", SphericalSpectrum, WedgeSpectrum)

CSV_COLUMNS = {
    "k [h/Mpc]": lambda s: s.k,
    "power real [mK2 h-3 Mpc3]": lambda s: s.power.real,
    "power imag [mK2 h-3 Mpc3]": lambda s: s.power.imag,
    "noise error [mK2 h-3 Mpc3]": lambda s: s.noise_error,
    "sample error [mK2 h-3 Mpc3]": lambda s: s.sample_error,
    "modes": lambda s: s.n_modes,
    "independent modes of noise": lambda s: s.noise_modes,
    "independent modes of signal": lambda s: s.sample_modes,
}


def save_spectrum(path: Path, spectrum: SphericalSpectrum | WedgeSpectrum) -> None:
    """Write every field as an HDF5 data set of its name with the attribute ``unit``, replacing the file."""
    with h5py.File(path, "w") as file:
        file.attrs["kind"] = type(spectrum).__name__
        for item in dataclasses.fields(spectrum):
            file.create_dataset(item.name, data=getattr(spectrum, item.name))
            file[item.name].attrs["unit"] = item.metadata["unit"]


def load_spectrum(path: Path, kind: type[Spectrum]) -> Spectrum:
    """Read what `save_spectrum` wrote.

    Raises
    ------
    ValueError
        If the file holds another kind of spectrum.
    """
    with h5py.File(path, "r") as file:
        found = file.attrs.get("kind")
        if found != kind.__name__:
            raise ValueError(f"{path} holds {found!r}, expected {kind.__name__!r}")
        values = {item.name: file[item.name][()] for item in dataclasses.fields(kind)}
    return kind(**{name: value.item() if np.ndim(value) == 0 else value for name, value in values.items()})


def write_csv(path: Path, spectrum: SphericalSpectrum) -> None:
    """Write a spherical spectrum as CSV, one row per bin of |k|, units in the header."""
    columns = [values(spectrum) for values in CSV_COLUMNS.values()]
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
