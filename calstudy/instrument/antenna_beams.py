"""Arrays with different beams on different antennas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from calstudy.instrument.beams import make_beam
from calstudy.instrument.interface import Beam

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.instrument.settings import InstrumentSettings

Source = TypeVar("Source")


@dataclass(frozen=True)
class AntennaBeams:
    """The distinct beams of an array, and the beam of each antenna.

    Attributes
    ----------
    beams
        Distinct beams; the first is `instrument.beam`.
    index
        Index into `beams` for each antenna, in the order of the layout, (Nants,) int.
    """

    beams: tuple[Beam, ...]
    index: np.ndarray

    @property
    def stand_in(self) -> str | None:
        """The stand-in for the paper's beam: that of `instrument.beam`, and the number of antennas with other beams."""
        others = f"antennas with another: {int((self.index > 0).sum())}"
        return "; ".join(note for note in (self.beams[0].stand_in or f"beam: {self.beams[0].name}", others))


def make_beams(settings: InstrumentSettings, n_antennas: int) -> Beam | AntennaBeams:
    """Return the beam of all antennas, or the beams of an array that has several.

    Parameters
    ----------
    settings
        The `instrument` section. Sets of antennas with equal beams share one.
    n_antennas
        Antennas of the layout.

    Raises
    ------
    InputError
        If a beam file is missing, cannot be read, or does not cover the channels.
    """
    distinct = [settings.beam]
    index = np.zeros(n_antennas, dtype=int)
    for group in settings.antenna_beams.values():
        if group.beam not in distinct:
            distinct.append(group.beam)
        index[list(group.antennas)] = distinct.index(group.beam)
    beams = tuple(make_beam(beam, settings.channels) for beam in distinct)
    return AntennaBeams(beams, index) if len(beams) > 1 else beams[0]


def split_beams(beam: Source | AntennaBeams, template: UVData) -> tuple[tuple[Source | Beam, ...], np.ndarray]:
    """Return the distinct beams of an array, and which of them each antenna of the telescope has, (Nants,) int."""
    if isinstance(beam, AntennaBeams):
        return beam.beams, beam.index
    return (beam,), np.zeros(template.telescope.Nants, dtype=int)
