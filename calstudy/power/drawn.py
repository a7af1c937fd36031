"""The input power spectrum of an EoR sky, in the units of the estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calstudy.power.cosmology import make_cosmology

if TYPE_CHECKING:
    from calstudy.sky.settings import Eor

MILLIKELVIN2 = 1e6


def input_power(settings: Eor, k: np.ndarray, cosmology: str) -> np.ndarray:
    """Return the input P(k), mK^2 h^-3 Mpc^3, at wavenumbers `k` (h/Mpc, any shape).

    Amplitude and shape in the settings of the EoR sky are in units without h.
    """
    from calstudy.sky.eor import input_power as in_kelvin

    h = float(make_cosmology(cosmology).h)
    return MILLIKELVIN2 * h**3 * in_kelvin(settings, np.asarray(k) * h, h)
