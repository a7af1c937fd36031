"""Size of the data of an instrument, from its settings alone."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calstudy.base.observation import Frame
from calstudy.instrument.settings import (
    Channels,
    CsvLayout,
    GolombLayout,
    HexLayout,
    InstrumentSettings,
    Layout,
    LinearLayout,
    NamedLayout,
    RectangularLayout,
)

NAMED_LENGTHS = {
    "mwa-compact-minredundant": (176.2, 54.1),
    "mwa-compact-hex-east": (84.1, 41.9),
    "mwa-compact-hex-south": (84.1, 41.9),
    "mwa-compact": (740.8, 154.9),
    "mwa-extended": (5302.9, 1878.7),
    "mwa-phase1": (2873.6, 680.0),
    "hera-19": (58.4, 31.2),
    "hera-37": (87.6, 43.0),
    "hera-128": (263.4, 91.0),
    "hera-320": (292.2, 127.3),
    "hera-350": (876.1, 165.6),
}
"""Longest and mean baseline, m."""
MEAN_OVER_LONGEST = 0.45
# Length of an optimal ruler over the square of the number of its marks.
GOLOMB_LENGTH = 0.55


@dataclass(frozen=True)
class Size:
    """Dimensions of a data set and of its array; `longest` and `mean` are estimates of baseline lengths, m."""

    antennas: int
    times: int
    channels: Channels
    polarizations: int
    longest: float
    mean: float

    @classmethod
    def of(cls, instrument: InstrumentSettings) -> Size:
        """Return the size of an instrument's data."""
        longest, mean = baseline_lengths(instrument.layout)
        return cls(
            antennas=antenna_count(instrument.layout),
            times=instrument.times.count,
            channels=instrument.channels,
            polarizations=len(instrument.polarizations),
            longest=longest,
            mean=mean,
        )

    @classmethod
    def of_frame(cls, frame: Frame) -> Size:
        """Return the size of data with these antennas, baselines and channels."""
        spacings = np.abs(np.diff(frame.frequencies))
        channels = {"first": frame.frequencies.min(), "width": np.median(spacings) if spacings.size else 0.0}
        lengths = frame.lengths[~frame.autos]
        return cls(
            antennas=frame.n_antennas,
            times=frame.n_times,
            # Measured data may have fewer channels than a simulation may.
            channels=Channels.model_construct(**channels, count=frame.n_channels),
            polarizations=frame.n_polarizations,
            longest=float(lengths.max(initial=0.0)),
            mean=float(lengths.mean()) if lengths.size else 0.0,
        )

    @property
    def baselines(self) -> int:
        """Number of baselines without autocorrelations."""
        return self.antennas * (self.antennas - 1) // 2

    @property
    def samples(self) -> int:
        """Number of visibilities."""
        return self.baselines * self.times * self.channels.count * self.polarizations


def antenna_count(layout: Layout) -> int:
    """Return the number of antennas of a layout, without making it where that is possible."""
    if isinstance(layout, HexLayout):
        return 3 * layout.side * (layout.side - 1) + 1
    if isinstance(layout, CsvLayout):
        lines = layout.path.read_text(encoding="utf-8", errors="replace").splitlines()
        return max(sum(1 for line in lines if line.strip() and not line.startswith("#")) - 1, 2)
    return layout.antennas if isinstance(layout, NamedLayout) else layout.count


def baseline_lengths(layout: Layout) -> tuple[float, float]:
    """Estimate the longest and the mean baseline of a layout, m, without making it."""
    if isinstance(layout, HexLayout):
        longest = 2 * (layout.side - 1) * layout.spacing
    elif isinstance(layout, LinearLayout):
        longest = (layout.count - 1) * layout.spacing
    elif isinstance(layout, RectangularLayout):
        longest = layout.max_baseline
    elif isinstance(layout, GolombLayout):
        longest = GOLOMB_LENGTH * layout.count**2 * layout.spacing
    elif isinstance(layout, CsvLayout):
        longest = _extent(layout.path)
    else:
        return NAMED_LENGTHS[layout.kind]
    return longest, MEAN_OVER_LONGEST * longest


def _extent(path: Path) -> float:
    """Return the diagonal of the bounding box of the antennas of a layout file, m; zero if the file is invalid.

    The file is checked when the layout is made.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as table:
            rows = list(csv.DictReader(table))
        axes = [[float(row[name]) for row in rows] for name in ("east_m", "north_m")]
        extent = float(sum((max(axis) - min(axis)) ** 2 for axis in axes) ** 0.5)
    except (csv.Error, KeyError, TypeError, ValueError, OverflowError):
        return 0.0
    return extent if math.isfinite(extent) else 0.0
