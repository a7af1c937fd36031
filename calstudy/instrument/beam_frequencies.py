"""Selection of the tabulated frequencies from which a beam is interpolated, without reading the beam."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.files import kept_while_unchanged
from calstudy.base.foreign_files import require_self_contained

# The tabulated MWA beam scatters from frequency to frequency by 2.4e-5 rms of the zenith value. A polynomial of order 8
# over 36 MHz is the lowest that leaves no more than that; a higher one would follow the scatter. Narrower observations
# keep the 36 MHz, so that the beam is as well determined and does not depend on how many channels are simulated.
FIT_BAND = 36e6
FIT_MARGIN = 2.56e6
POINTS_NEEDED = {"chebyshev": 1, "cubic": 4, "linear": 2, "nearest": 1}
MWA_GROUP = re.compile(r"[XY]\d+_(\d+)")
"""Names of the groups of an MWA beam file: dipole and frequency in Hz."""


def fit_range(band: tuple[float, float]) -> tuple[float, float]:
    """Return the lowest and highest frequency (Hz) from which a beam is interpolated in a band."""
    low, high = band[0] - FIT_MARGIN, band[1] + FIT_MARGIN
    missing = max(0.0, FIT_BAND - (high - low))
    return low - missing / 2, high + missing / 2


def choose_frequencies(available: np.ndarray, band: tuple[float, float], interpolation: str) -> slice:
    """Select the tabulated frequencies, (Ntab,), Hz, ascending, from which a beam is interpolated in a band (Hz).

    Raises InputError if they do not enclose the band, or are fewer than `POINTS_NEEDED`.
    """
    low, high = fit_range(band)
    # A coarse table may have its next frequency beyond the range.
    start = min(np.searchsorted(available, low), np.searchsorted(available, band[0], side="right") - 1)
    stop = max(np.searchsorted(available, high, side="right"), np.searchsorted(available, band[1]) + 1)
    if start < 0 or stop > len(available):
        raise InputError(
            f"instrument.channels: {megahertz(*band)} is not within the beam file's "
            f"{megahertz(available[0], available[-1])}"
        )
    chosen = slice(start, min(stop, len(available)))
    count = len(available[chosen])
    if count < POINTS_NEEDED[interpolation]:
        raise InputError(
            f"instrument.beam.interpolation: {interpolation} needs {POINTS_NEEDED[interpolation]} tabulated "
            f"frequencies near the channels, the beam file has {count}"
        )
    return chosen


def mwa_frequencies(path: Path) -> np.ndarray:
    """Return the frequencies (Hz, ascending) of an MWA beam file; raises InputError if it is missing, or has none."""
    if not path.is_file():
        raise InputError(f"instrument.beam.path: there is no file {path}")
    return _mwa_frequencies(path)


@kept_while_unchanged(4)
def _mwa_frequencies(path: Path) -> np.ndarray:
    require_self_contained(path)
    try:
        with h5py.File(path) as file:
            matches = [MWA_GROUP.fullmatch(name) for name in file]
    except OSError as error:
        raise InputError(f"instrument.beam.path: {path} cannot be read as an MWA beam file ({error})") from error
    found = sorted({float(match[1]) for match in matches if match})
    if not found:
        raise InputError(f"instrument.beam.path: {path} cannot be read as an MWA beam file (it names no frequencies)")
    return np.array(found)


def megahertz(low: float, high: float) -> str:
    """Format a range of frequencies, given in Hz."""
    return f"{low / 1e6:g} to {high / 1e6:g} MHz"
