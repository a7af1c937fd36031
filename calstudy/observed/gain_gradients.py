"""Phase gradients across an array, which its redundancy does not determine, taken out of the difference of gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.calibrate.gain_comparison import GainPair
from calstudy.instrument.layouts import redundant_groups

TOLERANCE = 1.0
"""m. Baselines that differ by less count as the same."""
NOT_PARALLEL = 0.3
"""The sine of the angle between two baselines that span a plane is larger."""


def without_gradients(pair: GainPair) -> GainPair:
    """Take the phase gradient between two sets of gains out of the first, however many turns it is across the array.

    Gains g_a' = g_a exp(i q x_a) have the products of antennas of one redundant group all turned by q d: the mean of
    those products gives q d for the shortest group, and for the shortest that is not parallel to it. On a lattice these
    are its steps, and whole turns per step make no difference. Elsewhere q must be less than half a turn per baseline.

    Parameters
    ----------
    pair
        Gains from two sources. Not mutated.

    Returns
    -------
    The same, with first gains that have no gradient against the second, in any integration and channel, but for the
    noise of the estimate. Amplitudes and common phases are as before.
    """
    first, second = np.triu_indices(len(pair.antennas), 1)
    if not first.size:
        return pair
    vectors = pair.positions[second] - pair.positions[first]
    groups = redundant_groups(np.column_stack([vectors, np.zeros(len(vectors))]), TOLERANCE)
    overlap = pair.first * pair.second.conj()
    products = overlap[:, second] * overlap[:, first].conj()
    products[:, groups.conjugated] = products[:, groups.conjugated].conj()
    vectors = np.where(groups.conjugated[:, None], -vectors, vectors)
    steps, turns = [], []
    for group in _spanning([vectors[groups.index == number].mean(axis=0) for number in range(groups.index.max() + 1)]):
        members = groups.index == group
        steps.append(vectors[members].mean(axis=0))
        turns.append(np.angle(products[:, members].sum(axis=1)))
    gradients = np.einsum("ij,jtf->tif", np.linalg.pinv(np.array(steps)), np.array(turns))
    phases = np.einsum("ai,tif->taf", pair.positions - pair.positions.mean(axis=0), gradients)
    return replace(pair, first=pair.first * np.exp(-1j * phases))


def _spanning(vectors: list[np.ndarray]) -> list[int]:
    """Return the places of the shortest vector, and of the shortest that is not parallel to it if there is one."""
    order = np.argsort([np.linalg.norm(vector) for vector in vectors])
    shortest = vectors[order[0]] / np.linalg.norm(vectors[order[0]])
    for place in order[1:]:
        across = shortest[0] * vectors[place][1] - shortest[1] * vectors[place][0]
        if abs(across) > NOT_PARALLEL * np.linalg.norm(vectors[place]):
            return [int(order[0]), int(place)]
    return [int(order[0])]
