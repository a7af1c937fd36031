"""Catalogues of point sources in CSV files with a header line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.table import Table
from pyradiosky import SkyModel

from calstudy.sky.settings import CsvColumns


def read_csv_catalogue(path: Path, columns: CsvColumns) -> SkyModel:
    """Read point sources from a CSV file with a header line; rows without a position or flux density are left out.

    The columns are right ascension and declination (ICRS, degrees), flux density (Jy) and spectral index. Raises
    ValueError if a column is missing or not numeric, or a selected source has no spectral index.
    """
    table = Table.read(path, format="ascii.csv")
    wanted = {key: getattr(columns, key) for key in ("right_ascension", "declination", "flux", "spectral_index")}
    named = {key: name for key, name in wanted.items() if name is not None}
    missing = [name for name in named.values() if name not in table.colnames]
    if missing:
        raise ValueError(f"there is no column {missing[0]}, only {', '.join(table.colnames)}")
    values: dict[str, np.ndarray] = {
        key: np.ma.filled(np.ma.asarray(table[name], dtype=float), np.nan) for key, name in named.items()
    }
    usable = np.isfinite([values[key] for key in ("right_ascension", "declination", "flux")]).all(axis=0)
    values = {key: column[usable] for key, column in values.items()}
    stokes = np.zeros((4, 1, int(usable.sum()))) * units.Jy
    stokes[0, 0] = values["flux"] * units.Jy
    spectrum: dict[str, Any] = {"spectral_type": "flat"}
    if "spectral_index" in values:
        spectrum = {"spectral_type": "spectral_index", "spectral_index": values["spectral_index"]}
    return SkyModel(
        name=np.flatnonzero(usable).astype(str),
        skycoord=SkyCoord(values["right_ascension"], values["declination"], unit="deg", frame="icrs"),
        stokes=stokes,
        reference_frequency=np.full(stokes.shape[2], columns.frequency) * units.Hz,
        component_type="point",
        history="calstudy foregrounds",
        **spectrum,
    )
