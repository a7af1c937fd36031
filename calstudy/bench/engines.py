"""Every engine on the same work in the same run: processor time, memory, and agreement with pyuvsim.

Each runs in a process of its own, ``python -m calstudy.bench.engines REQUEST``.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import Usage
from calstudy.bench.process import run_module
from calstudy.corrupt.levels import rms
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import InstrumentSettings, MwaLayout
from calstudy.instrument.telescope import make_template, subset_template
from calstudy.simulate.arguments import missing_package
from calstudy.simulate.interface import Engine
from calstudy.simulate.nodes import integration_times
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources

REFERENCE = "pyuvsim"
CANDIDATES = (
    ("dense", "double"),
    ("dense", "single"),
    ("matvis", "double"),
    ("fftvis", "single"),
    ("fftvis", "double"),
    ("pyuvsim", "double"),
)
"""Engines and precisions that are compared. matvis in single precision rounds its phases to 1e-4 and is left out."""
FEW = 200
"""Sources of the first, uncounted simulation, in which code is compiled and imported."""


@dataclass(frozen=True)
class Work:
    """What every engine simulates: the default sky and the MWA embedded-element beam, over the paper's band and time.

    Attributes
    ----------
    sources
        Brightest sources of the whole sky, about half of which are up.
    antennas
        First tiles of the minimally redundant array, at their real heights.
    channels, times
        Spread over the paper's band and time.
    """

    sources: int = 283_000
    antennas: int = 36
    channels: int = 2
    times: int = 1

    @property
    def slots(self) -> int:
        """Combinations of time and channel."""
        return self.channels * self.times


@dataclass(frozen=True)
class Timing:
    """What one engine took.

    Attributes
    ----------
    engine, precision
        Which.
    seconds
        Processor seconds per combination of time and channel, on one core.
    ratio
        Time of pyuvsim over this engine's, nan if pyuvsim was not run.
    error
        Largest difference from pyuvsim over the rms of the visibilities, nan if pyuvsim was not run.
    memory
        Peak memory of its process, libraries included, bytes.
    """

    engine: str
    precision: str
    seconds: float
    ratio: float
    error: float
    memory: int


def time_engines(work: Work, engines: list[str], announce: Callable[[str], None] = lambda text: None) -> list[Timing]:
    """Run engines one after the other, each in a process of its own on one core.

    Parameters
    ----------
    work
        What they simulate.
    engines
        Names; each is run in its precisions of `CANDIDATES`.
    announce
        Called with the name of each before it starts.

    Returns
    -------
    list of Timing
        Fastest first.

    Raises
    ------
    InputError
        If a name is not an engine's, its package is not installed, or an engine fails.
    """
    known = list(dict.fromkeys(name for name, _ in CANDIDATES))
    unknown = [name for name in engines if name not in known]
    if unknown:
        raise InputError(f"--engines {unknown[0]}: not an engine that is compared (allowed: {', '.join(known)})")
    for name in engines:
        if (reason := missing_package(name)) is not None:
            raise InputError(f"engine {name!r}: {reason}")
    chosen = [(name, precision) for name, precision in CANDIDATES if name in engines]
    with tempfile.TemporaryDirectory() as folder:
        found = {}
        for name, precision in chosen:
            announce(f"{name} ({precision})")
            found[name, precision] = _run(work, name, precision, Path(folder))
        reference, cube = found.get((REFERENCE, "double"), (None, None))
        level = None if cube is None else rms(cube)
        timings = [
            Timing(
                engine=name,
                precision=precision,
                seconds=usage["cpu_seconds"] / work.slots,
                ratio=reference["cpu_seconds"] / usage["cpu_seconds"] if reference else float("nan"),
                error=float(np.abs(result - cube).max()) / level if level else float("nan"),
                memory=int(usage["peak_memory"]),
            )
            for (name, precision), (usage, result) in found.items()
        ]
    return sorted(timings, key=lambda timing: timing.seconds)


def _run(work: Work, engine: str, precision: str, folder: Path) -> tuple[dict[str, Any], np.ndarray]:
    path = folder / f"{engine}-{precision}.npy"
    request = {"work": asdict(work), "engine": engine, "precision": precision, "path": str(path)}
    usage = run_module("calstudy.bench.engines", request)
    return usage, np.load(path, allow_pickle=False)


def simulate(request: Mapping[str, Any]) -> Usage:
    """Simulate the work of a request, save the visibilities, and return what it took."""
    work = Work(**request["work"])
    instrument = InstrumentSettings(layout=MwaLayout(count=work.antennas))
    whole = make_template(instrument)
    times, channels = (_spread(axis, n) for axis, n in ((whole.Ntimes, work.times), (whole.Nfreqs, work.channels)))
    template = subset_template(whole, integration_times(whole)[times], whole.freq_array[channels])
    beam = make_beam(instrument.beam, instrument.channels)
    sky = make_foregrounds(SyntheticSources(count=work.sources), whole.freq_array).sky
    engine = Engine.registry.make({"kind": request["engine"], "precision": request["precision"]})
    engine.simulate(sky.select(component_inds=np.arange(FEW), inplace=False, run_check=False), beam, template)
    with Usage() as usage:
        cube = engine.simulate(sky, beam, template)
    np.save(request["path"], cube, allow_pickle=False)
    return usage


def _spread(length: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, length - 1, count + 2).round().astype(int)[1:-1])


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    taken = simulate(json.loads(sys.argv[1]))
    print(json.dumps({"cpu_seconds": taken.cpu_seconds, "peak_memory": taken.peak_memory}))
