"""HERA's beam."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from calstudy.base.package_files import PackageFile
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels

FILES = {
    "fagnoni": PackageFile("hera_pspec", "data/HERA_NF_efield.beamfits"),
    "nic-cst": PackageFile("pyuvsim", "data/HERA_NicCST.beamfits"),
}
"""The file of each model."""


class HeraBeam(BeamModel):
    """HERA's dish with the dipole feed of Phase I, from electromagnetic simulations by Nicolas Fagnoni.

    `fagnoni` is tabulated every 4 MHz from 100 to 200 MHz, on HEALPix of nside 32 (in the package hera_pspec).
    `nic-cst` is tabulated every 15 MHz from 100 to 145 MHz, on a grid of one degree (in pyuvsim). Between these
    frequencies both are smooth fits, without the structure that reflections in the dish cause at delays beyond some
    100 ns.
    """

    model: Literal["fagnoni", "nic-cst"] = "fagnoni"
    interpolation: Literal["chebyshev", "cubic", "linear", "nearest"] = "chebyshev"

    @property
    def smooth(self) -> bool:
        """Whether it is interpolated by a smooth fit."""
        return self.interpolation == "chebyshev"

    @property
    def _file(self) -> Path:
        return FILES[self.model].path

    def require_usable(self, channels: Channels) -> None:
        """Read the file, and check that its frequencies enclose the channels."""
        from calstudy.instrument.beam_frequencies import choose_frequencies
        from calstudy.instrument.beam_grid import read_beamfits

        choose_frequencies(read_beamfits(self._file).freq_array, channels.band, self.interpolation)

    def make(self, channels: Channels) -> Beam:
        """Read and fit the table over a band slightly wider than the channels'; it refuses frequencies outside."""
        from calstudy.instrument.beam_grid import read_beamfits
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.tabulated import TabulatedBeam, fit_table

        table = TabulatedBeam(fit_table(read_beamfits(self._file), channels.band, self.interpolation))
        return GriddedBeam(table, self.kind, STAND_IN.format(what=f"HERA's ({self.model})"))
