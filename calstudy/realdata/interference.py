"""Flags of data of several baselines that stand out from their surroundings in time and frequency, by hera_qm."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.quiet import without_warnings
from calstudy.base.visibilities import antenna_pairs, flag_cube, to_cube
from calstudy.realdata.settings import Interference

if TYPE_CHECKING:
    from pyuvdata import UVData

CELL, CHANNEL, INTEGRATION = 0.2, 0.05, 0.5
"""Fractions of samples that stand out, from which on a channel of an integration, a channel, and an integration are
flagged: those of HERA's first season (`hera_qm.xrfi.xrfi_h1c_pipe`, with the rms of the fractions of baselines)."""
LEAST_INTEGRATIONS, LEAST_CHANNELS = 3, 17
"""Smallest numbers that have surroundings: hera_qm takes eight samples to each side."""
NAMED = 8
"""Largest number of ranges of channels named in a note."""


def has_surroundings(integrations: int, channels: int) -> bool:
    """Return whether so many unflagged integrations and channels have surroundings."""
    return integrations >= LEAST_INTEGRATIONS and channels >= LEAST_CHANNELS


def require_surroundings(integrations: int, channels: int) -> None:
    """Raise InputError unless so many unflagged integrations and channels have surroundings."""
    if not has_surroundings(integrations, channels):
        raise InputError(
            f"flag_interference: takes at least {LEAST_INTEGRATIONS} integrations and {LEAST_CHANNELS} channels that "
            f"are not flagged, and the data have {integrations} and {channels}"
        )


def flag_interference(data: UVData, settings: Interference) -> str:
    """Flag interference in all baselines and polarizations; return a sentence on the flagged samples.

    Of each cross-correlation |V| is compared with the median of its surroundings, and with their scatter
    (`hera_qm.xrfi.xrfi_waterfall`). A channel of an integration is flagged if it stands out in a fifth of the baselines
    that have it, in any polarization; a channel if a twentieth of all its samples stand out; an integration if half of
    all its samples do. Autocorrelations do not take part: their noise is so low that the bandpass stands out.

    The data must be rectangular and time-major, and are changed. Samples that are flagged or zero do not take part.
    Raise InputError if there are only autocorrelations, or too few integrations or channels that are not flagged.
    """
    pairs = antenna_pairs(data)
    crosses = pairs[:, 0] != pairs[:, 1]
    if not crosses.any():
        raise InputError("flag_interference: is for cross-correlations, and the data hold none")
    cube, flags = to_cube(data), flag_cube(data)
    # Correlators write zeros where they have no data.
    known = ~flags[:, crosses] & np.isfinite(cube[:, crosses]) & (cube[:, crosses] != 0)
    times, channels = int(known.any(axis=(1, 2, 3)).sum()), int(known.any(axis=(0, 1, 3)).sum())
    require_surroundings(times, channels)
    found = np.zeros((data.Ntimes, data.Nfreqs), bool)
    for index in range(data.Npols):
        found |= _cells(np.abs(cube[..., index][:, crosses]), known[..., index], settings)
    added = found[:, None, :, None] & ~flags
    flags |= added
    ranges = _ranges(np.ravel(data.freq_array), added.any(axis=(1, 3)).mean(axis=0) > 0.5)
    where = f", in more than half of the integrations at {', '.join(ranges)}" if ranges else ""
    return f"Interference: {100 * added.mean():.1f} % of the samples were flagged by hera_qm{where}."


def _cells(amplitudes: np.ndarray, known: np.ndarray, settings: Interference) -> np.ndarray:
    """Return a mask of samples to flag, (Ntimes, Nfreqs), from |V| and a mask of known ones, (Ntimes, Nbls, Nfreqs)."""
    from hera_qm.xrfi import xrfi_waterfall

    hits = np.zeros(known.shape, bool)
    for baseline in range(known.shape[1]):
        seen = known[:, baseline]
        # Completely flagged rows and columns are left out; otherwise they would be their neighbours' surroundings.
        part = np.ix_(seen.any(axis=1), seen.any(axis=0))
        if min(seen[part].shape) < LEAST_INTEGRATIONS:
            continue
        values = _filled(amplitudes[:, baseline][part].astype(float), seen[part])
        # hera_qm warns of fewer integrations than its box holds.
        with without_warnings():
            stand_out = xrfi_waterfall(values, nsig_init=settings.significance, nsig_adj=settings.adjacent_significance)
        hits[:, baseline][part] = stand_out & seen[part]
    cells, channels, integrations = (
        hits.sum(axis=axes) / np.maximum(known.sum(axis=axes), 1) for axes in (1, (0, 1), (1, 2))
    )
    return (cells >= CELL) | (channels >= CHANNEL) | (integrations >= INTEGRATION)[:, None]


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return |V| of a baseline, (Ntimes, Nfreqs), over its median, interpolated in frequency where it is not known."""
    channels = np.arange(values.shape[1])
    for row, there in zip(values, known, strict=True):
        row[~there] = np.interp(channels[~there], channels[there], row[there])
    return values / (np.median(values) or 1.0)


def quiet_band(data: UVData) -> tuple[float, float] | None:
    """Flag interference, and return the ends of the longest stretch of channels without it and other flags, Hz.

    A channel with such is flagged in more than half of the samples of baselines that have any. None if no channel is,
    or the stretch has too few channels for a search. The data are as those of `flag_interference`.
    """
    with suppress(InputError):
        flag_interference(data, Interference())
    flags = flag_cube(data)[:, np.not_equal(*antenna_pairs(data).T)]
    flags = flags[:, ~flags.all(axis=(0, 2, 3))]
    longest = max(_stretches(flags.sum(axis=(0, 1, 3)) <= flags[:, :, :1].size / 2), key=len, default=np.arange(0))
    if not LEAST_CHANNELS <= longest.size < data.Nfreqs:
        return None
    first, last = np.ravel(data.freq_array)[longest[[0, -1]]]
    return float(first), float(last)


def _stretches(chosen: np.ndarray) -> list[np.ndarray]:
    """Return the places of consecutive chosen channels."""
    places = np.flatnonzero(chosen)
    return np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if places.size else []


def _ranges(frequencies: np.ndarray, chosen: np.ndarray) -> list[str]:
    """Return consecutive chosen channels as text, the first `NAMED` of them."""
    groups = _stretches(chosen)
    if not groups:
        return []
    texts = [
        f"{frequencies[group[0]] / 1e6:.3f}" + (f" to {frequencies[group[-1]] / 1e6:.3f}" if len(group) > 1 else "")
        for group in groups[:NAMED]
    ]
    texts[-1] += " MHz"
    return texts + ([f"{len(groups) - NAMED} more"] if len(groups) > NAMED else [])
