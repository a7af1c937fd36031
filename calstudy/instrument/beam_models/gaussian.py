"""A Gaussian beam."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from calstudy.base.units import Frequency
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class GaussianBeam(BeamModel):
    """A Gaussian power beam whose width scales with wavelength."""

    fwhm_deg: float = Field(22.0, gt=0, lt=180, description="Full width at half maximum of the power beam, in degrees.")
    reference_frequency: Frequency = Field(182.0e6, gt=0, description="Frequency at which the width is `fwhm_deg`.")

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
