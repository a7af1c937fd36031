"""How a time grows with size: a power law, with the uncertainty of its exponent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

QUANTILES = (0.025, 0.5, 0.975)
"""Of run times: the ends of the central 95 %, and the median."""


@dataclass(frozen=True)
class PowerLaw:
    """value = amplitude · size^exponent; the error is one standard deviation of the exponent."""

    amplitude: float
    exponent: float
    error: float

    def at(self, size: np.ndarray | float) -> np.ndarray | float:
        """Return the value at a size."""
        return self.amplitude * size**self.exponent


def fit_power_law(size: np.ndarray, value: np.ndarray) -> PowerLaw:
    """Fit a straight line to logarithms, each point counting alike.

    Parameters
    ----------
    size, value
        Positive, (Nsizes,), at least three different sizes; the scatter about the line gives the uncertainty.

    Raises
    ------
    ValueError
        If they are not.
    """
    size, value = np.asarray(size, float), np.asarray(value, float)
    if size.shape != value.shape or np.unique(size).size < 3 or not ((size > 0).all() and (value > 0).all()):
        raise ValueError(f"a power law needs positive values at three sizes or more, got {value.size} at {size.size}")
    x, y = np.log(size), np.log(value)
    spread = x - x.mean()
    exponent = float(spread @ y / (spread @ spread))
    intercept = float(y.mean() - exponent * x.mean())
    residual = y - intercept - exponent * x
    variance = residual @ residual / (size.size - 2)
    return PowerLaw(float(np.exp(intercept)), exponent, float(np.sqrt(variance / (spread @ spread))))


@dataclass(frozen=True)
class RuntimeSeries:
    """Run times of one machine or solver.

    Attributes
    ----------
    label
        Machine or solver.
    size
        Number of antennas, or longest baseline in m, (Nsizes,), increasing.
    median, low, high
        Median and ends of the central 95 % of the run times, (Nsizes,), s.
    fit
        The medians as a power of the size.
    """

    label: str
    size: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    fit: PowerLaw


def summarize_runtime(label: str, size: ArrayLike, seconds: Sequence[Sequence[float]]) -> RuntimeSeries:
    """Reduce measured run times to medians, 95 % bands and a power law.

    Parameters
    ----------
    label
        Machine or solver.
    size
        Number of antennas or longest baseline, (Nsizes,), at least three.
    seconds
        Run times for each size, any number of them.

    Raises
    ------
    ValueError
        If there are fewer than three sizes, the lengths do not match or a time is not positive.
    """
    sizes, samples = np.asarray(size, dtype=float), [np.asarray(item, dtype=float) for item in seconds]
    usable = len(samples) == sizes.size >= 3 and all(
        item.ndim == 1 and item.size and (item > 0).all() for item in samples
    )
    if not usable:
        raise ValueError(
            f"run times '{label}': expected positive times at three sizes or more, got {len(samples)} sets of times "
            f"for {sizes.size} sizes"
        )
    low, median, high = np.array([np.quantile(item, QUANTILES) for item in samples]).T
    return RuntimeSeries(label, sizes, median, low, high, fit_power_law(sizes, median))
