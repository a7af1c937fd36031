"""What becomes of a tabulated beam between the frequencies at which it is tabulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from calstudy.errors import InputError
from calstudy.instrument.beams import GriddedBeam, make_beam
from calstudy.instrument.settings import Beam, Channels, InstrumentSettings, MwaEmbeddedBeam

INTERPOLATIONS = get_args(MwaEmbeddedBeam.model_fields["interpolation"].annotation)
SMOOTH = INTERPOLATIONS[0]


@dataclass(frozen=True)
class BeamFit:
    """Differences between Jones components, relative to the zenith, over directions, feeds and components.

    Attributes
    ----------
    tabulated : (Ntab,) float
        Tabulated frequencies within the band, Hz.
    fit_rms, fit_max : (Ntab,) float
        Rms and largest difference of the smooth fit from the table.
    channels : (Nfreqs,) float
        Channels, Hz.
    others : dict
        By interpolation, the rms difference of the other interpolations from the smooth fit, (Nfreqs,).
    """

    tabulated: np.ndarray
    fit_rms: np.ndarray
    fit_max: np.ndarray
    channels: np.ndarray
    others: dict[str, np.ndarray]


def require_tabulated(beam: Beam) -> None:
    """Raise InputError for a beam in closed form, which is not interpolated."""
    if not hasattr(beam, "interpolation"):
        raise InputError(
            f"instrument.beam: {beam.kind} is a formula, exact at every frequency; there is no fit to check"
        )


def compare_interpolations(instrument: InstrumentSettings, step: int = 4) -> BeamFit:
    """Compare the smooth fit of a beam with its table, and the other interpolations with the smooth fit.

    Parameters
    ----------
    instrument
        Beam and channels.
    step
        Only every so many channels are looked at.

    Raises
    ------
    InputError
        If the beam is not tabulated.
    """
    require_tabulated(instrument.beam)
    beams = {name: interpolated(instrument.beam, instrument.channels, name) for name in INTERPOLATIONS}
    tabulated = beams[SMOOTH].tabulated_frequencies
    difference = _difference(beams[SMOOTH], beams["nearest"], tabulated)
    settings = instrument.channels
    channels = (settings.first + settings.width * np.arange(settings.count))[::step]
    return BeamFit(
        tabulated=tabulated,
        fit_rms=_rms(difference),
        fit_max=np.abs(difference).max(axis=(0, 1, 3, 4)),
        channels=channels,
        others={
            name: _rms(_difference(beam, beams[SMOOTH], channels)) for name, beam in beams.items() if name != SMOOTH
        },
    )


def interpolated(beam: Beam, channels: Channels, interpolation: str) -> GriddedBeam:
    """Return a tabulated beam with another interpolation between its frequencies."""
    return make_beam(beam.model_copy(update={"interpolation": interpolation}), channels)


def _difference(beam: GriddedBeam, other: GriddedBeam, frequencies: np.ndarray) -> np.ndarray:
    """Return J - J', (2, Nfeeds, Nfreqs, Nza, Naz)."""
    return beam.at(frequencies).data_array - other.at(frequencies).data_array


def _rms(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(difference) ** 2, axis=(0, 1, 3, 4)))
