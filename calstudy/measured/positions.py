"""Antenna positions of measured data that replace wrong ones in the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy import units
from pyuvdata import UVData, utils

from calstudy.base.errors import InputError
from calstudy.instrument.array_layouts.csv import CsvLayout
from calstudy.instrument.layouts import make_layout


def place_antennas(data: UVData, path: Path) -> str:
    """Give antennas their positions, and baselines the vectors between these; return a sentence on the changes.

    `data` are drift-scan visibilities, perhaps only metadata, and are changed. `path` is a CSV file with columns
    number, east_m, north_m and up_m, about the location of the telescope. Raise InputError if the file cannot be used,
    or lacks an antenna of the data, or the data are phased to a source.
    """
    if any(entry["cat_type"] != "unprojected" for entry in data.phase_center_catalog.values()):
        raise InputError("observed.positions: the data are phased to a source, by the positions that they have")
    try:
        layout = make_layout(CsvLayout(kind="csv", path=path))
    except InputError as error:
        raise InputError(str(error).replace("instrument.layout.path", "observed.positions")) from None
    telescope = data.telescope
    present = np.union1d(data.ant_1_array, data.ant_2_array)
    missing = np.setdiff1d(present, layout.numbers)
    if missing.size:
        raise InputError(f"observed.positions: {path} has no antenna {missing[0]}, which is in the data")
    enu = telescope.get_enu_antpos()
    places = {int(number): row for row, number in enumerate(layout.numbers)}
    moved = [row for row, number in enumerate(telescope.antenna_numbers.tolist()) if number in places]
    before = enu[moved].copy()
    for row in moved:
        enu[row] = layout.enu[places[int(telescope.antenna_numbers[row])]]
    centre = np.array([axis.to_value(units.m) for axis in telescope.location.geocentric])
    telescope.antenna_positions = utils.ECEF_from_ENU(enu, center_loc=telescope.location) - centre
    data.set_uvws_from_antenna_positions(update_vis=False)
    distances = [np.linalg.norm(positions[:, None] - positions, axis=-1) for positions in (before, enu[moved])]
    return (
        f"Antenna positions are those of {path.name}; distances between antennas change by up to "
        f"{np.abs(distances[1] - distances[0]).max():.3g} m."
    )
