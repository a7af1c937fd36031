"""Gains by QuartiCal, for every channel and integration by itself, from a folder of ``export --format ms``.

python run_quartical.py data-ms/world-1 gains/world-1        # all visibilities weigh the same
python run_quartical.py data-ms/world-1 gains/world-1 5      # 5 passes, from the second on with 1/|g_a g_b|^2
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import xarray as xr
from casacore.tables import makecoldesc, table
from daskms.experimental.zarr import xds_from_zarr
from pyuvdata import UVCal, UVData

SETTINGS = {
    "input_ms.weight_column": "WEIGHT_SPECTRUM",
    "input_model.recipe": "MODEL_DATA",
    "output.overwrite": "true",
    "output.flags": "false",
    "solver.terms": "[G]",
    "solver.iter_recipe": "[500]",
    "solver.convergence_criteria": "1e-7",
    "solver.convergence_fraction": "1",
    "G.type": "complex",
    "G.time_interval": "1",
    "G.freq_interval": "1",
    "dask.threads": "1",
}


def solve(measured: Path, found: Path) -> xr.Dataset:
    """Run QuartiCal on the columns DATA, MODEL_DATA and WEIGHT_SPECTRUM of a measurement set."""
    places = {"input_ms.path": measured, "output.gain_directory": found, "output.log_directory": found / "logs"}
    subprocess.run(["goquartical", *(f"{key}={value}" for key, value in {**places, **SETTINGS}.items())], check=True)
    [gains] = xds_from_zarr(f"{found}::G")
    return gains.isel(direction=0).compute()


def set_weights(measured: Path, gains: xr.Dataset | None) -> None:
    """Write the weights 1/|g_a g_b|^2, for the noise is multiplied by the gains; without gains all are one."""
    with table(str(measured), readonly=False, ack=False) as rows:
        weights = np.ones_like(rows.getcol("WEIGHT_SPECTRUM"))
        if gains is not None:
            power = np.abs(gains.gains.transpose("gain_time", "antenna", "gain_freq", "correlation").values) ** 2
            time = np.unique(rows.getcol("TIME"), return_inverse=True)[1]
            product = power[time, rows.getcol("ANTENNA1")] * power[time, rows.getcol("ANTENNA2")]
            weights = np.where(product > 0, 1 / np.where(product > 0, product, 1), 0)
        rows.putcol("WEIGHT_SPECTRUM", weights)


def to_uvcal(gains: xr.Dataset, data: UVData) -> UVCal:
    """Put gains into the order of antennas and the convention of pyuvdata."""
    cal = UVCal.initialize_from_uvdata(data, gain_convention="divide", cal_style="redundant", data={})
    name = dict(zip(data.telescope.antenna_numbers, data.telescope.antenna_names, strict=True))
    ordered = gains.sel(antenna=[str(name[number]) for number in cal.ant_array])
    ordered = ordered.transpose("antenna", "gain_freq", "gain_time", "correlation", ...)
    # pyuvdata writes the complex conjugates of visibilities to measurement sets, so that gains there are conjugate too.
    cal.gain_array = ordered.gains.values.conj()
    cal.flag_array = np.broadcast_to(ordered.gain_flags.values[..., None] != 0, cal.gain_array.shape).copy()
    return cal


folder, target = (Path(name) for name in sys.argv[1:3])
passes = int(sys.argv[3]) if len(sys.argv) > 3 else 1
target.mkdir(parents=True, exist_ok=True)
shutil.copyfile(folder / "manifest.json", target / "manifest.json")
manifest = json.loads((folder / "manifest.json").read_text())
with table(str(folder / manifest["sky_model"]), ack=False) as rows:
    sky = rows.getcol("DATA")
for item in manifest["data"]:
    measured = folder / item["file"]
    with table(str(measured), readonly=False, ack=False) as rows:
        if "MODEL_DATA" not in rows.colnames():
            rows.addcols(makecoldesc("MODEL_DATA", rows.getcoldesc("DATA")))
        rows.putcol("MODEL_DATA", sky)
    gains = None
    for _ in range(passes):
        set_weights(measured, gains)
        gains = solve(measured, target / f"{item['name']}.qc")
    cal = to_uvcal(gains, UVData.from_file(str(measured)))
    cal.write_calh5(target / f"{item['name']}.calh5", clobber=True)
