"""Fit gains to the sky model by DP3's DDECal, for a single direction."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.gain_files import read_h5parm
from calstudy.base.observation import Frame
from calstudy.base.resources import COMPLEX64, LIBRARIES_MEMORY, Cost
from calstudy.base.units import Frequency
from calstudy.calibrate.calibrators.other_packages import Measured, OtherPackage, Solved
from calstudy.calibrate.interface import Solve
from calstudy.instrument.settings import Size

if TYPE_CHECKING:
    from pyuvdata import UVData

NEEDED = "needs {}, which is not installed: pip install 'calstudy[dp3]'"
COMMANDS = ("DP3", "DP3.py")
"""Names of the program; the second is that of the package on PyPI."""
TELESCOPE = "array"
INTERVAL = 2.0
"""Seconds between the integrations of the measurement set; DDECal does not use them."""
CORRELATIONS = 4


class Ddecal(OtherPackage):
    """DP3's DDECal with the sky model as its only direction, in a process of its own; the sky model is taken as true.

    Every polarization is solved by itself, from a temporary measurement set, which holds single precision.
    """

    # Passes that swing go half of the way since 2.
    version: ClassVar[int] = 2
    calibrator: str = "ddecal"
    smoothness: Frequency | None = Field(
        None,
        gt=0,
        description="Width of the Gaussian with which DDECal smooths gains in frequency (`smoothnessconstraint`); "
        "null: channels are solved by themselves.",
    )
    tolerance: float = Field(1e-7, gt=0, lt=1, description="Stop when gains change by less; in single precision.")
    max_steps: int = Field(300, ge=1)
    step_size: ClassVar[float] = 0.5
    """Part of each step of DDECal's alternating fit that is taken."""

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if DP3, python-casacore, a sky model, or data are missing."""
        if _program() is None:
            return NEEDED.format("the program DP3")
        if find_spec("casacore") is None:
            return NEEDED.format("python-casacore")
        return super().refusal(frame, has_sky_model)

    def cost(self, size: Size) -> Cost:
        """Return the cost of the solves; the measurement set has four correlations of data and model."""
        samples = size.samples / size.polarizations
        seconds = 5 + 8 * size.polarizations + 4e-5 * size.samples
        return Cost(seconds, LIBRARIES_MEMORY + 12 * CORRELATIONS * COMPLEX64 * samples)

    def solve(self, measured: Measured, groups: list[slice], before: Solved | None = None) -> Solved:
        """Solve every group of integrations."""
        if before is not None:
            measured = measured.weighted_by(before.gains, groups)
        with TemporaryDirectory(prefix="ddecal-") as name:
            folder = Path(name)
            _write_measurement_set(folder, measured, groups)
            _write_observatories(folder)
            ended = self._run(folder)
            shape = (measured.frame.n_antennas, measured.frame.n_channels, len(groups))
            if ended.returncode != 0:
                last = (ended.stdout.strip().splitlines() or ["it said nothing"])[-1]
                outcome = Solve(status="failed", message=f"DP3 ended with exit code {ended.returncode}: {last}")
                return Solved(np.full(shape, np.nan, complex), [outcome] * len(groups))
            table = read_h5parm(folder / "gains.h5")
        assert table.antennas is not None, "an H5Parm file has names"
        order = np.argsort([int(name) for name in table.antennas])
        gains = table.gains[order, :, : len(groups), 0]
        # A solution without data is one, NaN, or a copy of the previous solution.
        known = [measured.frame.antennas_of(measured.weights[times].max(axis=0) > 0) for times in groups]
        return Solved(np.where(np.stack(known, axis=2), gains, np.nan), self._outcomes(ended.stdout, len(groups)))

    def _run(self, folder: Path) -> subprocess.CompletedProcess[str]:
        """Run DDECal on the measurement set of a folder."""
        program = _program()
        assert program is not None, "refused before"
        settings = {
            "msin": folder / "data.ms",
            "msout": "",
            "steps": "[cal]",
            "numthreads": 1,
            "cal.type": "ddecal",
            "cal.mode": "scalar",
            "cal.h5parm": folder / "gains.h5",
            "cal.modeldatacolumns": "[MODEL_DATA]",
            "cal.solint": self.integrations_per_solve,
            "cal.nchan": 1,
            "cal.maxiter": self.max_steps,
            "cal.tolerance": self.tolerance,
            "cal.stepsize": self.step_size,
            "cal.detectstalling": "false",
            "cal.uvlambdamin": 0,
        }
        if self.smoothness is not None:
            settings["cal.smoothnessconstraint"] = self.smoothness
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.run(
            [program, *(f"{name}={value}" for name, value in settings.items())],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            env={**os.environ, **threads, "CASARCFILES": str(folder / "casarc")},
            cwd=folder,
        )

    def _outcomes(self, output: str, n_groups: int) -> list[Solve]:
        """Read from DP3's output how the solves ended."""
        found = re.search(r"Iterations taken: \[([\d,]+)\]", output)
        if found is None:
            raise RuntimeError(f"DP3 does not say how many iterations it took:\n{output}")
        return [
            Solve("converged", f"gains changed by less than {self.tolerance:g}", steps=steps)
            if steps <= self.max_steps
            else Solve("max-steps", f"not converged after {self.max_steps} steps", steps=self.max_steps)
            for steps in [int(text) for text in found[1].split(",")][:n_groups]
        ]


