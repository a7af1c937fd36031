"""What gains that are fitted to foregrounds project out of a small signal, in one channel."""

import numpy as np


def projector(pairs: np.ndarray, foregrounds: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Return what gains leave of a signal, (2 Nbls, 2 Nbls): real parts of all baselines, then imaginary parts.

    It is orthogonal in the metric of the weights (Nbls,), which are one by default.
    """
    antennas, rows = pairs.max() + 1, np.arange(len(pairs))
    design = np.zeros((len(pairs), 2 * antennas), complex)
    for place, sign in ((0, 1), (1, -1)):
        design[rows, pairs[:, place]] += foregrounds
        design[rows, antennas + pairs[:, place]] += 1j * sign * foregrounds
    root = np.ones(2 * len(pairs)) if weights is None else np.sqrt(np.tile(weights, 2))
    left, values, _ = np.linalg.svd(root[:, None] * np.concatenate([design.real, design.imag]), full_matrices=False)
    space = left[:, values > 1e-9 * values[0]]
    assert space.shape[1] == 2 * antennas - 1
    return np.eye(2 * len(pairs)) - (space / root[:, None]) @ (space * root[:, None]).T


def random(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.normal(size=count) + 1j * rng.normal(size=count)
