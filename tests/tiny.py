"""The chain at the smallest size that has a window outside the wedge."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

from calstudy.experiment.files import StudyFile
from calstudy.experiment.model import Experiment

TINY: dict[str, Any] = {
    "name": "tiny",
    "instrument": {
        "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
        "beam": "gaussian",
        "channels": {"first": "170 MHz", "width": "400 kHz", "count": 32},
        "times": {"integration": "10 s", "count": 2},
    },
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 100}, "eor": {"nside": 16}},
    "corruption": {"noise": {"factor": 2}},
    "simulation": {"chunks": 2},
    # Weights from the fit's own gains take several solves in place of one; tests of these ask for them.
    "calibration": {"chunks": 2, "weights": "flags"},
    "power": {"pairs": "same-baseline", "bins": {"width": "0.1 h/Mpc", "max": "0.8 h/Mpc"}},
}


def tiny(folder: Path) -> dict[str, Any]:
    """Return the tiny experiment with its store and runs in `folder`; changes of it change no other."""
    return {**deepcopy(TINY), "outputs": {"store": str(folder / "store"), "runs": str(folder / "runs")}}


def of_the_paper(folder: Path) -> dict[str, Any]:
    """Return the tiny experiment with the weights of Ewall-Wice et al. (2022), compared with what they say."""
    return {**tiny(folder), "papers": ["calamity2022"]}


def load(path: Path, scale: str | None = None, overrides: tuple[str, ...] = ()) -> Experiment:
    """Read and validate an experiment file."""
    return StudyFile.open(path, scale, overrides).experiment()
