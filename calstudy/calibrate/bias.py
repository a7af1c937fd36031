"""The foreground residual of a calibration that two noise realizations have in common.

The residual of a fit is noise, the signal, and an error e. The part of e that both realizations share survives the
cross power of even and odd: it is the bias of P^R. In a simulation the noise is known, and is subtracted to find e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calstudy.calibrate.agreement import TAPER, Baselines
from calstudy.power.clusters import Clusters
from calstudy.power.delay import delay_transform


@dataclass(frozen=True, eq=False)
class Realization:
    """One measurement of one integration whose parts are known; complex, (Nbls, Nfreqs) each, in Jy.

    Visibilities are as measured, gains included; the noise is before the gains, and `gain_products` are the true g_a
    g_b*.
    """

    visibilities: np.ndarray
    noise: np.ndarray
    gain_products: np.ndarray

    def residual_without_noise(self, fitted_products: np.ndarray, model: np.ndarray) -> np.ndarray:
        """Return the noise-free residual on the scale of the true gains, independent of degeneracies of the fit.

        `fitted_products` and `model` are g_a g_b* and F as fitted, (Nbls, Nfreqs).
        """
        return (self.visibilities - fitted_products * model) / self.gain_products - self.noise


def cross_power(even: np.ndarray, odd: np.ndarray, baselines: Baselines) -> np.ndarray:
    """Sum Re <even* odd> of each baseline over its delays outside the wedge, (Nbls,), (Jy Hz)^2.

    Visibilities are of one integration, complex, (Nbls, Nfreqs), in Jy.
    """
    first, second = (delay_transform(values, baselines.frequency, TAPER) for values in (even, odd))
    return np.sum((first.conj() * second).real, axis=1, where=baselines.outside)


def ratio_over_antennas(power: np.ndarray, reference: np.ndarray, antennas: np.ndarray) -> tuple[float, float]:
    """Return sum(power) / sum(reference) over baselines, (Nbls,) each, and its standard deviation.

    The foreground residual of a fit is mostly due to errors of its gains, which the baselines of an antenna share. The
    standard deviation comes from leaving out one antenna after the other (`calstudy.power.clusters`). `antennas` are
    the two of each baseline, (Nbls, 2).
    """
    clusters = Clusters.of_baselines(antennas)
    above, below = (clusters.sums(values[:, None], np.repeat(values, 2)[:, None]) for values in (power, reference))
    value, error = above.ratio(below)
    return float(value[0]), float(error[0])
