"""The MWA full embedded element beam."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from calstudy.instrument.interface import Beam, BeamModel
from calstudy.instrument.settings import Channels


class MwaEmbeddedBeam(BeamModel):
    """The MWA full embedded element beam (Sokolowski et al. 2017), pointed at zenith."""

    path: Path | None = Field(None, strict=False, description="Beam file; default: the file of the mwa_pb package.")
    interpolation: Literal["chebyshev", "cubic", "linear", "nearest"] = Field(
        "chebyshev",
        description="Interpolation between tabulated frequencies, 1.28 MHz apart: `chebyshev` is a smooth fit, the "
        "others go from point to point, as in the paper.",
    )

    @property
    def smooth(self) -> bool:
        """Whether it is interpolated by a smooth fit."""
        return self.interpolation == "chebyshev"

    def make(self, channels: Channels) -> Beam:
        """Read and fit the table over a band a bit wider than the channels'; it refuses frequencies outside."""
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.tabulated import TabulatedBeam, read_mwa_embedded_element

        table = read_mwa_embedded_element(self.path, channels.band)
        return GriddedBeam(TabulatedBeam(table, channels.band, self.interpolation), self.kind, None)
