"""Which antennas share a beam, from the settings alone: for plans, before anything is made."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calstudy.base.plugins import Plugin
from calstudy.instrument.as_built import BeamErrors, Misalignment, dipole_amplitudes, misalignments
from calstudy.instrument.settings import InstrumentSettings


class AssignedBeam(NamedTuple):
    """What the beam of an antenna is made of; antennas for which it is equal share a beam.

    Attributes
    ----------
    model
        Index of its nominal beam in what `nominal_beams` returns.
    amplitudes
        Of the dipoles of its feeds x and y; None if they are all one.
    misalignment
        Orientation and width.
    """

    model: int
    amplitudes: tuple[tuple[float, ...], ...] | None
    misalignment: Misalignment


def nominal_beams(settings: InstrumentSettings) -> list[Plugin]:
    """Return the distinct nominal beams, `instrument.beam` first."""
    distinct: list[Plugin] = [settings.beam]
    for group in settings.antenna_beams.values():
        if group.beam not in distinct:
            distinct.append(group.beam)
    return distinct


def beam_count(settings: InstrumentSettings, count: int) -> int:
    """Return how many different beams `count` antennas have as built; parameters and errors as `assigned_beams`."""
    built = settings.as_built
    if not (settings.antenna_beams or built.dipoles.differ or built.beams != BeamErrors()):
        return 1
    return len(set(assigned_beams(settings, count)))


def assigned_beams(settings: InstrumentSettings, count: int) -> list[AssignedBeam]:
    """Return what the beam of each antenna as built is made of.

    Parameters
    ----------
    settings
        The `instrument` section.
    count
        Antennas of the layout.

    Raises
    ------
    InputError
        If all dipoles of a feed are dead.
    """
    distinct, index = nominal_beams(settings), np.zeros(count, dtype=int)
    for group in settings.antenna_beams.values():
        index[list(group.antennas)] = distinct.index(group.beam)
    dipoles = settings.as_built.dipoles
    amplitudes = dipole_amplitudes(dipoles, count) if dipoles.differ else np.ones((count, 0, 0))
    return [
        AssignedBeam(int(model), None if (weights == 1).all() else tuple(map(tuple, weights.tolist())), misalignment)
        for model, weights, misalignment in zip(
            index, amplitudes, misalignments(settings.as_built.beams, count), strict=True
        )
    ]
