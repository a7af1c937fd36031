"""The chain with few antennas that are not redundant, as signal loss needs it."""

from __future__ import annotations

from tiny import tiny

from calstudy.experiment.files import override

ANTENNAS = 7
VARIANTS = {
    "residual": {"components": ["foregrounds", "eor", "noise"], "effects": True, "calibrate": True},
    "residual_without_eor": {"components": ["foregrounds", "noise"], "effects": True, "calibrate": True},
    "eor": {"components": ["eor"]},
}


def small(folder, **fields) -> dict:
    """The tiny chain with an array of few redundant baselines, and only what the signal loss needs."""
    data = {**tiny(folder), "variants": VARIANTS}
    data = override(data, "instrument.layout", {"kind": "mwa-compact-minredundant", "count": ANTENNAS})
    # So few antennas stall in single precision: the second integration would be solved twice, from the first and anew.
    # What further steps change of T outside the wedge is less than its errors.
    solver = {"warm_start": False, "max_steps": 20}
    cheap = {"simulation.chunks": 1, "calibration.chunks": 1, "calibration.solver": solver}
    for path, value in {"outputs.figures": ["signal-loss"], **cheap}.items():
        data = override(data, path, value)
    for path, value in fields.items():
        data = override(data, path.replace("__", "."), value)
    return data
