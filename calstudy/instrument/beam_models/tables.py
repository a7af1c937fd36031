"""Beams from tables: beamfits files, HERA's, and the MWA full embedded element."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from calstudy.base.package_files import BEAM, PackageFile
from calstudy.instrument.beam_frequencies import choose_frequencies, mwa_frequencies
from calstudy.instrument.interface import STAND_IN, Beam, BeamModel
from calstudy.instrument.settings import Channels

HERA_FILES = {
    "fagnoni": PackageFile("hera_pspec", "data/HERA_NF_efield.beamfits"),
    "nic-cst": PackageFile("pyuvsim", "data/HERA_NicCST.beamfits"),
}

MENTIONED = 1e-3
"""Difference of an interpolated field from its table, relative to the zenith, that notes mention."""

Interpolation = Literal["chebyshev", "cubic", "linear", "nearest"]


class _TabulatedBeam(BeamModel):
    """Base of beams that are interpolated in frequency."""

    interpolation: Interpolation = "chebyshev"

    @property
    def smooth(self) -> bool:
        """Whether it is interpolated by a smooth fit."""
        return self.interpolation == "chebyshev"


class _BeamfitsBeam(_TabulatedBeam, ABC):
    @abstractmethod
    def _file(self) -> tuple[Path, str, str]:
        """Return the file, the name of the beam, and what it is in a note."""

    def require_usable(self, channels: Channels) -> None:
        """Read the file, and check that its frequencies enclose the channels."""
        self.make(channels)

    def make(self, channels: Channels) -> Beam:
        """Read and fit the table over a band slightly wider than the channels'; it refuses frequencies outside."""
        from calstudy.instrument.beams import GriddedBeam
        from calstudy.instrument.tabulated import beam_of_file

        path, name, what = self._file()
        table = beam_of_file("beamfits", path, channels.band, self.interpolation)
        if table.fit_error > MENTIONED:
            what += f" ({self.interpolation}: within {table.fit_error:.1%} of the field at the zenith)"
        return GriddedBeam(table, name, STAND_IN.format(what=what))


class FileBeam(_BeamfitsBeam):
    """A beam from a beamfits file, on a grid of azimuth and zenith angle or on HEALPix.

    It should be an E-field, whose phase in the direction s is -2 pi nu d.s / c for an element at d: fields for
    exp(+i omega t) must be conjugated. The field of a power beam is its square root, along the direction of the feed,
    which is not smooth at nulls: visibilities through an Airy disk of 14 m are right to 1 or 2 % of their rms.
    """

    version: ClassVar[int] = 2

    kind: str = "beamfits"
    path: Path

    def _file(self) -> tuple[Path, str, str]:
        return self.path, self.path.name, f"the file {self.path.name}"


class HeraBeam(_BeamfitsBeam):
    """HERA's dish with the dipole feed of Phase I, from electromagnetic simulations by Nicolas Fagnoni.

    `fagnoni` is tabulated every 4 MHz from 100 to 200 MHz, on HEALPix of nside 32 (in the package hera_pspec).
    `nic-cst` is tabulated every 15 MHz from 100 to 145 MHz, on a grid of one degree (in pyuvsim). Between these
    frequencies both are smooth fits, without the structure that reflections in the dish cause at delays beyond some
    100 ns. Phases are those of the files; they matter only where antennas have different beams.
    """

    version: ClassVar[int] = 2
    # With 20 m foregrounds err by 4e-6 of their rms, with 40 m by 3e-8, and with this by 3e-10.
    extent: ClassVar[float] = 60.0

    kind: str = "hera"
    model: Literal["fagnoni", "nic-cst"] = "fagnoni"

    def _file(self) -> tuple[Path, str, str]:
        return HERA_FILES[self.model].path, self.kind, f"HERA's ({self.model})"


class MwaEmbeddedBeam(_TabulatedBeam):
    """The MWA full embedded element beam (Sokolowski et al. 2017), pointed at zenith."""

    dipoles: ClassVar[int] = 16

    kind: str = "mwa-embedded-element"
    path: Path | None = Field(None, description="Beam file; default: the file of the mwa_pb package.")
    interpolation: Interpolation = Field(
        "chebyshev",
        description="Interpolation between tabulated frequencies, 1.28 MHz apart: `chebyshev` is a smooth fit, the "
        "others go from point to point, as in the paper.",
    )

    def require_usable(self, channels: Channels) -> None:
        """Check that the frequencies of the file enclose the channels, without reading the rest of it."""
        choose_frequencies(mwa_frequencies(self.path or BEAM.find()), channels.band, self.interpolation)

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
