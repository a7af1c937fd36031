"""Arrays with different beams on different antennas.

Beams may differ by design, or because antennas are tilted, rotated, wider or narrower, or have their feeds exchanged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from pyuvdata import UVBeam, UVData
from pyuvdata.analytic_beam import AnalyticBeam
from scipy.ndimage import spline_filter1d
from scipy.spatial.transform import Rotation

from calstudy.base.errors import InputError
from calstudy.base.plugins import guarded
from calstudy.instrument.as_built import Misalignment
from calstudy.instrument.beam_grid import (
    bspline_coefficients,
    cells,
    describe,
    fixed_components,
    polar_components,
    spline_fields,
    tabulate,
)
from calstudy.instrument.beams import make_beam
from calstudy.instrument.interface import AntennaBeam, AntennaBeams, Beam, model_of
from calstudy.instrument.settings import AssignedBeam, InstrumentSettings, assigned_beams, nominal_beams


def make_beams(settings: InstrumentSettings, n_antennas: int) -> AntennaBeam | AntennaBeams:
    """Return the beam of all antennas, or the beams of an array that has several.

    Antennas whose beams as built are equal share one. Raises InputError if a beam file is missing, cannot be read, or
    does not cover the channels, or the beam cannot have the errors of `instrument.as_built`.
    """
    assigned = assigned_beams(settings, n_antennas)
    # Antennas with `instrument.beam` first.
    distinct = list(dict.fromkeys(sorted(assigned, key=lambda beam: beam.model > 0)))
    beams = tuple(_make(distinct, settings))
    index = np.array([distinct.index(beam) for beam in assigned])
    return AntennaBeams(beams, index) if len(beams) > 1 else beams[0]


def _make(distinct: list[AssignedBeam], settings: InstrumentSettings) -> list[AntennaBeam]:
    models = nominal_beams(settings)
    made: dict[tuple, Beam] = {}
    for model in dict.fromkeys(beam.model for beam in distinct):
        section, members = models[model], dict.fromkeys(beam.amplitudes for beam in distinct if beam.model == model)
        if None in members:
            made[model, None] = make_beam(section, settings.channels)
        if tiles := [amplitudes for amplitudes in members if amplitudes is not None]:
            with guarded(section):
                tile_beams = model_of(section).make_tiles(settings.channels, np.array(tiles))
            made |= {(model, amplitudes): beam for amplitudes, beam in zip(tiles, tile_beams, strict=True)}
    nominal = Misalignment()
    found = [((beam.model, beam.amplitudes), beam.misalignment) for beam in distinct]
    counts = Counter(key for key, error in found if error != nominal)
    # The splines of the frequencies that were requested last are worth their memory if several antennas have the beam.
    shared = {key: lru_cache(maxsize=1)(partial(_splined, made[key])) for key, count in counts.items() if count > 1}
    return [
        made[key] if error == nominal else MisalignedBeam(made[key], error, shared.get(key)) for key, error in found
    ]


def split_beams(beam: AntennaBeam | AntennaBeams, template: UVData) -> tuple[tuple[AntennaBeam, ...], np.ndarray]:
    """Return the distinct beams of an array, and the index of the beam of each antenna, (Nants,) int."""
    if isinstance(beam, AntennaBeams):
        return beam.beams, beam.index
    return (beam,), np.zeros(template.telescope.Nants, dtype=int)


# Rows by which a table is extended beyond the zenith; the end of a spline affects only a few.
MARGIN = 12


Splined = tuple[UVBeam | AnalyticBeam, np.ndarray]


def _splined(beam: AntennaBeam, frequencies: tuple[float, ...]) -> Splined:
    """Return an E-field beam, and the coefficients of `_spline_table`, which are empty for a beam in closed form."""
    found = beam.at(np.array(frequencies))
    return found, _splines_of(found) if isinstance(found, UVBeam) else np.empty(0)


class MisalignedBeam:
    """The beam of an antenna whose orientation, width or feeds are not as designed (`AntennaBeam`).

    Its pattern moves with the antenna, and so does its polarization. It is one on the antenna's own axis, as the
    nominal beam is at the zenith. `splined` gives the nominal beam at frequencies, and its splines.
    """

    def __init__(
        self,
        beam: AntennaBeam,
        misalignment: Misalignment,
        splined: Callable[[tuple[float, ...]], Splined] | None = None,
    ) -> None:
        self.name, self.stand_in = beam.name, beam.stand_in
        self._splined, self._misalignment = splined or partial(_splined, beam), misalignment

    def at(self, frequencies: np.ndarray) -> UVBeam | AnalyticBeam:
        """Return the E-field beam at `frequencies` (Hz, (Nfreqs,)).

        Raises InputError if feeds are exchanged and there is only one, or a table does not cover all azimuths.
        """
        beam, splines = self._splined(tuple(frequencies))
        if self._misalignment.swapped and list(beam.feed_array) != ["x", "y"]:
            raise InputError(f"instrument.as_built.beams.swapped: the beam {self.name} does not have feeds x and y")
        if isinstance(beam, UVBeam):
            return tabulate(describe(beam), _turned_table(beam, splines, self._misalignment), frequencies)
        # A formula may have its own settings for its feeds, which are those of the nominal beam.
        return TurnedBeam(
            nominal=beam, misalignment=self._misalignment, feed_array=beam.feed_array, feed_angle=beam.feed_angle
        )


@dataclass(kw_only=True, eq=False)
class TurnedBeam(AnalyticBeam):
    """A beam in closed form, evaluated in the frame of a misaligned antenna."""

    nominal: AnalyticBeam
    misalignment: Misalignment

    basis_vector_type = "az_za"

    def _efield_eval(self, *, az_grid: np.ndarray, za_grid: np.ndarray, f_grid: np.ndarray) -> np.ndarray:
        """Return Jones components (azimuth, zenith angle) x feeds at directions and frequencies."""
        # The same directions at all frequencies.
        frame = AntennaFrame(self.misalignment, az_grid[0], za_grid[0])
        jones = self.nominal.efield_eval(
            az_array=frame.azimuth, za_array=frame.nominal_zenith_angle, freq_array=f_grid[:, 0]
        )
        jones = frame.to_ground(jones)
        return jones[:, ::-1] if self.misalignment.swapped else jones


class AntennaFrame:
    """Directions (Ndirections,) in the frame of a misaligned antenna.

    All angles are in rad; azimuths run from east through north. `nominal_zenith_angle` is the one at which the nominal
    beam has the value of this one. It is at most pi / 2: below the antenna's own horizon the beam has the value there.
    """

    def __init__(self, misalignment: Misalignment, azimuth: np.ndarray, zenith_angle: np.ndarray) -> None:
        tilt = Rotation.from_rotvec([-misalignment.north, misalignment.east, 0.0])
        self._turn = tilt * Rotation.from_rotvec([0.0, 0.0, misalignment.rotation])
        self._ground = _basis(azimuth, zenith_angle)
        east, north, up = self._turn.apply(_direction(azimuth, zenith_angle), inverse=True).T
        self.azimuth = np.arctan2(north, east) % (2 * np.pi)
        self._zenith_angle = np.arctan2(np.hypot(east, north), up)
        self.nominal_zenith_angle = np.minimum(self._zenith_angle / misalignment.width, np.pi / 2)

    def to_ground(self, jones: np.ndarray) -> np.ndarray:
        """Convert azimuth and zenith angle components of the antenna, (2, ..., Ndirections), to those of the ground."""
        own = [self._turn.apply(vector) for vector in _basis(self.azimuth, self._zenith_angle)]
        overlaps = [[(ground * vector).sum(axis=1) for vector in own] for ground in self._ground]
        return np.stack([first * jones[0] + second * jones[1] for first, second in overlaps])


def _direction(azimuth: np.ndarray, zenith_angle: np.ndarray) -> np.ndarray:
    """Return unit vectors in east, north, up, (N, 3)."""
    sine = np.sin(zenith_angle)
    return np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith_angle)])


def _basis(azimuth: np.ndarray, zenith_angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors of increasing azimuth and of increasing zenith angle, (N, 3) each."""
    cosine, zeros = np.cos(zenith_angle), np.zeros_like(azimuth)
    along_azimuth = np.column_stack([-np.sin(azimuth), np.cos(azimuth), zeros])
    along_zenith_angle = np.column_stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), -np.sin(zenith_angle)])
    return along_azimuth, along_zenith_angle


