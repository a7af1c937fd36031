"""Interpolation of tabulated beams in frequency.

An element at d from the centre of an antenna has the phase -2 pi nu d.s / c in the direction s. That is the convention
of the visibilities (`calstudy.instrument.beams`), in which an antenna at x_a has that phase with x_a for d.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from pyuvdata import UVBeam
from scipy.interpolate import interp1d

from calstudy.base.errors import InputError
from calstudy.base.kept_arrays import kept_arrays
from calstudy.base.package_files import BEAM
from calstudy.base.user_code import digest_file
from calstudy.instrument import beam_frequencies, beam_grid
from calstudy.instrument.beam_frequencies import FIT_BAND, choose_frequencies, fit_range, megahertz
from calstudy.instrument.beam_grid import DESCRIPTION, describe, fixed_components, tabulate

PIXELS_PER_DEGREE = 1

FIT_ORDER = 8


def mwa_embedded_element(path: Path | None, band: tuple[float, float], interpolation: str) -> TabulatedBeam:
    """Make the zenith-pointed full embedded element beam of an MWA tile (Sokolowski et al. 2017).

    The default file is that of `calstudy.base.package_files.BEAM`. `band` is the lowest and highest frequency in Hz;
    the margin that a fit needs is read as well. See `TabulatedBeam` for `interpolation`. Raises InputError if the file
    is missing or not of this band.
    """
    return beam_of_file("mwa-beam", BEAM.find() if path is None else path, band, interpolation)


def beam_of_file(kind: str, path: Path, band: tuple[float, float], interpolation: str) -> TabulatedBeam:
    """Make the beam of a file of a kind in `READERS`. Its fit is slow, and kept for later processes."""
    if not path.is_file():
        raise InputError(f"instrument.beam.path: there is no file {path}")
    return _fitted(kind, path, digest_file(path), band, interpolation)


@lru_cache(maxsize=4)
def _fitted(kind: str, path: Path, digest: str, band: tuple[float, float], interpolation: str) -> TabulatedBeam:
    decisive = {
        "file": digest,
        "band": band,
        "interpolation": interpolation,
        "code": [digest_file(Path(source)) for source in (__file__, beam_frequencies.__file__, beam_grid.__file__)],
        "libraries": {name: version(name) for name in ("h5py", "numpy", "pyuvdata", "scipy")},
    }
    fitted = kept_arrays(kind, decisive, lambda: fit_table(READERS[kind](path, band), band, interpolation))
    return TabulatedBeam({name: values if values.ndim else values.item() for name, values in fitted.items()})


def _read_mwa(path: Path, band: tuple[float, float]) -> UVBeam:
    try:
        beam = UVBeam.from_file(
            path, file_type="mwa_beam", pixels_per_deg=PIXELS_PER_DEGREE, freq_range=list(fit_range(band))
        )
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"instrument.beam.path: {path} cannot be read as an MWA beam file ({error})") from error
    # Its phases are +2 pi nu d.s / c.
    beam.data_array = beam.data_array.conj()
    return beam


READERS: Mapping[str, Callable[[Path, tuple[float, float]], UVBeam]] = {
    "mwa-beam": _read_mwa,
    "beamfits": lambda path, _: beam_grid.read_beamfits(path),
}


def fit_table(table: UVBeam, band: tuple[float, float], interpolation: str) -> dict[str, Any]:
    """Reduce a table on a grid of azimuth and zenith angle to the arrays, strings and numbers of a `TabulatedBeam`.

    They can be stored in a file. `band` is in Hz. Raises InputError if the table does not cover it.
    """
    chosen = choose_frequencies(table.freq_array, band, interpolation)
    tabulated = table.freq_array[chosen]
    values = np.ascontiguousarray(np.moveaxis(table.data_array[:, :, chosen], 2, 0))
    in_frequency = FrequencyInterpolation(tabulated, interpolation)
    reduced = in_frequency.reduce(values)
    first, last = np.searchsorted(tabulated, band[0], side="right") - 1, np.searchsorted(tabulated, band[1])
    around = slice(first, last + 1)
    azimuth = table.axis1_array[0]
    fitted = zenith_normalized(in_frequency.evaluate(reduced, tabulated[around]), azimuth)
    return {
        "interpolation": interpolation,
        "tabulated": tabulated,
        "reduced": reduced,
        "tabulated_frequencies": tabulated[around],
        "fit_error": float(np.abs(fitted - zenith_normalized(values[around], azimuth)).max()),
        **describe(table),
    }


class TabulatedBeam:
    """Jones components on a grid of directions, as continuous functions of frequency, from `fit_table`.

    Interpolation "chebyshev" fits one smooth polynomial in frequency to the table, for each direction, feed and
    component. Its power at large delays is at the level of rounding. "cubic", "linear" and "nearest" interpolate from
    point to point, as in the paper, and reproduce the scatter of the table.

    The result is divided by its zenith value, for each feed (`zenith_normalized`). For these beams the zenith value is
    the peak. It is a smooth function of frequency; the largest tabulated value (the maximum over pixels and feeds) need
    not be.

    `zenith_angles` are in rad, (Nza,). `tabulated_frequencies`, (Ntab,), Hz, are those in the band, and those next to
    its ends; `fit_error` is the largest |ΔJ| against the table there, relative to the zenith.
    """

    def __init__(self, fitted: Mapping[str, Any]) -> None:
        self.fitted = fitted
        self.description = {name: fitted[name] for name in DESCRIPTION}
        self.zenith_angles = fitted["axis2_array"]
        self.tabulated_frequencies, self.fit_error = fitted["tabulated_frequencies"], fitted["fit_error"]
        self.interpolation = FrequencyInterpolation(fitted["tabulated"], fitted["interpolation"])

    @property
    def reduced(self) -> np.ndarray:
        """The table as `interpolation` has reduced it, (Nreduced, 2, Nfeeds, Nza, Naz)."""
        return self.fitted["reduced"]

    def jones(self, frequencies: np.ndarray) -> np.ndarray:
        """Return J of shape (2 [azimuth, zenith angle], Nfeeds, Nfreqs, Nza, Naz), complex, at `frequencies` in Hz.

        Raises InputError if any is outside the band of the beam.
        """
        frequencies = np.asarray(frequencies, dtype=float)
        low, high = self.fitted["tabulated"][[0, -1]].tolist()
        if frequencies.min() < low or frequencies.max() > high:
            raise InputError(
                f"frequencies {megahertz(frequencies.min(), frequencies.max())} are outside the band for which the "
                f"beam was made, {megahertz(low, high)}"
            )
        return zenith_normalized(self.interpolation.evaluate(self.reduced, frequencies), self.fitted["axis1_array"][0])

    def at(self, frequencies: np.ndarray) -> UVBeam:
        """Return the E-field beam tabulated at `frequencies` in Hz, (Nfreqs,)."""
        return tabulate(self.description, self.jones(frequencies), frequencies)


def zenith_normalized(values: np.ndarray, azimuth: float) -> np.ndarray:
    """Divide by the square root of the zenith power, and by the phase there along the feed, per feed and frequency.

    Complex values (Nfreqs, 2 [azimuth, zenith angle], Nfeeds, Nza, Naz) become (2, Nfeeds, Nfreqs, Nza, Naz). Feeds are
    x and y, or x. `azimuth` is that of the first column, rad.
    """
    jones = np.moveaxis(values, 0, 2)
    fixed = fixed_components(jones[..., 0, 0], np.array(azimuth))
    feeds = range(fixed.shape[1])
    zenith = np.sqrt((np.abs(fixed) ** 2).sum(axis=0)) * np.exp(1j * np.angle(fixed[feeds, feeds]))
    return jones / zenith[None, :, :, None, None]


class FrequencyInterpolation:
    """Interpolation, linear in the table, between frequencies in Hz, (Ntab,); see `TabulatedBeam` for its kinds."""

    def __init__(self, tabulated: np.ndarray, kind: str) -> None:
        self._tabulated, self._kind = tabulated, kind
        width = tabulated[-1] - tabulated[0]
        # Beyond 2 sqrt(n) a polynomial through n equally spaced points swings between them.
        self._order = min(
            max(FIT_ORDER, round(FIT_ORDER * width / FIT_BAND)), int(2 * np.sqrt(len(tabulated))), len(tabulated) - 1
        )
        self._domain = [tabulated[0], tabulated[-1]] if width > 0 else [tabulated[0] - 1, tabulated[0] + 1]

    def _basis(self, frequencies: np.ndarray) -> np.ndarray:
        scaled = np.polynomial.polyutils.mapdomain(np.asarray(frequencies, dtype=float), self._domain, [-1, 1])
        return chebyshev.chebvander(scaled, self._order)

    def reduce(self, values: np.ndarray) -> np.ndarray:
        """Reduce a table (Ntab, ...) for `evaluate`: for "chebyshev" to coefficients, (order + 1, ...)."""
        if self._kind != "chebyshev":
            return values
        return np.tensordot(np.linalg.pinv(self._basis(self._tabulated)), values, axes=1)

    def evaluate(self, reduced: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
        """Return the interpolated table at frequencies (Hz), (Nfreqs, ...)."""
        if self._kind != "chebyshev":
            return interp1d(self._tabulated, reduced, kind=self._kind, axis=0, assume_sorted=True)(frequencies)
        return np.tensordot(self._basis(frequencies), reduced, axes=1)
