"""Skies at given frequencies, from flux densities in sub-bands or any other kind of spectrum."""

from __future__ import annotations

import numpy as np
from astropy import units
from pyradiosky import SkyModel

from calstudy.base.errors import InputError

CUBIC = 4
"""The fewest sub-bands between which cubic interpolation is possible."""


def at_frequencies(sky: SkyModel, frequencies: np.ndarray) -> SkyModel:
    """Return a sky at frequencies in Hz, (Nfreqs,); fewer than four sub-bands are interpolated linearly."""
    require_enclosed(sky, frequencies, "the sky", span(frequencies))
    return sky.at_frequencies(
        frequencies * units.Hz, inplace=False, freq_interp_kind=interpolation_of(sky), run_check=False
    )


def interpolation_of(sky: SkyModel) -> str:
    """Return the kind of interpolation between the sub-bands of a sky."""
    return "linear" if sky.spectral_type == "subband" and sky.Nfreqs < CUBIC else "cubic"


def require_enclosed(sky: SkyModel, frequencies: np.ndarray, where: str, wanted: str) -> None:
    """Raise InputError, with names of the sky and of the frequencies in Hz, if they are not between two sub-bands."""
    if sky.spectral_type != "subband":
        return
    centres = sky.freq_array.to_value("Hz")
    if len(centres) == 1 or frequencies.min() < centres.min() or frequencies.max() > centres.max():
        raise InputError(
            f"{where} has sub-bands centred at {span(centres)}, which do not enclose {wanted}; give sub-bands on both "
            "sides, or spectral indices"
        )


def span(frequencies: np.ndarray) -> str:
    """Name the first and the last of some frequencies in Hz."""
    ends = dict.fromkeys([frequencies.min(), frequencies.max()])
    return " to ".join(f"{end / 1e6:.9g}" for end in ends) + " MHz"
