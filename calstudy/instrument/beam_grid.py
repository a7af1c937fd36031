"""Beams of UVBeam files, on grids or HEALPix, E-field or power, as E-fields on a grid of azimuth and zenith angle.

Components along azimuth and zenith angle are discontinuous at the zenith. Therefore the components along two fixed
directions are interpolated between pixels (`fixed_components`), by bicubic splines with many values in each direction.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import healpy
import numba
import numpy as np
from pyuvdata import UVBeam
from scipy.interpolate import make_interp_spline

from calstudy.base.errors import InputError

POLARIZATIONS = {"x": -5, "y": -6}
# HEALPix maps finer than this are put on a grid finer than one point per degree.
DEGREE_NSIDE = 64
# Degree of the splines across the rings of a HEALPix map.
SPLINE_DEGREE = 5
# In a ring of n pixels, orders that exceed (n - 1) / 2 by this are zero: amplitudes grow as a power of the angle.
UNRESOLVED = 2
# Part of the power at the zenith that has one direction for all azimuths, and part of the peak's that is at the zenith.
LEAST_DIRECTED, LEAST_ZENITH = 0.9, 1e-3
# Rings below the horizon that splines may use (rad).
BELOW = np.radians(15)
NAMES = ("telescope_name", "feed_name", "feed_version", "model_name", "model_version", "history")
DESCRIPTION = (*NAMES, "feed_array", "feed_angle", "axis1_array", "axis2_array", "basis_vector_array")
"""Attributes of a UVBeam that do not depend on its frequencies."""


def describe(beam: UVBeam) -> dict[str, Any]:
    """Return the grid, feeds and names of a beam, for `tabulate`."""
    return {name: getattr(beam, name) for name in DESCRIPTION}


def tabulate(
    description: Mapping[str, Any], jones: np.ndarray, frequencies: np.ndarray, normalization: str = "peak"
) -> UVBeam:
    """Return an E-field beam at frequencies in Hz, (Nfreqs,), with the grid, feeds and names of a description.

    `jones` is (2 [azimuth, zenith angle], Nfeeds, Nfreqs, Nza, Naz), complex; "peak": one at the zenith.
    """
    return UVBeam.new(
        **description,
        data_normalization=normalization,
        freq_array=np.asarray(frequencies, dtype=float),
        mount_type="fixed",
        pixel_coordinate_system="az_za",
        data_array=np.ascontiguousarray(jones),
    )


def read_beamfits(path: Path) -> UVBeam:
    """Read a beam from a beamfits file, as an E-field on a grid of azimuth and zenith angle from the zenith.

    Frequencies ascend, azimuths ascend from east within [0, 2 pi), and components are along azimuth and zenith angle,
    whatever the file has. Phases are those of the file, which must have the sign of `calstudy.instrument.tabulated`.
    Those of a power beam are lost: its field is the square root of the power, along the direction of the feed.
    Raises InputError if the file cannot be read, has feeds other than x and y, or lacks a part of the sky.
    """
    with warnings.catch_warnings():
        # Files of earlier versions lack metadata that pyuvdata now requires; those used here are checked below.
        warnings.simplefilter("ignore")
        try:
            beam = UVBeam.from_file(path, file_type="beamfits")
        # For a damaged file the reader raises the exceptions of its libraries.
        except (OSError, KeyError, ValueError, IndexError, TypeError, AttributeError, NotImplementedError) as error:
            raise InputError(f"instrument.beam.path: {path} cannot be read as beamfits ({error})") from error
    feeds = _feeds(beam)
    described = f"it contains a {beam.beam_type} beam of feeds {', '.join(feeds)} on {beam.pixel_coordinate_system}"
    usable = feeds in (["x", "y"], ["x"]) and beam.pixel_coordinate_system in ("az_za", "healpix")
    if not usable or (beam.pixel_coordinate_system == "az_za" and beam.axis2_array[0] != 0):
        raise InputError(
            f"instrument.beam.path: {path} must contain a beam of feeds x and y on a grid of azimuth and zenith angle "
            f"from the zenith, or on HEALPix; {described}"
        )
    angles = None if beam.feed_angle is None else dict(zip(beam.feed_array, beam.feed_angle, strict=True))
    if angles is not None and not np.isclose(abs(angles["x"]), np.pi / 2):
        raise InputError(f"instrument.beam.path: feed x of {path} is not east-west, which it must be")
    if beam.pixel_coordinate_system == "az_za":
        _require_whole_sky(beam, path)
    found = _on_grid(beam, feeds, path)
    _require_direction(found, path)
    return found


def _require_direction(beam: UVBeam, path: Path) -> None:
    """Raise InputError unless the field of each feed has one direction at the zenith, that of the feed."""
    fixed = fixed_components(beam.data_array[:, :, :, 0], beam.axis1_array)
    mean = np.abs(fixed.mean(axis=-1)) ** 2
    power, peak = (np.abs(fixed) ** 2).sum(axis=0).mean(axis=-1), (np.abs(beam.data_array) ** 2).sum(axis=0)
    if (mean.sum(axis=0) < LEAST_DIRECTED * np.maximum(power, LEAST_ZENITH * peak.max(axis=(-2, -1)))).any():
        raise InputError(
            f"instrument.beam.path: {path} has fields without a direction at the zenith, as Airy and Gaussian beams of "
            "pyuvdata, or none there; give vectors along azimuth and zenith angle, or the power (efield_to_power)"
        )
    feeds = range(mean.shape[1])
    if (mean[feeds, feeds] < mean.sum(axis=0) / 2).any():
        raise InputError(f"instrument.beam.path: feed x of {path} is not east-west at the zenith, which it must be")


def _require_whole_sky(beam: UVBeam, path: Path) -> None:
    """Raise InputError if a table does not reach the horizon, or all azimuths, to a step of its grid."""
    azimuth, zenith_angle = beam.axis1_array, beam.axis2_array
    steps = [np.diff(axis).max(initial=0.0) for axis in (azimuth, zenith_angle)]
    if zenith_angle[-1] < np.pi / 2 - 1.01 * steps[1] or np.ptp(azimuth) < 2 * np.pi - 1.01 * steps[0]:
        raise InputError(
            f"instrument.beam.path: {path} must have all azimuths and zenith angles up to 90 deg; it has "
            f"{np.degrees(np.ptp(azimuth)):.0f} deg of azimuth, and zenith angles up to "
            f"{np.degrees(zenith_angle[-1]):.0f} deg"
        )


def _feeds(beam: UVBeam) -> list[str]:
    if beam.beam_type == "efield":
        return list(beam.feed_array)
    return [feed for feed, number in POLARIZATIONS.items() if number in beam.polarization_array]


def _on_grid(beam: UVBeam, feeds: list[str], path: Path) -> UVBeam:
    """Return a beam as an E-field on a grid."""
    is_power = beam.beam_type == "power"
    if beam.pixel_coordinate_system == "healpix":
        per_degree = -(-beam.nside // DEGREE_NSIDE)
        azimuth = np.radians(np.arange(360 * per_degree) / per_degree)
        zenith_angle = np.radians(np.arange(90 * per_degree + 1) / per_degree)
        values = HealpixRings(beam, path).on_grid(_smooth_values(beam, feeds), azimuth, zenith_angle)
        jones = polar_components(_along_feeds(values) if is_power else values, azimuth)
    else:
        azimuth, columns = _around(beam.axis1_array)
        zenith_angle = beam.axis2_array
        values = (_powers(beam, feeds) if is_power else _components(beam))[..., columns]
        jones = polar_components(_along_feeds(values), azimuth) if is_power else values
    order = np.argsort(beam.freq_array)
    basis = np.zeros((2, 2, len(zenith_angle), len(azimuth)))
    basis[0, 0] = basis[1, 1] = 1.0
    description = {name: getattr(beam, name) for name in NAMES} | {
        "feed_array": feeds,
        "feed_angle": [np.pi / 2, 0.0][: len(feeds)],
        "axis1_array": azimuth,
        "axis2_array": zenith_angle,
        "basis_vector_array": basis,
    }
    return tabulate(description, jones[:, :, order], beam.freq_array[order], "physical")


def _smooth_values(beam: UVBeam, feeds: list[str]) -> np.ndarray:
    """Return power, (Nfeeds, ...), or fixed field components, (2, Nfeeds, ...), which are smooth at the zenith."""
    if beam.beam_type == "power":
        return _powers(beam, feeds).astype(complex)
    longitude = healpy.pix2ang(beam.nside, beam.pixel_array, nest=beam.ordering == "nested")[1]
    return fixed_components(_components(beam), longitude)


def _powers(beam: UVBeam, feeds: list[str]) -> np.ndarray:
    """Return the power of each feed, (Nfeeds, Nfreqs, ...)."""
    places = [list(beam.polarization_array).index(POLARIZATIONS[feed]) for feed in feeds]
    return beam.data_array[0, places].real


def _components(beam: UVBeam) -> np.ndarray:
    """Return a field's components along azimuth and zenith angle, (2, Nfeeds, Nfreqs, ...), of those along its axes."""
    return np.einsum("afn...,ac...->cfn...", beam.data_array, beam.basis_vector_array)


