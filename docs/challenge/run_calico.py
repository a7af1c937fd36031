"""Gains by CaliCo's sky-based calibration, for every channel and integration by itself, with its default settings.

python run_calico.py data/world-1 gains/world-1
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
from calico.calibration_wrappers import sky_based_calibration_wrapper
from pyuvdata import UVData

folder, target = (Path(name) for name in sys.argv[1:])
target.mkdir(parents=True, exist_ok=True)
shutil.copyfile(folder / "manifest.json", target / "manifest.json")
manifest = json.loads((folder / "manifest.json").read_text())
sky = UVData.from_file(folder / manifest["sky_model"])
for item in manifest["data"]:
    data = UVData.from_file(folder / item["file"])
    found = []
    for time in np.unique(data.time_array):  # CaliCo finds one gain for all times that it is given.
        pair = (uvd.select(times=time, inplace=False) for uvd in (data, sky))
        found.append(sky_based_calibration_wrapper(*pair, parallel=False))
    cal = found[0]
    cal.fast_concat(found[1:], axis="time", inplace=True)
    cal.write_calh5(target / f"{item['name']}.calh5", clobber=True)
