"""The MWA full embedded element beam."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from calstudy.instrument.interface import Beam, BeamModel
from calstudy.instrument.settings import Channels

if TYPE_CHECKING:
    import numpy as np


class MwaEmbeddedBeam(BeamModel):
    """The MWA full embedded element beam (Sokolowski et al. 2017), pointed at zenith."""

    dipoles: ClassVar[int] = 16

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

    def require_usable(self, channels: Channels) -> None:
        """Check that the frequencies of the file enclose the channels, without reading the rest of it."""
        from calstudy.instrument.beam_frequencies import choose_frequencies, mwa_frequencies

        choose_frequencies(mwa_frequencies(self.path), channels.band, self.interpolation)

    def make(self, channels: Channels) -> Beam:
        """Read and fit the table over a band slightly wider than the channels'; it refuses frequencies outside."""
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.tabulated import mwa_embedded_element

        return GriddedBeam(mwa_embedded_element(self.path, channels.band, self.interpolation), self.kind, None)

    def make_tiles(self, channels: Channels, amplitudes: np.ndarray) -> list[Beam]:
        """Return the beams of tiles with given amplitudes of their dipoles, (Ntiles, 2 [x, y], 16)."""
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.dipoles import Tile, dipole_fields

        fields = dipole_fields(self.path, channels.band, self.interpolation)
        return [GriddedBeam(Tile(fields, weights), self.kind, None) for weights in amplitudes]
