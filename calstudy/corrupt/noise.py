"""Thermal noise."""

from __future__ import annotations

import numpy as np


def thermal_noise(shape: tuple[int, ...], std: float, seed: int) -> np.ndarray:
    """Draw circular complex Gaussian noise with E|n|^2 = std^2, independent in every sample.

    Parameters
    ----------
    shape
        Of the returned complex128 array.
    std
        Standard deviation of the complex samples; each of the real and imaginary parts has std / sqrt(2).
    seed
        Same seed and shape, same noise.
    """
    rng = np.random.default_rng(seed)
    noise = np.empty(shape, dtype=np.complex128)
    noise.real = rng.standard_normal(shape)
    noise.imag = rng.standard_normal(shape)
    noise *= std / np.sqrt(2)
    return noise
