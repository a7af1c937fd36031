"""The interface of antenna beams."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, cast

import numpy as np
from pydantic import Field

from calstudy.base.plugins import Plugin
from calstudy.instrument.settings import BEAMS, Channels

if TYPE_CHECKING:
    from pyuvdata import UVBeam
    from pyuvdata.analytic_beam import AnalyticBeam

STAND_IN = "beam: {what}, not the MWA full embedded element of Sokolowski et al. (2017)"


class AntennaBeam(Protocol):
    """The primary beam of an antenna, as simulations need it.

    `stand_in` is a note if it is not the beam of the paper, otherwise None.
    """

    name: str
    stand_in: str | None

    def at(self, frequencies: np.ndarray) -> UVBeam | AnalyticBeam:
        """Return the E-field beam at `frequencies` (Hz, (Nfreqs,)), feeds x (east-west) and y (north-south)."""


class Beam(AntennaBeam, Protocol):
    """A nominal beam, one at the zenith, with the solid angles by which power spectra are normalized."""

    def solid_angles(self, frequencies: np.ndarray, polarization: str) -> tuple[np.ndarray, np.ndarray]:
        """Return Ω_p = ∫A dΩ and Ω_pp = ∫A² dΩ above the horizon, in sr, (Nfreqs,) each.

        `frequencies` are in Hz; `polarization` is "xx" or "yy".
        """


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
        first = self.beams[0].stand_in or f"beam: {self.beams[0].name}"
        return f"{first}; antennas with another: {int((self.index > 0).sum())}"


def model_of(section: Plugin) -> BeamModel:
    """Return the value of a beam field as a `BeamModel`; its registry admits no other plug-ins."""
    return cast(BeamModel, section)


class BeamModel(Plugin, ABC):
    """The settings of a beam, from which the beam is made. Fields of a subclass are its settings.

    Its module is imported when an experiment file is read: import slow libraries inside `make`. `dipoles` is the number
    of dipoles of an antenna, if it is a tile whose dipoles may differ (`make_tiles`), otherwise zero. `extent`, m, is
    the length that has the delays and fringe rates of the beam's structure (`simulation.nodes.beam_extent`).
    """

    registry: ClassVar = BEAMS
    dipoles: ClassVar[int] = 0
    extent: ClassVar[float] = 20.0

    kind: str = Field("", description="Name of a beam, or a file.py.")

    @property
    def smooth(self) -> bool:
        """Whether the beam is smooth in frequency, so that simulations may be interpolated between nodes."""
        return True

    def make_tiles(self, channels: Channels, amplitudes: np.ndarray) -> list[Beam]:
        """Return the beams of tiles with given amplitudes of their dipoles; only if `dipoles` is not zero.

        Amplitudes are (Ntiles, 2 [x, y], dipoles), one where nominal and zero where dead. Raises InputError as `make`.
        """
        raise NotImplementedError(f"the beam {self.label} has no dipoles")

    def require_usable(self, channels: Channels) -> None:
        """Raise InputError if `make` would, as far as this can be checked quickly before anything is simulated.

        A beam that needs no file, or is made quickly, need not do anything here.
        """
        del channels

    @abstractmethod
    def make(self, channels: Channels) -> Beam:
        """Return the beam for the channels of an observation; it need not be known far outside their band.

        Raises InputError if a beam file is missing, cannot be read, or does not cover the channels.
        """