def _along_feeds(power: np.ndarray) -> np.ndarray:
    """Return the `fixed_components` of fields along feeds x and y, or x, with powers (Nfeeds, ...)."""
    fields = np.zeros((2, *power.shape), dtype=complex)
    feeds = range(len(power))
    fields[feeds, feeds] = np.sqrt(np.maximum(power.real, 0))
    return fields


def _around(azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths within [0, 2 pi), ascending and each one once, and their places among the given ones."""
    nearest = np.abs(np.diff(azimuth)).min() / 1000
    turned = azimuth % (2 * np.pi)
    turned[turned > 2 * np.pi - nearest] = 0.0
    places = np.argsort(turned, kind="stable")
    places = places[np.diff(turned[places], prepend=-1.0) > nearest]
    return turned[places], places


class HealpixRings:
    """The rings of a HEALPix beam above the horizon and a little below.

    The pixels of a ring are equally spaced, and give its Fourier coefficients in azimuth up to the order that their
    number allows. Splines in zenith angle join those of all rings, order by order. They continue beyond the zenith,
    where a coefficient of order m returns with the sign (-1)^m, and at which all but that of order 0 vanish. The
    azimuth, from east through north, is the longitude. Raises InputError if a pixel above the horizon is missing.
    """

    def __init__(self, beam: UVBeam, path: Path) -> None:
        nested = beam.ordering == "nested"
        numbers = healpy.nest2ring(beam.nside, beam.pixel_array) if nested else beam.pixel_array
        place = np.full(12 * beam.nside**2, -1)
        place[numbers] = np.arange(len(numbers))
        colatitude, longitude = healpy.pix2ang(beam.nside, np.arange(len(place)))
        first = np.flatnonzero(np.diff(colatitude, prepend=-1.0) > 1e-9)
        self._rings: list[tuple[np.ndarray, float]] = []
        angles: list[float] = []
        for start, stop in pairwise([*first, len(place)]):
            members, angle = place[start:stop], float(colatitude[start])
            if angle > np.pi / 2 + BELOW or (angle > np.pi / 2 and (members < 0).any()):
                break
            if (members < 0).any():
                raise InputError(f"instrument.beam.path: {path} does not have all pixels above the horizon")
            self._rings.append((members, float(longitude[start])))
            angles.append(angle)
        self._zenith_angles = np.array(angles)
        # Coefficients of a higher order are aliased with those of a lower one.
        self._resolved = np.array([(len(members) - 1) // 2 for members, _ in self._rings])

    def on_grid(self, values: np.ndarray, azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return values (..., Npixels), which are smooth at the zenith, on a grid, (..., Nza, Naz)."""
        highest = int(self._resolved.max())
        orders = np.arange(-highest, highest + 1)
        coefficients = np.zeros((len(self._rings), len(orders), *values.shape[:-1]), dtype=complex)
        for ring, (members, longitude) in enumerate(self._rings):
            modes = np.fft.fft(values[..., members], axis=-1) / len(members)
            inner = np.abs(orders) <= self._resolved[ring]
            shifted = modes[..., orders[inner]] * np.exp(-1j * orders[inner] * longitude)
            coefficients[ring, inner] = np.moveaxis(shifted, -1, 0)
        by_order = [
            self._along_zenith_angle(order, coefficients[:, place], zenith_angle)
            for place, order in enumerate(orders.tolist())
        ]
        # (Nza, ..., Norders) to (..., Nza, Naz).
        return np.moveaxis(np.stack(by_order, axis=-1) @ np.exp(1j * orders[:, None] * azimuth), 0, -2)

    def _along_zenith_angle(self, order: int, coefficients: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
        """Return the coefficients (Nrings, ...) of an order at other zenith angles, (Nza, ...)."""
        # Rings of too few pixels are left out where the coefficient may matter, and are zero closer to the zenith.
        used = (self._resolved >= abs(order)) | (self._resolved < abs(order) - UNRESOLVED)
        angles, sign = self._zenith_angles[used], (-1) ** abs(order)
        nodes, values = [-angles[::-1], angles], [sign * coefficients[used][::-1], coefficients[used]]
        if order != 0:
            nodes.insert(1, np.zeros(1))
            values.insert(1, np.zeros_like(coefficients[:1]))
        return make_interp_spline(np.concatenate(nodes), np.concatenate(values), k=SPLINE_DEGREE)(zenith_angle)


def fixed_components(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return a field's components along and across feed x (Ludwig's third definition), (2, ..., Ndirections).

    `polar` are its components along azimuth and zenith angle, (2, ..., Ndirections). The azimuth runs from east through
    north, rad, (Ndirections,).
    """
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    return np.stack([cosine * polar[1] - sine * polar[0], sine * polar[1] + cosine * polar[0]])


def polar_components(fixed: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return the components along azimuth and zenith angle of a field given by its `fixed_components`."""
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    return np.stack([cosine * fixed[1] - sine * fixed[0], cosine * fixed[0] + sine * fixed[1]])


def bspline_coefficients(count: int) -> np.ndarray:
    """Return the matrix from equally spaced samples to the coefficients of their cubic spline, (count + 2, count).

    The spline has no knots at the second and the last but one sample, and is in the basis of uniform cubic B-splines;
    coefficient i belongs to the B-spline centred on sample i - 1.
    """
    conditions = np.zeros((count + 2, count + 2))
    for sample in range(count):
        conditions[sample, sample : sample + 3] = 1 / 6, 4 / 6, 1 / 6
    # No jump of the third derivative at a sample: the fourth difference of the coefficients around it vanishes.
    conditions[count, :5] = conditions[count + 1, -5:] = 1, -4, 6, -4, 1
    return np.linalg.solve(conditions, np.eye(count + 2)[:, :count])


def cells(values: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first B-spline, (N,) int, and four weights, (N, 4), of each value, clamped to an equally spaced grid.

    B-splines are numbered as in `bspline_coefficients`.
    """
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
def spline_fields(
    table: np.ndarray,
    rows: np.ndarray,
    row_weights: np.ndarray,
    columns: np.ndarray,
    column_weights: np.ndarray,
    fields: np.ndarray,
) -> None:
    """Fill `fields` (Ndirections, Nvalues) from a table (Nrows + 2, Ncolumns + 2, Nvalues) of coefficients.

    `rows`, `columns` and their weights are from `cells`.
    """
    for source in range(len(fields)):
        field = fields[source]
        field[:] = 0.0
        for tap in range(4):
            taps = table[rows[source] + tap, columns[source] : columns[source] + 4]
            _add_row(field, taps, column_weights[source], row_weights[source, tap])
