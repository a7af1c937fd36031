"""The beam of a dish."""

from __future__ import annotations

from pydantic import Field

from calstudy.base.units import Length
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class AiryBeam(BeamModel):
    """The beam of a uniformly illuminated circular aperture."""

    diameter: Length = Field(4.0, gt=0)

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from pyuvdata import analytic_beam

        from calstudy.instrument.beams import ExactBeam

        del channels
        airy = analytic_beam.AiryBeam(diameter=self.diameter)
        return ExactBeam(airy, self.kind, STAND_IN.format(what=f"a {self.diameter:g} m Airy disk"))
