"""What a calibration leaves of the foregrounds, as far as two noise realizations have it in common.

The residual of a fit is noise, the signal, and an error e of which the part that both realizations share survives the
cross power of even and odd: the bias of P^R. In a simulation the noise is known, and e is what is left without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calstudy.calibrate.agreement import TAPER, Baselines
from calstudy.power.clusters import Clusters
from calstudy.power.delay import delay_transform


@dataclass(frozen=True, eq=False)
class Realization:
    """One measurement of one integration whose parts are known; (Nbls, Nfreqs) each, complex, Jy.

    Attributes
    ----------
    visibilities
        As measured, gains included.
    noise
        The noise in them, before the gains.
    gain_products
        The true g_a g_b*.
    """

    visibilities: np.ndarray
    noise: np.ndarray
    gain_products: np.ndarray

    def residual_without_noise(self, fitted_products: np.ndarray, model: np.ndarray) -> np.ndarray:
        """Return the residual on the scale of the true gains, which no degeneracy of the fit moves, without the noise.

        Parameters
        ----------
        fitted_products, model
            g_a g_b* and F as fitted, (Nbls, Nfreqs).
        """
        return (self.visibilities - fitted_products * model) / self.gain_products - self.noise


def cross_power(even: np.ndarray, odd: np.ndarray, baselines: Baselines) -> np.ndarray:
    """Return Re <even* odd> of each baseline, (Nbls,), added up over its delays outside the wedge, (Jy Hz)^2.

    Parameters
    ----------
    even, odd
        Visibilities of one integration, (Nbls, Nfreqs), complex, Jy.
    baselines
        Their lengths, channels and the buffer of the wedge.
    """
    first, second = (delay_transform(values, baselines.frequency, TAPER) for values in (even, odd))
    return np.sum((first.conj() * second).real, axis=1, where=baselines.outside)


def ratio_over_antennas(power: np.ndarray, reference: np.ndarray, antennas: np.ndarray) -> tuple[float, float]:
    """Return sum(power) / sum(reference) over baselines and its standard deviation.

    What a fit leaves of the foregrounds is mostly due to errors of its gains, which the baselines of an antenna share.
    The error comes from leaving out one antenna after the other (`calstudy.power.clusters`).

    Parameters
    ----------
    power, reference
        (Nbls,) each.
    antennas
        The two antennas of each baseline, (Nbls, 2).
    """
    clusters = Clusters.of_baselines(antennas)
    above, below = (clusters.sums(values[:, None], np.repeat(values, 2)[:, None]) for values in (power, reference))
    value, error = above.ratio(below)
    return float(value[0]), float(error[0])
