"""Size of the data of an instrument, from its settings alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.observation import Frame
from calstudy.base.plugins import Plugin
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Channels, InstrumentSettings


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
        extent = _extent(instrument.layout)
        return cls(
            antennas=extent.antennas,
            times=instrument.times.count,
            channels=instrument.channels,
            polarizations=len(instrument.polarizations),
            longest=extent.longest,
            mean=extent.mean,
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


@dataclass(frozen=True)
class _Extent:
    """Number of antennas, longest and mean baseline (m)."""

    antennas: int
    longest: float
    mean: float


def _extent(layout: Plugin) -> _Extent:
    return _extent_of(layout, digest_json(identity(layout)))


@lru_cache(maxsize=256)
def _extent_of(layout: Plugin, content: str) -> _Extent:
    """Return the extent of a layout; `content` is a digest that changes with its files."""
    del content
    enu = make_layout(layout).enu
    first, second = np.triu_indices(len(enu), 1)
    lengths = np.linalg.norm(enu[first] - enu[second], axis=1)
    return _Extent(len(enu), float(lengths.max()), float(lengths.mean()))


def antenna_count(layout: Plugin) -> int:
    """Return the number of antennas of a layout. Raises InputError as `make_layout`."""
    return _extent(layout).antennas
