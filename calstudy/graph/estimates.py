"""What a task will take: seconds of one core, bytes of memory, bytes of disk.

The constants were measured on one core of a 2020s server; they serve to plan and to forecast, within a factor of about
two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calstudy.calibrate.memory import Dimensions, solve_memory
from calstudy.calibrate.settings import BasisSettings, CalibrationSettings
from calstudy.graph.solve_estimates import FIRST_ORDER_STEP, PAPER_SAMPLES, basis_vectors, memory_of, seconds_of
from calstudy.graph.tasks import Task
from calstudy.instrument.settings import Channels

LIBRARIES_MEMORY = 0.8e9
COMPLEX128, COMPLEX64 = 16, 8
SOURCES = 546_000
TIME_NODES, FREQUENCY_NODES = 16, 96
ADAMAX_STEP = FIRST_ORDER_STEP
# The paper's padded step, per byte of its basis.
PADDED_SECONDS = 1e-9
PADDED_COPIES = 7


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
    if simulation["engine"] in ("auto", "dense"):
        seconds *= 1 + 1.5 * len(_instrument(task).get("antenna_beams", ()))
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
    instrument = _instrument(task)
    size = _size(instrument)
    calibration, pieces = task.settings["calibration"], task.settings["count"]
    solves = size.times * size.polarizations / calibration.get("integrations_per_solve", 1) / pieces
    together = size.baselines * size.channels * calibration.get("integrations_per_solve", 1)
    seconds = seconds_of(calibration["solver"], solves, together)
    # Files are read whole, with flags and sample counts; results are made for the piece.
    files = (COMPLEX64 + COMPLEX128 + 10) * size.samples + 8 * COMPLEX128 * size.samples / pieces
    memory = memory_of(instrument, calibration, size.antennas) + files
    return Cost(seconds, memory, 2 * size.samples * COMPLEX64 / pieces)


def _expected_loss(task: Task) -> Cost:
    size = _size(_instrument(task))
    work = size.baselines * size.channels / PAPER_SAMPLES
    return Cost(6 + 0.8 * task.settings["probes"] * work, LIBRARIES_MEMORY + 1.5e9 * work, 1e6)


def _convergence(task: Task) -> Cost:
    size, solver = _size(_instrument(task)), task.settings["calibration"]["solver"]
    work = size.baselines * size.channels / PAPER_SAMPLES
    step = 0.3 if solver["name"] == "gauss-newton" else ADAMAX_STEP
    steps = min(solver["max_steps"], max(task.settings["steps"]) if step == ADAMAX_STEP else 10)
    data = 4 * size.samples * COMPLEX64
    return Cost(20 + 2 * steps * step * work, LIBRARIES_MEMORY + 1.5e9 * work + data, 1e6)


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


def _step_times(task: Task) -> Cost:
    array, samples = task.settings["array"], task.settings["samples"]
    channels = Channels.model_validate(array["channels"])
    basis = BasisSettings.model_validate(array["basis"])
    antennas = antenna_count(array["layout"])
    vectors = basis_vectors(task.settings["longest"], channels, basis)
    baselines = antennas * (antennas - 1) // 2
    padded = 4 * vectors * baselines * channels.count
    work = baselines * channels.count / PAPER_SAMPLES
    solves = samples["solves"] * (0.4 + 1.3 * work)
    steps = PADDED_SECONDS * padded * samples["steps"] + 50 * ADAMAX_STEP * work * samples["calls"]
    dimensions = Dimensions(antennas, baselines, baselines, channels.count, vectors, baselines * vectors)
    memory = solve_memory(dimensions, CalibrationSettings()) + PADDED_COPIES * padded
    return Cost(30 + steps + solves, memory, 1e5)


def _descent(task: Task) -> Cost:
    array = task.settings["array"]
    antennas = antenna_count(array["layout"])
    work = antennas * (antennas - 1) / 2 * array["channels"]["count"] / PAPER_SAMPLES
    instrument = {**array, "times": {"count": 1}}
    memory = memory_of(instrument, {"basis": array["basis"]}, antennas)
    return Cost(20 + ADAMAX_STEP * work * task.settings["max_steps"], memory, 1e6)


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
    "expected-loss": _expected_loss,
    "expected-loss-figure": lambda task: Cost(3, disk=1e6),
    "convergence": _convergence,
    "convergence-figure": lambda task: Cost(3, disk=1e6),
    "sweep": lambda task: Cost(3, disk=1e6),
    "agreement": _agreement,
    "claims": lambda task: Cost(1, disk=1e5),
    "combined-claims": lambda task: Cost(1, disk=1e5),
    "step-times": _step_times,
    "descent": _descent,
    "runtime": lambda task: Cost(1, disk=1e5),
    "runtime-figure": lambda task: Cost(2, disk=1e6),
    "runtime-claims": lambda task: Cost(1, disk=1e5),
    "figure": lambda task: Cost(3, disk=1e6),
    "combined-figure": lambda task: Cost(3, disk=1e6),
    "validate": lambda task: Cost(60, 3e9, 1e6),
}


def estimate(task: Task) -> Cost:
    """Return the estimated cost of one task."""
    return ESTIMATES[task.stage](task)
