"""What gains that are fitted to foregrounds project out of a small signal, in one channel."""

import numpy as np


def projector(pairs: np.ndarray, foregrounds: np.ndarray) -> np.ndarray:
    """Return what gains leave of a signal, (2 Nbls, 2 Nbls): real parts of all baselines, then imaginary parts."""
    antennas, rows = pairs.max() + 1, np.arange(len(pairs))
    design = np.zeros((len(pairs), 2 * antennas), complex)
    for place, sign in ((0, 1), (1, -1)):
        design[rows, pairs[:, place]] += foregrounds
        design[rows, antennas + pairs[:, place]] += 1j * sign * foregrounds
    left, values, _ = np.linalg.svd(np.concatenate([design.real, design.imag]), full_matrices=False)
    space = left[:, values > 1e-9 * values[0]]
    assert space.shape[1] == 2 * antennas - 1
    return np.eye(2 * len(pairs)) - space @ space.T


def random(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.normal(size=count) + 1j * rng.normal(size=count)
