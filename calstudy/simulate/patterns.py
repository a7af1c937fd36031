"""Beam patterns of feeds at many directions and frequencies: the factors of a simulation other than the fringes."""

from __future__ import annotations

from typing import Protocol

import numba
import numpy as np
from pyuvdata import BeamInterface, UVBeam
from pyuvdata.analytic_beam import AnalyticBeam

from calstudy.base.errors import InputError
from calstudy.instrument.beam_grid import bspline_coefficients, cells, spline_fields

# Pixels by which pyuvdata extends a beam in azimuth so that its splines see it wrap.
AZIMUTH_EXTENSION = 3


class Pattern(Protocol):
    """Response of `n_feeds` feeds of a beam; azimuths run from east through north, in rad."""

    n_feeds: int

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return |J_theta|^2 + |J_phi|^2 of each feed, (Nfeeds, Nfreqs, Ndirections)."""

    def fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J, (Ndirections, Nfeeds, Nfreqs, 4)."""


def power_pattern(beam: UVBeam | AnalyticBeam, frequencies: np.ndarray, feeds: list[str]) -> Pattern:
    """Return the power pattern of some feeds, such as "x" and "y", of an E-field beam at frequencies in Hz, (Nfreqs,).

    Raises InputError with the reason of `refusal`, or if a table is not at these frequencies.
    """
    reason = refusal(beam, feeds)
    if reason:
        raise InputError(reason)
    if isinstance(beam, UVBeam):
        if beam.freq_array.shape != frequencies.shape or not np.allclose(
            beam.freq_array, frequencies, rtol=0, atol=1.0
        ):
            raise InputError("the beam is not tabulated at the frequencies to be simulated")
        return SplinePattern(beam, feeds)
    return AnalyticPattern(beam, frequencies, feeds)


def refusal(beam: UVBeam | AnalyticBeam, feeds: list[str]) -> str | None:
    """Return the reason why `power_pattern` does not support a beam, or None if it does."""
    missing = sorted(set(feeds) - set(beam.feed_array))
    if missing:
        return f"the beam has no feed {', '.join(missing)}, only {', '.join(beam.feed_array)}"
    if not isinstance(beam, UVBeam):
        return None
    needed = {"beam_type": "efield", "data_normalization": "peak", "pixel_coordinate_system": "az_za"}
    for name, value in needed.items():
        if getattr(beam, name) != value:
            return f"the beam's {name} is {getattr(beam, name)}, {value} is needed"
    return None


class InterpolatedPattern:
    """Pattern at the nodes of a frequency axis, interpolated by a matrix (Nfreqs, Nnodes) to its channels."""

    def __init__(self, nodes: Pattern, matrix: np.ndarray) -> None:
        self._nodes, self._matrix, self.n_feeds = nodes, matrix, nodes.n_feeds

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections)."""
        return np.matmul(self._matrix, self._nodes.at(azimuth, zenith_angle))

    def fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J, (Ndirections, Nfeeds, Nfreqs, 4)."""
        return np.matmul(self._matrix, self._nodes.fields(azimuth, zenith_angle))


class AnalyticPattern:
    """Power pattern of a closed-form beam."""

    def __init__(self, beam: AnalyticBeam, frequencies: np.ndarray, feeds: list[str]) -> None:
        self._beam = BeamInterface(beam, beam_type="efield")
        self._frequencies = frequencies
        self._feeds = [list(beam.feed_array).index(feed) for feed in feeds]
        self.n_feeds = len(feeds)

    def _jones(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return J, (2, Nfeeds, Nfreqs, Ndirections)."""
        jones = self._beam.compute_response(az_array=azimuth, za_array=zenith_angle, freq_array=self._frequencies)
        return jones[:, self._feeds]

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections)."""
        return (np.abs(self._jones(azimuth, zenith_angle)) ** 2).sum(axis=0)

    def fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J, (Ndirections, Nfeeds, Nfreqs, 4)."""
        jones = self._jones(azimuth, zenith_angle).astype(np.complex128)
        return np.ascontiguousarray(jones.transpose(3, 1, 2, 0)).view(np.float64)


class SplinePattern:
    """Power pattern of a tabulated beam whose E-field is interpolated by bicubic splines, as in pyuvsim.

    The splines are those of `scipy.interpolate.RectBivariateSpline` on the grid that `UVBeam.interp` extends in
    azimuth ("not a knot" at the ends), for the real and imaginary parts of each component. Only the basis differs: with
    uniform B-splines one set of sixteen weights serves all frequencies, components and feeds of a source.
    """

    def __init__(self, beam: UVBeam, feeds: list[str]) -> None:
        azimuth, self._zenith_angle = beam.axis1_array, beam.axis2_array
        step = azimuth[1] - azimuth[0]
        pad = AZIMUTH_EXTENSION if np.isclose(abs(azimuth[-1] - azimuth[0]) + step, 2 * np.pi, atol=step) else 0
        self._azimuth, self._least = azimuth[0] + step * np.arange(-pad, len(azimuth) + pad), azimuth.min()
        data = beam.data_array[:, [list(beam.feed_array).index(feed) for feed in feeds]]
        data = np.pad(data, [(0, 0)] * 4 + [(pad, pad)], mode="wrap") if pad else data
        n_axes, n_feeds, n_freqs = data.shape[:3]
        self.n_feeds = n_feeds
        along_za, along_az = (bspline_coefficients(len(axis)) for axis in (self._zenith_angle, self._azimuth))
        # The parts of components are innermost, then frequencies: the values for one source are contiguous.
        self._table = np.empty((len(along_za), len(along_az), n_feeds, n_freqs, 2 * n_axes))
        for feed, freq, axis in np.ndindex(n_feeds, n_freqs, n_axes):
            coefficients = along_za @ data[axis, feed, freq] @ along_az.T
            self._table[:, :, feed, freq, 2 * axis] = coefficients.real
            self._table[:, :, feed, freq, 2 * axis + 1] = coefficients.imag

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections)."""
        fields = self.fields(azimuth, zenith_angle)
        power = np.empty((fields.shape[1] * fields.shape[2], len(azimuth)))
        _sum_squares(fields.reshape(len(azimuth), len(power), -1), power)
        return power.reshape(*fields.shape[1:3], -1)

    def fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J, (Ndirections, Nfeeds, Nfreqs, 4)."""
        table = self._table.reshape(*self._table.shape[:2], -1)
        fields = np.empty((len(azimuth), table.shape[2]))
        azimuth = (azimuth - self._least) % (2 * np.pi) + self._least
        rows, columns = cells(zenith_angle, self._zenith_angle), cells(azimuth, self._azimuth)
        spline_fields(table, *rows, *columns, fields)
        return fields.reshape(len(azimuth), *self._table.shape[2:])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_squares(fields: np.ndarray, power: np.ndarray) -> None:
    """Fill `power` (Npatterns, Ndirections) from fields (Ndirections, Npatterns, Nparts)."""
    for source in range(fields.shape[0]):
        for pattern in range(fields.shape[1]):
            square = 0.0
            for part in range(fields.shape[2]):
                square += fields[source, pattern, part] * fields[source, pattern, part]
            power[pattern, source] = square
