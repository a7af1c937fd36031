"""Flags where data of several baselines stand out from their surroundings in time and frequency, by hera_qm."""

from __future__ import annotations

import warnings

import numpy as np
from pyuvdata import UVData

from calstudy.base.errors import InputError
from calstudy.measured.settings import Interference

NAMED = 8
"""So many ranges of channels are named in a note."""


def flag_interference(data: UVData, settings: Interference) -> str:
    """Flag interference in all baselines and polarizations; return in words what was flagged.

    Of each cross-correlation |V| is compared with the median of its surroundings, and with their scatter. A channel of
    an integration is flagged if it stands out in a fifth of the baselines; a channel if it is flagged in a twentieth of
    the integrations; an integration if half of its channels are (`hera_qm.xrfi.xrfi_h1c_pipe`, the flagging of HERA's
    first season; Kerrigan et al. 2019 describe and compare it). Autocorrelations do not take part: their noise is so
    low that the bandpass stands out.

    Parameters
    ----------
    data
        Changed; samples that are flagged do not count, and stay flagged.
    settings
        How far samples must stand out.

    Raises
    ------
    InputError
        If there are only autocorrelations.
    """
    from hera_qm.xrfi import xrfi_h1c_pipe

    crosses = np.flatnonzero(data.ant_1_array != data.ant_2_array)
    if not crosses.size:
        raise InputError("interference is looked for in cross-correlations, and the data hold none")
    searched = data.select(blt_inds=crosses, inplace=False, run_check=False)
    searched.data_array[searched.flag_array | ~np.isfinite(searched.data_array)] = 0
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # Few integrations, and surroundings without scatter, are what it tells of.
        warnings.simplefilter("ignore")
        found = xrfi_h1c_pipe(
            searched, sig_init=settings.significance, sig_adj=settings.adjacent_significance, run_check=False
        )[1]
    hit = found.flag_array.any(axis=2)
    rows = np.searchsorted(found.time_array, data.time_array)
    before = data.flag_array.mean()
    data.flag_array |= hit[rows][..., None]
    added = data.flag_array.mean() - before
    ranges = _ranges(np.ravel(data.freq_array), hit.mean(axis=0) > 0.5)
    where = f", most of {', '.join(ranges)}" if ranges else ""
    return f"Interference: {100 * added:.2g} % of the samples were flagged{where} (by hera_qm)."


def _ranges(frequencies: np.ndarray, chosen: np.ndarray) -> list[str]:
    """Return consecutive chosen channels as text, the first `NAMED` of them."""
    places = np.flatnonzero(chosen)
    if not places.size:
        return []
    groups = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    texts = [
        f"{frequencies[group[0]] / 1e6:.3f}" + (f" to {frequencies[group[-1]] / 1e6:.3f}" if len(group) > 1 else "")
        for group in groups[:NAMED]
    ]
    texts[-1] += " MHz"
    return texts + ([f"{len(groups) - NAMED} more"] if len(groups) > NAMED else [])
