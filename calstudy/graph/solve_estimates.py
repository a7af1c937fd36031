"""What solves will take, from the settings of an experiment alone: seconds of one core, bytes of memory."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from scipy.constants import speed_of_light

from calstudy.calibrate.memory import Dimensions, solve_memory
from calstudy.calibrate.settings import BasisSettings, CalibrationSettings
from calstudy.instrument.settings import (
    Channels,
    CsvLayout,
    GolombLayout,
    HexLayout,
    Layout,
    LinearLayout,
    RectangularLayout,
)

MWA_LENGTHS = {
    "mwa-compact-minredundant": (176.2, 54.1),
    "mwa-compact-hex-east": (84.1, 41.9),
    "mwa-compact-hex-south": (84.1, 41.9),
    "mwa-compact": (740.8, 154.9),
}
"""Longest and mean baseline, m."""
MEAN_OVER_LONGEST = 0.45
# Of an optimal ruler, over the square of its marks.
GOLOMB_LENGTH = 0.55
# Vectors of a basis beyond its time-bandwidth product, for the default eigenvalue cutoff.
EXTRA_VECTORS = 14
PAPER_SAMPLES = 630 * 384
# Seconds of one core for the paper's samples. Gauss-Newton: a first solve, and one from the solution before.
COLD_SECONDS, WARM_SECONDS = 1.5, 0.2
# A step, and how many it takes to the minimum.
LBFGS_STEP, LBFGS_STEPS = 0.06, 180
FIRST_ORDER_STEP = 2.2e-3


def baseline_lengths(layout: Mapping[str, Any]) -> tuple[float, float]:
    """Return the longest and the mean baseline, m, of a layout's settings, about, without making it."""
    found = TypeAdapter(Layout).validate_python(dict(layout))
    if isinstance(found, HexLayout):
        longest = 2 * (found.side - 1) * found.spacing
    elif isinstance(found, LinearLayout):
        longest = (found.count - 1) * found.spacing
    elif isinstance(found, RectangularLayout):
        longest = found.max_baseline
    elif isinstance(found, GolombLayout):
        longest = GOLOMB_LENGTH * found.count**2 * found.spacing
    elif isinstance(found, CsvLayout):
        longest = _extent(found.path)
    else:
        return MWA_LENGTHS[found.kind]
    return longest, MEAN_OVER_LONGEST * longest


def _extent(path: Path) -> float:
    """Return the diagonal of the box that holds the antennas of a layout file, m; zero if it is no layout.

    That it is one is checked when it is read in earnest.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as table:
            rows = list(csv.DictReader(table))
        axes = [[float(row[name]) for row in rows] for name in ("east_m", "north_m")]
        extent = float(sum((max(axis) - min(axis)) ** 2 for axis in axes) ** 0.5)
    except (csv.Error, KeyError, TypeError, ValueError, OverflowError):
        return 0.0
    return extent if math.isfinite(extent) else 0.0


def basis_vectors(length: float, channels: Channels, basis: BasisSettings) -> int:
    """Return how many foreground vectors a baseline of this length (m) has, about."""
    delay = max(basis.horizon * length / speed_of_light, basis.min_delay) + basis.buffer
    return int(min(2 * channels.count * channels.width * delay + EXTRA_VECTORS, channels.count))


def dimensions_of(instrument: Mapping[str, Any], calibration: CalibrationSettings, antennas: int) -> Dimensions:
    """Return what the memory of one solve depends on, as if no baselines shared a model."""
    channels = Channels.model_validate(instrument["channels"])
    longest, mean = baseline_lengths(instrument["layout"])
    together = min(calibration.integrations_per_solve, instrument["times"]["count"])
    baselines = together * antennas * (antennas - 1) // 2
    coefficients = baselines * basis_vectors(mean, channels, calibration.basis)
    widest = basis_vectors(longest, channels, calibration.basis)
    return Dimensions(antennas, baselines, baselines, channels.count, widest, coefficients)


def memory_of(instrument: Mapping[str, Any], calibration: Mapping[str, Any], antennas: int) -> float:
    """Return the bytes that one solve needs at its peak, libraries included."""
    settings = CalibrationSettings.model_validate(calibration)
    return solve_memory(dimensions_of(instrument, settings, antennas), settings)


def seconds_of(solver: Mapping[str, Any], solves: float, samples: int) -> float:
    """Return the seconds of consecutive solves of `samples` visibilities each, compilation included."""
    work = samples / PAPER_SAMPLES
    if solver["name"] == "gauss-newton":
        warm = solves - 1 if solver["warm_start"] else 0
        # Cost of the normal matrices, baselines x channels x vectors^2, dominates.
        return 6 + ((solves - warm) * COLD_SECONDS + warm * WARM_SECONDS) * work
    if solver["name"] == "lbfgs":
        return 6 + LBFGS_STEP * work * solves * min(LBFGS_STEPS, solver["max_steps"])
    return 6 + FIRST_ORDER_STEP * work * solves * solver["max_steps"]
