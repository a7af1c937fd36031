"""Arrays with different beams on different antennas."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from calstudy.base.plugins import guarded
from calstudy.instrument.as_built import Misalignment
from calstudy.instrument.beams import make_beam
from calstudy.instrument.distinct_beams import AssignedBeam, assigned_beams, nominal_beams
from calstudy.instrument.interface import AntennaBeam, Beam, model_of
from calstudy.instrument.misaligned import MisalignedBeam, NominalBeam

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.instrument.settings import InstrumentSettings

Source = TypeVar("Source")


@dataclass(frozen=True)
class AntennaBeams:
    """The distinct beams of an array, and the index of the beam of each antenna in the order of the layout, (Nants,).

    The first beam is `instrument.beam`, as built for the first antenna that has it.
    """

    beams: tuple[AntennaBeam, ...]
    index: np.ndarray

    @property
    def stand_in(self) -> str | None:
        """The note on the beam of `instrument.beam`, and the number of antennas with other beams."""
        others = f"antennas with another: {int((self.index > 0).sum())}"
        return "; ".join(note for note in (self.beams[0].stand_in or f"beam: {self.beams[0].name}", others))


def make_beams(settings: InstrumentSettings, n_antennas: int) -> AntennaBeam | AntennaBeams:
    """Return the beam of all antennas, or the beams of an array that has several.

    Antennas whose beams as built are equal share one. Raises InputError if a beam file is missing, cannot be read, or
    does not cover the channels, or the beam cannot have the errors of `instrument.as_built`.
    """
    assigned = assigned_beams(settings, n_antennas)
    # Antennas with `instrument.beam` first.
    distinct = list(dict.fromkeys(sorted(assigned, key=lambda beam: beam.model > 0)))
    beams = tuple(_make(distinct, settings))
    index = np.array([distinct.index(beam) for beam in assigned])
    return AntennaBeams(beams, index) if len(beams) > 1 else beams[0]


def _make(distinct: list[AssignedBeam], settings: InstrumentSettings) -> list[AntennaBeam]:
    models = nominal_beams(settings)
    made: dict[tuple, Beam] = {}
    for model in dict.fromkeys(beam.model for beam in distinct):
        section, members = models[model], [beam for beam in distinct if beam.model == model]
        if any(beam.amplitudes is None for beam in members):
            made[model, None] = make_beam(section, settings.channels)
        tiles = list(dict.fromkeys(beam.amplitudes for beam in members if beam.amplitudes is not None))
        if tiles:
            with guarded(section):
                tile_beams = model_of(section).make_tiles(settings.channels, np.array(tiles))
            made |= {(model, amplitudes): beam for amplitudes, beam in zip(tiles, tile_beams, strict=True)}
    nominal = Misalignment()
    found = [((beam.model, beam.amplitudes), beam.misalignment) for beam in distinct]
    counts = Counter(key for key, error in found if error != nominal)
    shared = {key: NominalBeam(made[key], keep=count > 1) for key, count in counts.items()}
    return [made[key] if error == nominal else MisalignedBeam(shared[key], error) for key, error in found]


def split_beams(beam: Source | AntennaBeams, template: UVData) -> tuple[tuple[Source | AntennaBeam, ...], np.ndarray]:
    """Return the distinct beams of an array, and the index of the beam of each antenna, (Nants,) int."""
    if isinstance(beam, AntennaBeams):
        return beam.beams, beam.index
    return (beam,), np.zeros(template.telescope.Nants, dtype=int)
