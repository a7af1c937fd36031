"""Beams in closed form: dishes, Gaussians, dipoles, and an ideal tile of the MWA."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.units import Frequency, Length
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class AiryBeam(BeamModel):
    """The beam of a uniformly illuminated circular aperture."""

    version: ClassVar[int] = 2

    kind: str = "airy"
    # No aperture is larger, and the beam of one would hardly have a source in it. So also for the width of a Gaussian.
    diameter: Length = Field(4.0, gt=0, le=1e3)

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from pyuvdata import analytic_beam

        from calstudy.instrument.beams import ExactBeam

        del channels
        airy = analytic_beam.AiryBeam(diameter=self.diameter)
        return ExactBeam(airy, self.kind, STAND_IN.format(what=f"a {self.diameter:g} m Airy disk"))


class GaussianBeam(BeamModel):
    """A Gaussian power beam whose width scales with wavelength."""

    version: ClassVar[int] = 2

    kind: str = "gaussian"
    fwhm_deg: float = Field(22.0, ge=0.01, lt=180, description="Full width at half maximum of the power beam, degrees.")
    reference_frequency: Frequency = Field(182.0e6, ge=10e6, le=10e9, description="Where the width is `fwhm_deg`.")

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from pyuvdata import analytic_beam

        from calstudy.instrument.beams import ExactBeam

        del channels
        # Half power at half the FWHM. The sigma is that of the E-field: pyuvdata widens a power sigma at every copy.
        gaussian = analytic_beam.GaussianBeam(
            sigma=np.deg2rad(self.fwhm_deg) / 2 / np.sqrt(np.log(2)),
            sigma_type="efield",
            spectral_index=-1.0,
            reference_frequency=self.reference_frequency,
        )
        return ExactBeam(gaussian, self.kind, STAND_IN.format(what=f"a Gaussian of {self.fwhm_deg:g}° FWHM"))


class DipoleBeam(BeamModel):
    """A short dipole."""

    kind: str = "short-dipole"

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from pyuvdata.analytic_beam import ShortDipoleBeam

        from calstudy.instrument.beams import ExactBeam

        del channels
        return ExactBeam(ShortDipoleBeam(), self.kind, STAND_IN.format(what="a short dipole"))


class MwaAnalyticBeam(BeamModel):
    """An ideal 4 x 4 MWA tile: array factor of short dipoles over a ground screen, pointed at zenith."""

    kind: str = "mwa-analytic"

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from calstudy.instrument.beams import ExactBeam, MwaTile

        del channels
        return ExactBeam(MwaTile(), self.kind, STAND_IN.format(what="an ideal 4 x 4 tile of short dipoles"))
