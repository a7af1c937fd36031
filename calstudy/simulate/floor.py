"""The delay floor: the power of simulated foregrounds at delays beyond the horizon, where real foregrounds have none.

It is caused by the simulation (a beam that is not smooth in frequency, rounding, interpolation) and by the sidelobes of
the taper. Levels are amplitude decibels, 10 log10 of a brightness ratio, as in the paper (beam interpolation artefacts
at -45 dB, 21 cm signal at -40 dB).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from calstudy.base.visibilities import baseline_vectors, to_cube
from calstudy.power.delay import horizon_delay

if TYPE_CHECKING:
    from pyuvdata import UVData

Taper = Literal["blackman-harris", "dolph-chebyshev"]
MAIN_LOBES: dict[Taper, int] = {"blackman-harris": 4, "dolph-chebyshev": 8}
"""Half width of the main lobe of each taper, in units of 1 / bandwidth; the floor is measured beyond it."""
WINDOWS = {"blackman-harris": "blackmanharris", "dolph-chebyshev": ("chebwin", 200)}
"""Tapers of scipy; the attenuation of the sidelobes of the second is in dB of power."""


@dataclass(frozen=True)
class DelayFloor:
    """Power beyond the horizon plus a buffer (s) relative to the peak, in bins of baseline length with edges in m.

    `rms_db` and `max_db`, (Nbins,), are the rms beyond horizon + buffer, and that of the delay where it is largest
    there, over the largest rms at any delay, in amplitude dB; NaN for an empty bin.
    """

    edges: np.ndarray
    rms_db: np.ndarray
    max_db: np.ndarray
    buffer: float
    taper: str

    @property
    def worst_db(self) -> float:
        """The highest of `max_db`, amplitude dB."""
        return float(np.nanmax(self.max_db))


def delay_profile(foregrounds: UVData, taper: Taper) -> tuple[np.ndarray, np.ndarray]:
    """Return delays in the order of `numpy.fft`, (Nfreqs,), s, and the mean |V~|^2 of each baseline, (Nbls, Nfreqs).

    The mean is over integrations and polarizations; the transform is a plain sum over equally spaced channels, Jy.
    """
    cube = to_cube(foregrounds)
    width = float(np.diff(foregrounds.freq_array).mean())
    from scipy.signal import get_window

    window = get_window(WINDOWS[taper], cube.shape[2], fftbins=False)
    spectrum = np.fft.fft(cube * window[:, None], axis=2)
    return np.fft.fftfreq(cube.shape[2], width), np.mean(np.abs(spectrum) ** 2, axis=(0, 3))


def folded_spectrum(delays: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return delays >= 0, (N // 2,), and the mean power of both signs of each, from the order of `numpy.fft`."""
    half = delays.size // 2
    return delays[:half], np.concatenate([power[:1], (power[1:half] + power[:-half:-1]) / 2])


def floor_buffers(foregrounds: UVData) -> dict[Taper, float]:
    """Return the delay beyond the horizon at which the main lobe of each taper ends, at least 100 ns, in s.

    Tapers for which the band leaves no delay beyond that of the longest baseline are left out.
    """
    width = float(np.diff(foregrounds.freq_array).mean())
    resolution = 1 / (width * foregrounds.Nfreqs)
    horizon = horizon_delay(float(np.linalg.norm(baseline_vectors(foregrounds), axis=1).max()))
    found = {taper: max(100e-9, lobe * resolution) for taper, lobe in MAIN_LOBES.items()}
    return {taper: buffer for taper, buffer in found.items() if horizon + buffer + resolution < 0.5 / width}


def length_bins(lengths: np.ndarray, n_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return edges (n_bins + 1,) of equal bins from 0 to the longest baseline, and the bin of each baseline (Nbls,)."""
    edges = np.linspace(0, lengths.max() * (1 + 1e-9), n_bins + 1)
    return edges, np.digitize(lengths, edges) - 1


def delay_floor(
    foregrounds: UVData,
    buffer: float = 100e-9,
    taper: Taper = "blackman-harris",
    n_bins: int = 6,
    peaks: UVData | None = None,
) -> DelayFloor:
    """Measure the delay floor of foregrounds alone, with equally spaced channels, beyond horizon + buffer (s).

    Blackman-Harris has sidelobes of -46 dB here and gives the floor of a power spectrum; Dolph-Chebyshev (-100 dB)
    gives the floor of the simulation below these sidelobes. `peaks` are the visibilities that define the peaks, of the
    same shape; by default `foregrounds`. Raises ValueError if no delay is beyond that for the longest baseline.
    """
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    delays, power = delay_profile(foregrounds, taper)
    peak_power = power if peaks is None else delay_profile(peaks, taper)[1]
    beyond = np.abs(delays) > (horizon_delay(lengths) + buffer)[:, None]
    if not beyond.any(axis=1).all():
        raise ValueError(f"no delay is beyond the horizon plus {buffer} s: the channels are too wide")
    edges, bins = length_bins(lengths, n_bins)
    levels = np.full((2, n_bins), np.nan)
    for index in np.unique(bins):
        members = bins == index
        mean = power[members].mean(axis=0)
        outside = beyond[members].all(axis=0)
        ratios = np.array([mean[outside].mean(), mean[outside].max()]) / peak_power[members].mean(axis=0).max()
        levels[:, index] = 5 * np.log10(np.maximum(ratios, np.finfo(float).tiny))
    return DelayFloor(edges, levels[0], levels[1], buffer, taper)
