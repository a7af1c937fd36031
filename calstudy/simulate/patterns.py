"""Beam patterns of feeds at many directions and frequencies: the factors of a simulation other than the fringes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numba
import numpy as np
from pyuvdata import BeamInterface, UVBeam
from pyuvdata.analytic_beam import AnalyticBeam

from calstudy.base.errors import InputError

# Pixels by which pyuvdata extends a beam in azimuth so that its splines see it wrap.
AZIMUTH_EXTENSION = 3


class Pattern(Protocol):
    """Weights of sources of unit flux density: `n_weights` real numbers for each frequency and direction."""

    n_weights: int

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the weights, (Nweights, Nfreqs, Ndirections), azimuth from east through north; both in rad."""


class PowerPattern(Pattern, Protocol):
    """|J_theta|^2 + |J_phi|^2 of each feed of one beam: one weight per feed."""

    def fields(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts of both components of J, (Ndirections, Nfeeds, Nfreqs, 4)."""


def power_pattern(beam: UVBeam | AnalyticBeam, frequencies: np.ndarray, feeds: list[str]) -> PowerPattern:
    """Return the power pattern of some feeds of an E-field beam at some frequencies.

    Parameters
    ----------
    beam
        E-field beam.
    frequencies
        Hz, (Nfreqs,).
    feeds
        Such as "x" and "y".

    Raises
    ------
    InputError
        If the beam is not an E-field beam with these feeds, or is a tabulated one that is not peak-normalized, not on a
        regular grid in azimuth and zenith angle, or not at these frequencies.
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
    """Return why `power_pattern` cannot take this beam, or None if it can."""
    missing = sorted(set(feeds) - set(beam.feed_array))
    if missing:
        return f"the beam has no feed {', '.join(missing)}, only {', '.join(beam.feed_array)}"
    if not isinstance(beam, UVBeam):
        return None
    if beam.beam_type != "efield":
        return f"the beam is a {beam.beam_type} beam, an E-field beam is needed"
    if beam.data_normalization != "peak":
        return f"the beam's normalization is {beam.data_normalization}, peak is needed"
    if beam.pixel_coordinate_system != "az_za":
        return f"the beam is on a {beam.pixel_coordinate_system} grid, azimuth and zenith angle are needed"
    return None


class AnalyticPattern:
    """Power pattern of a closed-form beam."""

    def __init__(self, beam: AnalyticBeam, frequencies: np.ndarray, feeds: list[str]) -> None:
        self._beam = BeamInterface(beam, beam_type="efield")
        self._frequencies = frequencies
        self._feeds = [list(beam.feed_array).index(feed) for feed in feeds]
        self.n_weights = len(feeds)

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
    """Power pattern of a tabulated beam whose E-field is interpolated by bicubic splines, as pyuvsim does it.

    The splines are those of `scipy.interpolate.RectBivariateSpline` on the grid that `UVBeam.interp` extends in
    azimuth ("not a knot" at the ends), for real and imaginary part of each component; only the basis is another
    (uniform B-splines), so that one set of sixteen weights serves all frequencies, components and feeds of a source.
    """

    def __init__(self, beam: UVBeam, feeds: list[str]) -> None:
        azimuth, self._zenith_angle = beam.axis1_array, beam.axis2_array
        step = azimuth[1] - azimuth[0]
        pad = AZIMUTH_EXTENSION if np.isclose(abs(azimuth[-1] - azimuth[0]) + step, 2 * np.pi, atol=step) else 0
        self._azimuth = azimuth[0] + step * np.arange(-pad, len(azimuth) + pad)
        data = beam.data_array[:, [list(beam.feed_array).index(feed) for feed in feeds]]
        data = np.pad(data, [(0, 0)] * 4 + [(pad, pad)], mode="wrap") if pad else data
        n_axes, n_feeds, n_freqs = data.shape[:3]
        self.n_weights = n_feeds
        along_za, along_az = (bspline_coefficients(len(axis)) for axis in (self._zenith_angle, self._azimuth))
        # Innermost parts of components, then frequencies: what one source needs lies together.
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
        rows, columns = _cells(zenith_angle, self._zenith_angle), _cells(azimuth, self._azimuth)
        _spline_fields(table, *rows, *columns, fields)
        return fields.reshape(len(azimuth), *self._table.shape[2:])


class CrossPattern:
    """Products of the fields of several beams, of whose antennas every pair is a baseline.

    For beams k and l, W_kl = sum of J_k conj(J_l) over the components of J, a complex number unless k = l. It is held
    in a matrix of real numbers per feed: Re W_kl at (k, l) for k <= l, Im W_kl at (l, k) for k < l.

    Parameters
    ----------
    patterns
        Of the beams, with the same feeds and frequencies.
    """

    def __init__(self, patterns: Sequence[PowerPattern]) -> None:
        self._patterns = patterns
        self.n_weights = len(patterns) ** 2 * patterns[0].n_weights

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the matrix, flattened: (Nbeams * Nbeams * Nfeeds, Nfreqs, Ndirections)."""
        fields = [pattern.fields(azimuth, zenith_angle).view(np.complex128) for pattern in self._patterns]
        count, (n_directions, n_feeds, n_freqs) = len(fields), fields[0].shape[:3]
        weights = np.empty((count, count, n_feeds, n_freqs, n_directions))
        for k in range(count):
            for other in range(k, count):
                product = (fields[k] * fields[other].conj()).sum(axis=3).transpose(1, 2, 0)
                weights[other, k] = product.imag
                weights[k, other] = product.real
        return weights.reshape(-1, n_freqs, n_directions)


def bspline_coefficients(count: int) -> np.ndarray:
    """Return the matrix from equally spaced samples to the coefficients of their cubic spline, (count + 2, count).

    The spline is the one without knots at the second and the last but one sample, in the basis of uniform cubic
    B-splines; coefficient i belongs to the B-spline centred on sample i - 1.
    """
    conditions = np.zeros((count + 2, count + 2))
    for sample in range(count):
        conditions[sample, sample : sample + 3] = 1 / 6, 4 / 6, 1 / 6
    # No jump of the third derivative at a sample: the fourth difference of the coefficients around it vanishes.
    conditions[count, :5] = conditions[count + 1, -5:] = 1, -4, 6, -4, 1
    return np.linalg.solve(conditions, np.eye(count + 2)[:, :count])


def _cells(values: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each value, clamped to the grid, its first B-spline, (N,) int, and the weights of four, (N, 4)."""
    position = np.clip((values - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    cell = np.minimum(position.astype(np.intp), len(grid) - 2)
    x = position - cell
    weights = np.empty((len(values), 4))
    weights[:, 0] = (1 - x) ** 3 / 6
    weights[:, 1] = (4 - 6 * x**2 + 3 * x**3) / 6
    weights[:, 2] = (1 + 3 * x + 3 * x**2 - 3 * x**3) / 6
    weights[:, 3] = x**3 / 6
    return cell, weights


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _add_row(total: np.ndarray, taps: np.ndarray, weights: np.ndarray, factor: float) -> None:
    first, second, third, fourth = taps[0], taps[1], taps[2], taps[3]
    a, b, c, d = factor * weights[0], factor * weights[1], factor * weights[2], factor * weights[3]
    for i in range(total.size):
        total[i] += a * first[i] + b * second[i] + c * third[i] + d * fourth[i]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _spline_fields(
    table: np.ndarray,
    rows: np.ndarray,
    row_weights: np.ndarray,
    columns: np.ndarray,
    column_weights: np.ndarray,
    fields: np.ndarray,
) -> None:
    """Fill `fields` (Ndirections, Nvalues) from a table (Nza + 2, Naz + 2, Nvalues)."""
    for source in range(len(fields)):
        field = fields[source]
        field[:] = 0.0
        for tap in range(4):
            taps = table[rows[source] + tap, columns[source] : columns[source] + 4]
            _add_row(field, taps, column_weights[source], row_weights[source, tap])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_squares(fields: np.ndarray, power: np.ndarray) -> None:
    """Fill `power` (Npatterns, Ndirections) from fields (Ndirections, Npatterns, Nparts)."""
    for source in range(fields.shape[0]):
        for pattern in range(fields.shape[1]):
            square = 0.0
            for part in range(fields.shape[2]):
                square += fields[source, pattern, part] * fields[source, pattern, part]
            power[pattern, source] = square