def _program() -> str | None:
    """Find DP3 on the path, or next to the running Python."""
    places = itertools.product(COMMANDS, (None, str(Path(sys.executable).parent)))
    return next(filter(None, (shutil.which(name, path=path) for name, path in places)), None)


def _write_measurement_set(folder: Path, measured: Measured, groups: list[slice]) -> None:
    """Write the data, the sky model as MODEL_DATA, and the weights of all groups in sequence.

    DDECal needs four correlations, of which it fits XX and YY; both are the polarization. It loses the solution that
    begins with the last integration, so that a flagged one is appended.
    """
    from casacore.tables import makecoldesc, maketabdesc, table

    times = np.concatenate([np.arange(len(measured.visibilities))[group] for group in groups])
    turned = (measured.frame.antennas[:, 0] > measured.frame.antennas[:, 1])[:, None]
    for name, cube in (("data", measured.visibilities), ("model", measured.sky)):
        uvd = _empty(measured.frame, len(times) + 1)
        weights = np.concatenate([measured.weights[times], np.zeros_like(measured.weights[:1])])
        rows = (uvd.Nblts, uvd.Nfreqs)
        values = np.where(turned, cube[times].conj(), cube[times]).reshape(-1, uvd.Nfreqs)
        uvd.data_array[: len(values), :, :2] = values[..., None]
        uvd.nsample_array[:] = (weights / weights.max()).reshape(rows)[..., None]
        uvd.flag_array[:] = (weights == 0).reshape(rows)[..., None]
        uvd.write_ms(str(folder / f"{name}.ms"))
    with table(str(folder / "data.ms"), readonly=False, ack=False) as data:
        data.addcols(maketabdesc(makecoldesc("MODEL_DATA", data.getcoldesc("DATA"))))
        with table(str(folder / "model.ms"), ack=False) as model:
            data.putcol("MODEL_DATA", model.getcol("DATA"))


def _empty(frame: Frame, n_times: int) -> UVData:
    """Return visibilities without values.

    The first antenna of each baseline has the lower number, as pyuvdata then writes it in the order of measurement
    sets. Site, times and phase centre are arbitrary: gains do not depend on them, for data and model have the same.
    """
    from astropy.coordinates import EarthLocation
    from pyuvdata import Telescope, UVData, utils

    site = EarthLocation.from_geodetic(0, 0, 0)
    origin = np.array([site.x.value, site.y.value, site.z.value])
    telescope = Telescope.new(
        name=TELESCOPE,
        location=site,
        instrument=TELESCOPE,
        antenna_numbers=frame.numbers,
        antenna_names=[str(number) for number in frame.numbers],
        antenna_positions=utils.ECEF_from_ENU(frame.positions, center_loc=site) - origin,
        feeds=["x", "y"],
        mount_type="fixed",
    )
    pairs = [(int(a), int(b)) for a, b in np.sort(frame.pairs, axis=1)]
    uvd = UVData.new(
        freq_array=frame.frequencies,
        channel_width=float(np.diff(frame.frequencies).mean()),
        polarization_array=np.array([-5, -6, -7, -8]),
        times=2459000.5 + np.arange(n_times) * INTERVAL / SECONDS_PER_DAY,
        antpairs=pairs,
        telescope=telescope,
        integration_time=INTERVAL,
        do_blt_outer=True,
        time_axis_faster_than_bls=False,
        empty=True,
    )
    uvd.phase(lon=0.0, lat=0.0, epoch="J2000", cat_name="zenith", phase_frame="icrs")
    return uvd


def _write_observatories(folder: Path) -> None:
    """Write the table of observatories that DP3 needs to start, and the file with its path."""
    from casacore.tables import makescacoldesc, maketabdesc, table

    columns = {"MJD": 0.0, "Name": "", "Type": "", "Long": 0.0, "Lat": 0.0, "Height": 0.0, "X": 0.0, "Y": 0.0, "Z": 0.0}
    columns |= {"Source": "", "Comment": ""}
    place = folder / "measures" / "geodetic"
    place.mkdir(parents=True)
    described = maketabdesc([makescacoldesc(name, value) for name, value in columns.items()])
    with table(str(place / "Observatories"), described, nrow=1, ack=False) as observatories:
        observatories.putcell("Name", 0, TELESCOPE)
        observatories.putcell("Type", 0, "WGS84")
        version = {"VS_VERSION": "0001.0000", "VS_CREATE": "2020/01/01/00:00", "VS_DATE": "2020/01/01/00:00"}
        observatories.putkeywords({**version, "VS_TYPE": "List of Observatories", "MJD0": 0.0, "dMJD": 0.0})
        observatories.putinfo({"type": "IERS", "subType": "", "readme": ""})
    (folder / "casarc").write_text(f"measures.directory: {folder / 'measures'}\n")
