"""Every engine on the same work in the same run: processor time, memory, and agreement with pyuvsim."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calstudy.bench.apart import ask
from calstudy.errors import InputError

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


def compare_engines(work: Work, engines: list[str], tell: Callable[[str], None] = lambda text: None) -> list[Timing]:
    """Run engines one after the other, each in a process of its own on one core.

    Parameters
    ----------
    work
        What they simulate.
    engines
        Names; each is run in its precisions of `CANDIDATES`.
    tell
        Called with the name of each before it starts.

    Returns
    -------
    list of Timing
        Fastest first.

    Raises
    ------
    InputError
        If a name is not an engine's, or an engine fails.
    """
    known = list(dict.fromkeys(name for name, _ in CANDIDATES))
    unknown = [name for name in engines if name not in known]
    if unknown:
        raise InputError(f"--engines {unknown[0]}: not an engine that is compared (allowed: {', '.join(known)})")
    chosen = [(name, precision) for name, precision in CANDIDATES if name in engines]
    with tempfile.TemporaryDirectory() as folder:
        found = {}
        for name, precision in chosen:
            tell(f"{name} ({precision})")
            found[name, precision] = _run(work, name, precision, Path(folder))
        reference, cube = found.get((REFERENCE, "double"), (None, None))
        rms = None if cube is None else float(np.sqrt(np.mean(np.abs(cube) ** 2)))
        timings = [
            Timing(
                engine=name,
                precision=precision,
                seconds=usage["cpu_seconds"] / work.slots,
                ratio=reference["cpu_seconds"] / usage["cpu_seconds"] if reference else float("nan"),
                error=float(np.abs(result - cube).max()) / rms if rms else float("nan"),
                memory=usage["peak_memory"],
            )
            for (name, precision), (usage, result) in found.items()
        ]
    return sorted(timings, key=lambda timing: timing.seconds)


def _run(work: Work, engine: str, precision: str, folder: Path) -> tuple[dict[str, float], np.ndarray]:
    path = folder / f"{engine}-{precision}.npy"
    request = {"work": asdict(work), "engine": engine, "precision": precision, "path": str(path)}
    usage = ask("calstudy.bench.engine_process", request)
    return usage, np.load(path, allow_pickle=False)
