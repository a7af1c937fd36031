"""Assignment of beams to antennas, from the settings alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calstudy.base.plugins import Plugin
from calstudy.instrument.as_built import BeamErrors, Misalignment, dipole_amplitudes, misalignments
from calstudy.instrument.settings import InstrumentSettings


class AssignedBeam(NamedTuple):
    """Specification of the beam of an antenna; antennas with equal ones share a beam.

    `model` is the index of the nominal beam in the result of `nominal_beams`. `amplitudes` are those of the dipoles of
    feeds x and y, or None if they are all one.
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
    """Return the number of distinct beams of `count` antennas as built; errors are those of `assigned_beams`."""
    built = settings.as_built
    if not (settings.antenna_beams or built.dipoles.differ or built.beams != BeamErrors()):
        return 1
    return len(set(assigned_beams(settings, count)))


def assigned_beams(settings: InstrumentSettings, count: int) -> list[AssignedBeam]:
    """Return the beams of `count` antennas as built; raises InputError if all dipoles of a feed are dead."""
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
