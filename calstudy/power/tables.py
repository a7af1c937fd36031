"""Files of power spectra: HDF5 with units, and CSV."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import h5py
import numpy as np

from calstudy.base.table import Table
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.transfer import TransferFunction

Spectrum = TypeVar("Spectrum")
"""A dataclass of arrays and numbers."""

CSV_COLUMNS = {
    "k [h/Mpc]": lambda s: s.k,
    "power real [mK2 h-3 Mpc3]": lambda s: s.power.real,
    "power imag [mK2 h-3 Mpc3]": lambda s: s.power.imag,
    "noise error [mK2 h-3 Mpc3]": lambda s: s.noise_error,
    "sample error [mK2 h-3 Mpc3]": lambda s: s.sample_error,
    "modes": lambda s: s.n_modes,
    "independent modes of noise": lambda s: s.noise_modes,
    "independent modes of signal": lambda s: s.sample_modes,
    "independent modes of signal x noise": lambda s: s.cross_modes,
}


TRANSFER_COLUMNS = {
    "k [h/Mpc]": lambda t: t.k,
    "k from [h/Mpc]": lambda t: t.bin_edges[:-1],
    "k to [h/Mpc]": lambda t: t.bin_edges[1:],
    "transfer": lambda t: t.transfer,
    "transfer error": lambda t: t.transfer_error,
    "cross transfer": lambda t: t.cross_transfer,
    "cross transfer error": lambda t: t.cross_transfer_error,
    "transfer without flux scale": lambda t: t.scale_free_transfer,
    "transfer without flux scale error": lambda t: t.scale_free_transfer_error,
    "flux scale": lambda t: np.full(t.k.size, t.flux_scale),
    "squared coherence": lambda t: t.squared_coherence,
    "squared coherence error": lambda t: t.squared_coherence_error,
    "baselines or groups": lambda t: t.n_samples,
}


def save_spectrum(path: Path, spectrum: Any) -> None:
    """Write every field as an HDF5 data set of its name with the attribute ``unit``, replacing the file."""
    with h5py.File(path, "w") as file:
        file.attrs["kind"] = type(spectrum).__name__
        for item in dataclasses.fields(spectrum):
            file.create_dataset(item.name, data=getattr(spectrum, item.name))
            file[item.name].attrs["unit"] = item.metadata["unit"]


def load_spectrum(path: Path, kind: type[Spectrum]) -> Spectrum:
    """Read a file of `save_spectrum`; raise ValueError if it holds another kind of spectrum."""
    with h5py.File(path, "r") as file:
        found = file.attrs.get("kind")
        if found != kind.__name__:
            raise ValueError(f"{path} holds {found!r}, expected {kind.__name__!r}")
        # A field that an older file lacks has its default.
        fields = dataclasses.fields(cast(Any, kind))
        values = {item.name: _value(file[item.name]) for item in fields if item.name in file}
    return kind(**values)


def _value(data: h5py.Dataset) -> Any:
    if h5py.check_string_dtype(data.dtype) is not None:
        return data.asstr()[()]
    return data[()].item() if data.shape == () else data[()]


def write_csv(path: Path, spectrum: SphericalSpectrum | TransferFunction) -> None:
    """Write a spherical spectrum or a transfer function as CSV, one row per bin of |k|, units in the header."""
    columns = TRANSFER_COLUMNS if isinstance(spectrum, TransferFunction) else CSV_COLUMNS
    write_columns(path, {name: values(spectrum) for name, values in columns.items()})


def write_columns(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write arrays of equal length as CSV, by the names of their columns."""
    rows = list(zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True))
    Table(list(columns), rows).write_csv(path)