def _splines_of(beam: UVBeam) -> np.ndarray:
    """Return the coefficients (`_spline_table`) of the components of a table along two fixed directions."""
    azimuth, zenith_angle = beam.axis1_array, beam.axis2_array
    around = np.isclose(len(azimuth) * (azimuth[1] - azimuth[0]), 2 * np.pi) and len(azimuth) % 2 == 0
    if not around or zenith_angle[0] != 0:
        raise InputError("instrument.as_built.beams: the table of the beam must go all around, from the zenith")
    # Components in azimuth and zenith angle are discontinuous at the zenith; those along fixed directions are smooth.
    return _spline_table(fixed_components(beam.data_array, azimuth))


def _turned_table(beam: UVBeam, splines: np.ndarray, misalignment: Misalignment) -> np.ndarray:
    """Return J of a misaligned antenna on the grid of the nominal one, (2, Nfeeds, Nfreqs, Nza, Naz)."""
    azimuth, zenith_angle = beam.axis1_array, beam.axis2_array
    step = azimuth[1] - azimuth[0]
    frame = AntennaFrame(misalignment, *(axis.ravel() for axis in np.meshgrid(azimuth, zenith_angle)))
    rows = cells(frame.nominal_zenith_angle, np.concatenate([-zenith_angle[MARGIN:0:-1], zenith_angle]))
    columns = cells((frame.azimuth - azimuth[0]) % (2 * np.pi), step * np.arange(len(azimuth) + 1))
    values = np.empty((len(frame.azimuth), splines.shape[2]))
    spline_fields(splines, *rows, *columns, values)
    shape = (len(frame.azimuth), *beam.data_array.shape[:3])
    fixed = np.moveaxis(values.view(np.complex128).reshape(shape), 0, -1)
    jones = frame.to_ground(polar_components(fixed, frame.azimuth)).reshape(beam.data_array.shape)
    return jones[:, ::-1] if misalignment.swapped else jones


def _spline_table(values: np.ndarray) -> np.ndarray:
    """Return the coefficients of splines, (MARGIN + Nza + 2, Naz + 3, Nvalues) float, of values (..., Nza, Naz).

    Rows continue on the other side of the zenith, so that the splines do not end there. Columns are periodic.
    """
    n_columns = values.shape[-1]
    beyond = np.roll(values, n_columns // 2, axis=-1)[..., MARGIN:0:-1, :]
    extended = np.concatenate([beyond, values], axis=-2)
    flat = np.ascontiguousarray(np.moveaxis(extended.reshape(-1, *extended.shape[-2:]), 0, -1)).view(np.float64)
    along_rows = np.tensordot(bspline_coefficients(len(flat)), flat, axes=1)
    coefficients = spline_filter1d(along_rows, order=3, axis=1, mode="grid-wrap")
    return np.take(coefficients, np.arange(-1, n_columns + 2) % n_columns, axis=1)
