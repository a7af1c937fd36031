"""A short dipole."""

from __future__ import annotations

from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class DipoleBeam(BeamModel):
    """A short dipole."""

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from pyuvdata.analytic_beam import ShortDipoleBeam

        from calstudy.instrument.beams import ExactBeam

        del channels
        return ExactBeam(ShortDipoleBeam(), self.kind, STAND_IN.format(what="a short dipole"))
