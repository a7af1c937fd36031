"""An ideal tile of the MWA."""

from __future__ import annotations

from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class MwaAnalyticBeam(BeamModel):
    """An ideal 4 x 4 MWA tile: array factor of short dipoles over a ground screen, pointed at zenith."""

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from calstudy.instrument.beams import ExactBeam, MwaTile

        del channels
        return ExactBeam(MwaTile(), self.kind, STAND_IN.format(what="an ideal 4 x 4 tile of short dipoles"))
