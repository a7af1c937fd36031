"""hera_pspec's quadratic estimator with identity weighting (`calstudy.power.estimate`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from calstudy.power.interface import Estimator, PowerBeam
from calstudy.power.settings import HERA_PSPEC_ANTENNAS
from calstudy.power.spectra import DelaySpectra, delay_spectra

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.power.settings import PowerSettings


class HeraPspec(Estimator):
    """hera_pspec's quadratic estimator with identity weighting; all pairs of baselines are exported to pspec.h5."""

    largest_antenna: ClassVar[int | None] = HERA_PSPEC_ANTENNAS

    def estimate(self, even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings) -> DelaySpectra:
        """Return the delay spectra of even times odd; see `calstudy.power.estimate.estimate_power`."""
        from calstudy.power.estimate import estimate_power

        return delay_spectra(estimate_power(even, odd, beam, settings), settings)

    def estimate_and_export(
        self, even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings, folder: Path
    ) -> DelaySpectra:
        """Return the delay spectra of even times odd, and write those of all pairs to pspec.h5, a `UVPSpec`."""
        from calstudy.power.estimate import estimate_power

        found = estimate_power(even, odd, beam, settings)
        found.write_hdf5(str(folder / "pspec.h5"))
        return delay_spectra(found, settings)
