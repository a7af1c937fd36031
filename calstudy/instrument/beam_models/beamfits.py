"""A beam from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels


class FileBeam(BeamModel):
    """A beam from a beamfits file, on a grid of azimuth and zenith angle or on HEALPix.

    It should be an E-field: the field of a power beam is taken to be its square root, along the direction of the feed.
    """

    path: Path = Field(strict=False)
    interpolation: Literal["chebyshev", "cubic", "linear", "nearest"] = "chebyshev"

    @property
    def smooth(self) -> bool:
        """Whether it is interpolated by a smooth fit."""
        return self.interpolation == "chebyshev"

    def require_usable(self, channels: Channels) -> None:
        """Read the file, and check that its frequencies enclose the channels."""
        from calstudy.instrument.beam_frequencies import choose_frequencies
        from calstudy.instrument.beam_grid import read_beamfits

        choose_frequencies(read_beamfits(self.path).freq_array, channels.band, self.interpolation)

    def make(self, channels: Channels) -> Beam:
        """Read and fit the table over a band slightly wider than the channels'; it refuses frequencies outside."""
        from calstudy.instrument.beam_grid import read_beamfits
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.tabulated import TabulatedBeam, fit_table

        table = TabulatedBeam(fit_table(read_beamfits(self.path), channels.band, self.interpolation))
        return GriddedBeam(table, self.path.name, STAND_IN.format(what=f"the file {self.path.name}"))
