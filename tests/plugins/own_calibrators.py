"""A calibrator as a user would write it, in a file or in an installed package."""

from __future__ import annotations

import shutil
from pathlib import Path

KNOWN_GAINS = '''"""Gains that are known beforehand."""

import numpy as np
from pydantic import Field

from calstudy.base.resources import Cost
from calstudy.base.units import Length
from calstudy.calibrate.interface import Calibration, Calibrator, Solve


class KnownGains(Calibrator):
    """Gains of channel n are n times a factor."""

    factor: float = Field(1.0, description="What the gains are multiplied by.")
    max_length: Length = Field(1e6, gt=0, description="Longer baselines are refused.")
    status: str = "converged"
    fault: str = ""

    def refusal(self, frame, has_sky_model):
        if self.fault == "refusal":
            return False
        if frame.lengths.max() > self.max_length:
            return f"max_length: is exceeded by a baseline of {frame.lengths.max():.0f} m"
        return None if has_sky_model else "needs a sky model"

    def cost(self, size):
        return Cost(seconds=1234.0, memory=1e9 + size.samples)

    def calibrate(self, observation, assumed, progress=None):
        shape = (observation.n_antennas, observation.n_channels, observation.n_times, observation.n_polarizations)
        channel = np.arange(1, observation.n_channels + 1)[:, None, None]
        gains = np.broadcast_to(self.factor * channel + 0j, shape).copy()
        outcome = Solve(status=self.status, message="these are the gains that are known")
        if self.fault:
            return spoiled(self.fault, observation, assumed, gains, outcome)
        return Calibration(gains=gains, outcomes=outcome)


def spoiled(fault, observation, assumed, gains, outcome):
    """Return or do something that does not fit."""
    import sys

    if fault == "exit":
        sys.exit(5)
    if fault == "value":
        raise ValueError("no such thing")
    if fault == "type":
        return len(observation.n_times)
    if fault == "write":
        observation.visibilities[:] = 0
    if fault == "pair":
        return gains, None
    if fault == "shape":
        return Calibration(gains=gains[:, :-1], outcomes=outcome)
    if fault == "zero":
        return Calibration(gains=0 * gains, outcomes=outcome)
    if fault == "model":
        return Calibration(gains=gains, outcomes=outcome, model=assumed.sky_model.visibilities[..., :-1, :])
    if fault == "status":
        return Calibration(gains=gains, outcomes=Solve(status="fine", message="all is well"))
    if fault == "outcomes":
        return Calibration(gains=gains, outcomes=[outcome] * 3)
    if fault == "flagged":
        flags = np.zeros(gains.shape, bool)
        flags[0, 3] = True
        return Calibration(gains=np.where(flags, 0, gains), gain_flags=flags, outcomes=outcome)
    if fault == "one for all":
        return Calibration(gains=gains[:, :, :1], outcomes=outcome)
    if fault == "multiply":
        from calstudy.base.gains import make_uvcal

        cal = make_uvcal(observation.uvd, gains)
        cal.gain_convention = "multiply"
        return Calibration(gains=cal, outcomes=outcome)
    if fault == "interrupt":
        raise KeyboardInterrupt
    raise LookupError(fault)
'''


def write_calibrator(folder: Path) -> Path:
    """Write the calibrator to known_gains.py in a folder, and return the path."""
    path = folder / "known_gains.py"
    path.write_text(KNOWN_GAINS)
    return path


def install(folder: Path, version: str = "1.0") -> None:
    """Install the calibrator as a package `known` would be, in a folder that is or will be on the path of modules."""
    folder.mkdir(exist_ok=True)
    write_calibrator(folder)
    for old in folder.glob("known-*.dist-info"):
        shutil.rmtree(old)
    info = folder / f"known-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: known\nVersion: {version}\n")
    (info / "entry_points.txt").write_text("[calstudy.calibrators]\nknown-gains = known_gains:KnownGains\n")
