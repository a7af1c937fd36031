"""What a task will take: seconds of one core, bytes of memory, bytes of disk.

The constants were measured on one core of a 2020s server; they serve to plan and to forecast, within a factor of about
two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calstudy.graph.tasks import Task

LIBRARIES_MEMORY = 0.8e9
COMPLEX128, COMPLEX64 = 16, 8
SOURCES = 546_000
TIME_NODES, FREQUENCY_NODES = 16, 96
PAPER_SAMPLES = 630 * 384
ADAMAX_STEP = 3e-3


@dataclass(frozen=True)
class Cost:
    """Seconds on one core, bytes of memory and bytes of disk."""

    seconds: float
    memory: float = LIBRARIES_MEMORY
    disk: float = 0.0


@dataclass(frozen=True)
class Size:
    """The dimensions of a data set."""

    antennas: int
    times: int
    channels: int
    polarizations: int

    @property
    def baselines(self) -> int:
        """Number of baselines without autocorrelations."""
        return self.antennas * (self.antennas - 1) // 2

    @property
    def samples(self) -> int:
        """Number of visibilities."""
        return self.baselines * self.times * self.channels * self.polarizations


def antenna_count(layout: Mapping[str, Any]) -> int:
    """Return how many antennas a layout's settings will give, without making it where that is possible."""
    kind = layout["kind"]
    if kind == "hex":
        return 3 * layout["side"] * (layout["side"] - 1) + 1
    if kind == "csv":
        lines = Path(layout["path"]).read_text(encoding="utf-8", errors="replace").splitlines()
        return max(sum(1 for line in lines if line.strip() and not line.startswith("#")) - 1, 2)
    whole = 128 if kind == "mwa-compact" else 36
    return layout.get("count") or whole


def _size(instrument: Mapping[str, Any]) -> Size:
    return Size(
        antennas=antenna_count(instrument["layout"]),
        times=instrument["times"]["count"],
        channels=instrument["channels"]["count"],
        polarizations=len(instrument["polarizations"]),
    )


def _instrument(task: Task) -> Mapping[str, Any]:
    """Return the instrument's settings of a task, or of the nearest task that it is made from."""
    if "instrument" in task.settings:
        return task.settings["instrument"]
    return next(found for found in map(_instrument, task.inputs.values()) if found)


def _engine_seconds(engine: str, sources: float, slots: float, antennas: int) -> float:
    """Return the seconds an engine takes for all-sky `sources` at `slots` combinations of time and frequency."""
    if engine == "pyuvsim":
        return 2.8e-8 * sources * slots * antennas**2 / 2
    if engine == "fftvis":
        return 1.8e-5 * sources * slots
    if engine == "matvis":
        return (3e-6 + 3.2e-9 * antennas**2) * sources * slots
    above_horizon = sources / 2
    return 1.1 * above_horizon * slots * (2e-8 + 0.9e-9 * antennas + 0.87e-10 * antennas**2) + 4.5e-6 * sources


def _simulate_chunk(task: Task) -> Cost:
    size, sky = _size(_instrument(task)), task.settings["sky"]
    simulation = task.settings["simulation"]
    nodes = simulation["nodes"]["enabled"]
    times, channels = (min(size.times, TIME_NODES) if nodes else size.times), size.channels
    if task.settings["component"] == "eor":
        sources, spectral = 12 * sky["nside"] ** 2, size.channels / simulation["chunks"]
    else:
        sources, spectral = min(sky.get("count") or SOURCES, SOURCES), 1
        channels = min(size.channels, FREQUENCY_NODES) if nodes else size.channels
    pieces = min(simulation["chunks"], size.channels)
    seconds = _engine_seconds(simulation["engine"], sources, times * channels / pieces, size.antennas)
    disk = size.samples / size.channels * channels / pieces * COMPLEX128
    memory = LIBRARIES_MEMORY + 300 * sources + 55 * sources * (spectral if spectral > 1 else 0) + 3 * disk
    return Cost(6 + seconds, memory, disk)


def _simulate(task: Task) -> Cost:
    disk = _size(_instrument(task)).samples * COMPLEX128
    return Cost(2 + disk * 2e-9, LIBRARIES_MEMORY + 4 * disk, disk)


def _corrupt(task: Task) -> Cost:
    samples = _size(_instrument(task)).samples
    return Cost(1 + samples * 1e-7, LIBRARIES_MEMORY + 5 * samples * COMPLEX128, samples * COMPLEX64)


def _calibrate_chunk(task: Task) -> Cost:
    size = _size(_instrument(task))
    solver = task.settings["calibration"]["solver"]
    pieces = task.settings["count"]
    solves = size.times * size.polarizations / pieces
    if solver["name"] == "gauss-newton":
        # Cost of the normal matrices, baselines x channels x vectors^2, dominates.
        seconds = 6 + (1.5 + 0.3 * solves) * (size.baselines * size.channels / PAPER_SAMPLES)
    else:
        steps = min(solver["max_steps"], 10_000)
        seconds = 6 + solves * steps * ADAMAX_STEP * size.baselines * size.channels / PAPER_SAMPLES
    memory = LIBRARIES_MEMORY + 1.5e9 * (size.antennas / 36) ** 2 * (size.channels / 384)
    return Cost(seconds, memory, 2 * size.samples * COMPLEX64 / pieces)


def _calibrate(task: Task) -> Cost:
    disk = 2 * _size(_instrument(task)).samples * COMPLEX64
    return Cost(2 + disk * 2e-9, LIBRARIES_MEMORY + 3 * disk, disk)


def _average(task: Task) -> Cost:
    size = _size(_instrument(task))
    disk = size.samples / size.times * COMPLEX128
    return Cost(1 + size.samples * 5e-8, LIBRARIES_MEMORY + 6 * size.samples * COMPLEX128, disk)


def _power(task: Task) -> Cost:
    size = _size(_instrument(task))
    return Cost(6, 1.6e9, 2 * size.baselines * size.channels * COMPLEX128)


def _agreement(task: Task) -> Cost:
    samples = _size(_instrument(task)).samples
    return Cost(2 + samples * 1e-6, LIBRARIES_MEMORY + 10 * samples * COMPLEX128, 1e4)


ESTIMATES: Mapping[str, Callable[[Task], Cost]] = {
    "simulate-chunk": _simulate_chunk,
    "simulate": _simulate,
    "gains": lambda task: Cost(1, disk=1e6),
    "levels": lambda task: Cost(2, LIBRARIES_MEMORY + 3 * _size(_instrument(task)).samples * COMPLEX128, 1e3),
    "corrupt": _corrupt,
    "calibrate-chunk": _calibrate_chunk,
    "calibrate": _calibrate,
    "average": _average,
    "power": _power,
    "spectra": lambda task: Cost(10, disk=5e6),
    "difference": lambda task: Cost(1, disk=_size(_instrument(task)).baselines * 1e4),
    "transfer": lambda task: Cost(4, disk=1e6),
    "transfer-figure": lambda task: Cost(3, disk=1e6),
    "sweep": lambda task: Cost(3, disk=1e6),
    "agreement": _agreement,
    "claims": lambda task: Cost(1, disk=1e5),
    "combined-claims": lambda task: Cost(1, disk=1e5),
    "figure": lambda task: Cost(3, disk=1e6),
    "combined-figure": lambda task: Cost(3, disk=1e6),
}


def estimate(task: Task) -> Cost:
    """Return the estimated cost of one task."""
    return ESTIMATES[task.stage](task)
