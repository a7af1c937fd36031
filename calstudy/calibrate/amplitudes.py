"""Amplitudes of antennas before calibration: samples that are exactly zero, and outliers."""

from __future__ import annotations

import numpy as np

from calstudy.base.observation import Observation

FAR = 30.0
"""Amplitudes of an antenna this many times the median of the antennas, or less than its inverse, are reported."""
FEW = 0.05
"""With data in a smaller fraction of the channels, a fit of foregrounds and gains is unreliable; this is reported."""


def dead_samples(data: Observation, chosen: np.ndarray) -> np.ndarray:
    """Find samples that are exactly zero because an antenna was off, bool, (Ntimes, Nchosen, Nfreqs, Npols).

    An antenna is off in a channel of an integration if all its baselines that are not flagged are exactly zero there.
    `chosen`, bool, (Nbls,), selects baselines.
    """
    zero = ~data.flags[:, chosen] & (data.visibilities[:, chosen] == 0)
    if not zero.any():
        return zero
    alive = ~data.flags[:, chosen] & ~zero
    antennas = data.antennas[chosen]
    has_data = np.zeros((len(data.numbers), *np.delete(zero.shape, 1)), bool)
    for column in antennas.T:
        np.logical_or.at(has_data, column, np.moveaxis(alive, 1, 0))
    first, second = (np.moveaxis(has_data[column], 0, 1) for column in antennas.T)
    return zero & ~(first & second)


def conspicuous(data: Observation) -> list[str]:
    """Describe antennas that are zero throughout or have outlying amplitudes, and integrations with few channels."""
    crosses = ~data.autos
    dead, antennas = dead_samples(data, crosses), data.antennas[crosses]
    live = ~data.flags[:, crosses] & ~dead
    counts, sums = live.sum(axis=(0, 2, 3)), np.zeros(len(antennas))
    for time, used in enumerate(live):
        sums += np.sum(np.abs(data.visibilities[time, crosses]), axis=(1, 2), where=used)
    amplitudes = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    own, zeros = np.full(len(data.numbers), np.nan), []
    for antenna, number in enumerate(data.numbers):
        touching = (antennas == antenna).any(axis=1)
        if np.isfinite(amplitudes[touching]).any():
            own[antenna] = np.nanmedian(amplitudes[touching])
        elif dead[:, touching].any():
            zeros.append(str(number))
    found = []
    if dead.any():
        whole = f", all that there are of antenna(s) {', '.join(zeros)}" if zeros else ""
        found = [f"{dead.sum()} samples are exactly zero, as all of an antenna then, and count as flagged{whole}."]
    median = np.nanmedian(own) if np.isfinite(own).any() else np.nan
    for antenna in np.flatnonzero((own > FAR * median) | (own < median / FAR)).tolist():
        found.append(
            f"Antenna {data.numbers[antenna]}: amplitudes of its visibilities are {own[antenna] / median:.2g} times "
            "the median of the antennas; flag it if it is broken, for it can decide the gains of all others."
        )
    return found + _few_channels(live)


def _few_channels(live: np.ndarray) -> list[str]:
    """Describe solves with data in few channels; `live` is (Ntimes, Nbls, Nfreqs, Npols)."""
    counts = live.any(axis=1).sum(axis=1)
    few = (counts > 0) & (counts < FEW * live.shape[2])
    if not few.any():
        return []
    return [
        f"{few.any(axis=1).sum()} integration(s) have data in at most {counts[few].max()} of {live.shape[2]} channels: "
        "gains that are fitted together with foregrounds mean nothing there."
    ]
