"""Power pattern of a feed towards many directions at many frequencies: the part of a simulation that is not fringes."""

from __future__ import annotations

from typing import Protocol

import numba
import numpy as np
from pyuvdata import BeamInterface, UVBeam
from pyuvdata.analytic_beam import AnalyticBeam

from calstudy.errors import InputError

# Pixels by which pyuvdata extends a beam in azimuth so that its splines see it wrap.
AZIMUTH_EXTENSION = 3


class PowerPattern(Protocol):
    """What a source of unit flux density gives in each feed, |J_theta|^2 + |J_phi|^2."""

    n_feeds: int

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections), azimuth from east through north; both in rad."""


def power_pattern(beam: UVBeam | AnalyticBeam, frequencies: np.ndarray, feeds: list[str]) -> PowerPattern:
    """Return the power pattern of some feeds of an E-field beam at some frequencies.

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

    def __init__(self, beam: AnalyticBeam, frequencies: np.ndarray, feeds: list[str]):
        self._beam = BeamInterface(beam, beam_type="efield")
        self._frequencies = frequencies
        self._feeds = [list(beam.feed_array).index(feed) for feed in feeds]
        self.n_feeds = len(feeds)

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections)."""
        jones = self._beam.compute_response(az_array=azimuth, za_array=zenith_angle, freq_array=self._frequencies)
        return (np.abs(jones[:, self._feeds]) ** 2).sum(axis=0)


class SplinePattern:
    """Power pattern of a tabulated beam whose E-field is interpolated by bicubic splines, as pyuvsim does it.

    The splines are those of `scipy.interpolate.RectBivariateSpline` on the grid that `UVBeam.interp` extends in
    azimuth ("not a knot" at the ends), for real and imaginary part of each component; only the basis is another
    (uniform B-splines), so that one set of sixteen weights serves all frequencies, components and feeds of a source.
    """

    def __init__(self, beam: UVBeam, feeds: list[str]):
        azimuth, self._zenith_angle = beam.axis1_array, beam.axis2_array
        step = azimuth[1] - azimuth[0]
        pad = AZIMUTH_EXTENSION if np.isclose(abs(azimuth[-1] - azimuth[0]) + step, 2 * np.pi, atol=step) else 0
        self._azimuth = azimuth[0] + step * np.arange(-pad, len(azimuth) + pad)
        data = beam.data_array[:, [list(beam.feed_array).index(feed) for feed in feeds]]
        data = np.pad(data, [(0, 0)] * 4 + [(pad, pad)], mode="wrap") if pad else data
        n_axes, n_feeds, n_freqs = data.shape[:3]
        self.n_feeds = n_feeds
        along_za, along_az = (bspline_coefficients(len(axis)) for axis in (self._zenith_angle, self._azimuth))
        # Innermost parts of components, then frequencies: what one source needs lies together.
        self._table = np.empty((len(along_za), len(along_az), n_feeds, n_freqs, 2 * n_axes))
        for feed, freq, axis in np.ndindex(n_feeds, n_freqs, n_axes):
            coefficients = along_za @ data[axis, feed, freq] @ along_az.T
            self._table[:, :, feed, freq, 2 * axis] = coefficients.real
            self._table[:, :, feed, freq, 2 * axis + 1] = coefficients.imag

    def at(self, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the pattern, (Nfeeds, Nfreqs, Ndirections)."""
        _, _, n_feeds, n_freqs, n_parts = self._table.shape
        power = np.empty((n_feeds * n_freqs, len(azimuth)))
        rows = _cells(zenith_angle, self._zenith_angle)
        columns = _cells(azimuth, self._azimuth)
        _spline_power(self._table.reshape(*self._table.shape[:2], -1), n_parts, *rows, *columns, power)
        return power.reshape(n_feeds, n_freqs, -1)


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
def _spline_power(
    table: np.ndarray,
    n_parts: int,
    rows: np.ndarray,
    row_weights: np.ndarray,
    columns: np.ndarray,
    column_weights: np.ndarray,
    power: np.ndarray,
) -> None:
    """Fill `power` (Npatterns, Ndirections) from a table (Nza + 2, Naz + 2, Npatterns * Nparts)."""
    field = np.empty(table.shape[2])
    for source in range(power.shape[1]):
        field[:] = 0.0
        for tap in range(4):
            taps = table[rows[source] + tap, columns[source] : columns[source] + 4]
            _add_row(field, taps, column_weights[source], row_weights[source, tap])
        for pattern in range(power.shape[0]):
            square = 0.0
            for part in range(pattern * n_parts, (pattern + 1) * n_parts):
                square += field[part] * field[part]
            power[pattern, source] = square
