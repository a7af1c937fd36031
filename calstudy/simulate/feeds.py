"""Polarizations as elements of the matrices of linear feeds, for engines that return both feeds."""

from __future__ import annotations

import numpy as np
from pyradiosky import SkyModel
from pyuvdata import UVData

from calstudy.instrument.antenna_beams import split_beams
from calstudy.simulate.brightness import is_polarized

# Row and column of a matrix of feeds x and y that hold each polarization number.
FEED_PAIRS = {-5: (0, 0), -6: (1, 1), -7: (0, 1), -8: (1, 0)}


def refusal(engine: str, sky: SkyModel, beam, template: UVData) -> str | None:
    """Return why an engine for unpolarized skies and feeds x and y does not support a simulation, or None."""
    if is_polarized(sky):
        return f"the {engine} engine supports unpolarized skies only"
    unknown = [int(number) for number in template.polarization_array if int(number) not in FEED_PAIRS]
    if unknown:
        return f"polarization number {unknown[0]} is not linear"
    beams, _ = split_beams(beam, template)
    if any(list(item.at(template.freq_array[:1]).feed_array) != ["x", "y"] for item in beams):
        return f"{engine} needs beams with feeds x and y"
    return None


def select_polarizations(matrices: np.ndarray, template: UVData) -> np.ndarray:
    """Return the template's polarizations, (..., Npols), of matrices of feeds, (..., 2, 2)."""
    rows, columns = np.array([FEED_PAIRS[int(number)] for number in template.polarization_array]).T
    return matrices[..., rows, columns]
