"""Beams in closed form: dishes, Gaussians, dipoles, and an ideal tile of the MWA."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.units import Frequency, Length
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels

if TYPE_CHECKING:
    from pyuvdata.analytic_beam import AnalyticBeam


class _Formula(BeamModel):
    @abstractmethod
    def _formula(self) -> tuple[AnalyticBeam, str]:
        """Return the beam, and what it is in a note."""

    def make(self, channels: Channels) -> Beam:
        """Return the beam, which is valid at any frequency."""
        from calstudy.instrument.beams import ExactBeam

        del channels
        beam, what = self._formula()
        return ExactBeam(beam, self.kind, STAND_IN.format(what=what))


class AiryBeam(_Formula):
    """The beam of a uniformly illuminated circular aperture."""

    version: ClassVar[int] = 2

    kind: str = "airy"
    # No aperture is larger, and the beam of one would hardly have a source in it. So also for the width of a Gaussian.
    diameter: Length = Field(4.0, gt=0, le=1e3)

    def _formula(self) -> tuple[AnalyticBeam, str]:
        from pyuvdata import analytic_beam

        return analytic_beam.AiryBeam(diameter=self.diameter), f"a {self.diameter:g} m Airy disk"


class GaussianBeam(_Formula):
    """A Gaussian power beam whose width scales with wavelength."""

    version: ClassVar[int] = 2

    kind: str = "gaussian"
    fwhm_deg: float = Field(22.0, ge=0.01, lt=180, description="Full width at half maximum of the power beam, degrees.")
    reference_frequency: Frequency = Field(182.0e6, ge=10e6, le=10e9, description="Where the width is `fwhm_deg`.")

    def _formula(self) -> tuple[AnalyticBeam, str]:
        from pyuvdata import analytic_beam

        # Half power at half the FWHM. The sigma is that of the E-field: pyuvdata widens a power sigma at every copy.
        gaussian = analytic_beam.GaussianBeam(
            sigma=np.deg2rad(self.fwhm_deg) / 2 / np.sqrt(np.log(2)),
            sigma_type="efield",
            spectral_index=-1.0,
            reference_frequency=self.reference_frequency,
        )
        return gaussian, f"a Gaussian of {self.fwhm_deg:g}° FWHM"


class DipoleBeam(_Formula):
    """A short dipole."""

    kind: str = "short-dipole"

    def _formula(self) -> tuple[AnalyticBeam, str]:
        from pyuvdata.analytic_beam import ShortDipoleBeam

        return ShortDipoleBeam(), "a short dipole"


class MwaAnalyticBeam(_Formula):
    """An ideal 4 x 4 MWA tile: array factor of short dipoles over a ground screen, pointed at zenith."""

    kind: str = "mwa-analytic"

    def _formula(self) -> tuple[AnalyticBeam, str]:
        from calstudy.instrument.beams import MwaTile

        return MwaTile(), "an ideal 4 x 4 tile of short dipoles"
