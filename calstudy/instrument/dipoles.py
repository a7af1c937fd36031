"""Beams of MWA tiles whose dipoles have different amplitudes, from the full embedded element model.

The field of a tile is linear in the voltages of its dipoles, each of which excites its neighbours as well. Therefore
the fields of the sixteen dipoles are computed once, and the beam of a tile is their weighted sum.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from pyuvdata.uvbeam.mwa_beam import MWABeam

from calstudy.base.errors import InputError
from calstudy.base.package_files import BEAM
from calstudy.instrument.as_built import FEEDS
from calstudy.instrument.beam_frequencies import fit_range
from calstudy.instrument.tabulated import PIXELS_PER_DEGREE, TabulatedBeam, mwa_embedded_element


class DipoleFields:
    """The fields of the sixteen dipoles of a tile, each driven alone, with the response of the others.

    Parameters are those of `mwa_embedded_element`. `whole` is the beam of a tile with identical dipoles. Raises
    InputError if the file cannot be read or does not cover the band.
    """

    def __init__(self, path: Path | None, band: tuple[float, float], interpolation: str) -> None:
        self.whole = mwa_embedded_element(path, band, interpolation)
        feeds = list(self.whole.description["feed_array"])
        if feeds != list(FEEDS):
            raise InputError(f"instrument.beam.path: {path} has feeds {', '.join(feeds)}, not x and y")
        fields = _single_fields(BEAM.find() if path is None else path, *fit_range(band))
        # Shape (Ndipoles, Nreduced, 2, Nfeeds, Nza, Naz).
        self.reduced = np.stack([self.whole.interpolation.reduce(field) for field in fields])


class Tile(TabulatedBeam):
    """The table of the beam of one tile with dipole amplitudes (2 [x, y], 16)."""

    def __init__(self, fields: DipoleFields, amplitudes: np.ndarray) -> None:
        super().__init__(fields.whole.fitted)
        self._fields, self._amplitudes = fields, amplitudes

    @property
    def reduced(self) -> np.ndarray:
        """The weighted sum of the tables of the dipoles."""
        tables = np.moveaxis(self._fields.reduced, 3, 0)
        feeds = zip(self._amplitudes, tables, strict=True)
        return np.stack([np.tensordot(weights, table, axes=1) for weights, table in feeds], axis=2)


dipole_fields = lru_cache(maxsize=1)(DipoleFields)
"""They are slow to compute and take 0.5 GB: once for each process."""


def _single_fields(path: Path, low: float, high: float) -> Iterator[np.ndarray]:
    """Yield J of each dipole, (Ntab, 2 [azimuth, zenith angle], 2 [x, y], Nza, Naz), complex.

    These are the steps of `UVBeam.read_mwa_beam`, which would read all modes each time and take six times as long. As
    in `mwa_embedded_element`, the phases are those of the visibilities, opposite to the file's.
    """
    reader = MWABeam()
    available, feeds, dipoles, lengths = reader._read_metadata(path)
    frequencies = available[(available >= low) & (available <= high)]
    azimuth = np.deg2rad(np.arange(360 * PIXELS_PER_DEGREE) / PIXELS_PER_DEGREE)
    zenith_angle = np.deg2rad(np.arange(90 * PIXELS_PER_DEGREE + 1) / PIXELS_PER_DEGREE)
    for dipole in dipoles:
        modes = reader._get_beam_modes(
            h5filepath=path,
            freqs_hz=frequencies,
            pol_names=feeds,
            dipole_names=[dipole],
            max_length=lengths,
            delays=np.zeros((len(feeds), 1), dtype=int),
            amplitudes=np.ones((len(feeds), 1)),
        )
        # Modes of the other dipoles may have a higher degree, and the reader allocates space for them.
        for mode in (mode for by_frequency in modes.values() for mode in by_frequency.values()):
            mode.update({name: mode[name][: len(mode["M"])] for name in ("Q1", "Q2")})
        jones = reader._get_response(
            freqs_hz=frequencies, pol_names=feeds, beam_modes=modes, phi_arr=azimuth, theta_arr=zenith_angle
        )
        yield jones.transpose(2, 1, 0, 4, 3).conj()
