"""Read the part of a product that concerns single antennas, baselines and integrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.errors import InputError
from calstudy.visibilities import antenna_pairs, from_cube, to_cube

TRUE_GAINS = FITTED_GAINS = "gains.calh5"


def read_baselines(path: Path, pairs: list[tuple[int, int]]) -> UVData:
    """Read single baselines of a UVH5 product.

    Parameters
    ----------
    path
        The file.
    pairs
        Antenna numbers (a, b) with a before b in the product.

    Returns
    -------
    UVData of these baselines, in the order of `pairs`, at all integrations.
    """
    uvd = UVData.from_file(path, file_type="uvh5", bls=pairs, run_check=False)
    found = [tuple(pair) for pair in antenna_pairs(uvd).tolist()]
    order = [found.index(pair) for pair in pairs]
    if order == list(range(len(order))):
        return uvd
    rows = (np.arange(uvd.Ntimes)[:, None] * uvd.Nbls + np.array(order)).ravel()
    cube = to_cube(uvd)[:, order]
    template = uvd.select(blt_inds=rows, inplace=False, run_check=False)
    template.reorder_blts(order=np.argsort(np.argsort(rows)))
    return from_cube(template, cube)
