"""Primary beams: E-field beams for the simulators, and the solid angles that power spectra need.

Throughout, A(θ, φ) = |J_az|² + |J_za|² of a feed is the power beam, one at the zenith (where all beams here peak);
a visibility is V_xx = ½ ∫ A I exp(2πi ν b·s/c) dΩ with b = x_b − x_a for baseline (a, b).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pyuvdata import UVBeam
from pyuvdata.analytic_beam import AnalyticBeam, UnpolarizedAnalyticBeam
from scipy.integrate import quad_vec
from scipy.interpolate import CubicSpline

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.plugins import Plugin, guarded
from calstudy.instrument.beam_grid import polar_components
from calstudy.instrument.interface import Beam, model_of
from calstudy.instrument.settings import Channels
from calstudy.instrument.tabulated import TabulatedBeam

FEEDS = {"xx": 0, "yy": 1}
ZENITH_ANGLES = np.linspace(0, np.pi / 2, 361)
AZIMUTHS = np.linspace(0, 2 * np.pi, 180, endpoint=False)
HALVED = np.pi / 2 / 2 ** np.arange(1, 21)
"""Zenith angles, rad, between which adaptive quadrature begins: no beam in closed form is narrower than the last."""
RESOLVED = 1e-4
"""Relative difference of solid angles on `ZENITH_ANGLES` and on every second of them, below which they are right."""
CHANNELS_AT_A_TIME = 16

TILE_DIPOLES = 4
TILE_SPACING = 1.1
# Height of the bow-tie's centre above its image plane.
TILE_HEIGHT = 0.278


class MwaTile(AnalyticBeam):
    """An ideal 4 x 4 MWA tile pointed at zenith.

    Short dipoles, east-west and north-south, are 1.1 m apart and 0.278 m above an infinite conducting ground screen,
    without mutual coupling. The beam is chromatic, and one at zenith.
    """

    basis_vector_type = "az_za"

    def _efield_eval(self, *, az_grid: np.ndarray, za_grid: np.ndarray, f_grid: np.ndarray) -> np.ndarray:
        """Return Jones components (azimuth, zenith angle) x feeds at directions and frequencies."""
        wavenumber = 2 * np.pi * f_grid / SPEED_OF_LIGHT
        east = np.sin(za_grid) * np.cos(az_grid)
        north = np.sin(za_grid) * np.sin(az_grid)
        screen = np.sin(wavenumber * TILE_HEIGHT * np.cos(za_grid)) / np.sin(wavenumber * TILE_HEIGHT)
        gain = screen * _row_factor(wavenumber * east) * _row_factor(wavenumber * north)
        jones = self._get_empty_data_array(az_grid.shape)
        jones[0, self.east_ind] = -np.sin(az_grid) * gain
        jones[0, self.north_ind] = np.cos(az_grid) * gain
        jones[1, self.east_ind] = np.cos(za_grid) * np.cos(az_grid) * gain
        jones[1, self.north_ind] = np.cos(za_grid) * np.sin(az_grid) * gain
        return jones


def _row_factor(wavenumber: np.ndarray) -> np.ndarray:
    """Return the array factor of one row of dipoles for a wavenumber along it, one at zenith."""
    offsets = TILE_SPACING * (np.arange(TILE_DIPOLES) - (TILE_DIPOLES - 1) / 2)
    return sum(np.cos(wavenumber * offset) for offset in offsets) / TILE_DIPOLES


@dataclass(kw_only=True, eq=False)
class FeedBeam(AnalyticBeam):
    """A formula without polarization, with its field along the feeds (Ludwig's third definition)."""

    formula: UnpolarizedAnalyticBeam

    basis_vector_type = "az_za"

    def _efield_eval(self, *, az_grid: np.ndarray, za_grid: np.ndarray, f_grid: np.ndarray) -> np.ndarray:
        """Return Jones components (azimuth, zenith angle) x feeds at directions and frequencies."""
        # pyuvdata has half of the power in each component. The same directions at all frequencies.
        jones = self.formula.efield_eval(az_array=az_grid[0], za_array=za_grid[0], freq_array=f_grid[:, 0])
        values, angles = jones.sum(axis=0) / np.sqrt(2), np.asarray(self.feed_angle)[:, None, None]
        return polar_components(np.stack([np.sin(angles) * values, np.cos(angles) * values]), az_grid)


class ExactBeam:
    """An analytic beam, evaluated at the requested directions and frequencies (`Beam`).

    The field of a beam without polarization is taken to be along the feed.
    """

    def __init__(self, analytic: AnalyticBeam, name: str, stand_in: str | None) -> None:
        self.name, self.stand_in, self._analytic = name, stand_in, analytic
        if isinstance(analytic, UnpolarizedAnalyticBeam):
            self._analytic = FeedBeam(formula=analytic, feed_array=analytic.feed_array, feed_angle=analytic.feed_angle)
        self._angles: dict[tuple[int, bytes], np.ndarray] = {}

    def at(self, frequencies: np.ndarray) -> AnalyticBeam:
        """Return the analytic E-field beam, which is valid at any frequency (Hz)."""
        return self._analytic

    def solid_angles(self, frequencies: np.ndarray, polarization: str) -> tuple[np.ndarray, np.ndarray]:
        """Return Ω_p and Ω_pp in sr, (Nfreqs,) each; see `Beam`."""
        wanted = np.asarray(frequencies, dtype=float)
        key = FEEDS[polarization], wanted.tobytes()
        if key not in self._angles:
            self._angles[key] = self._solid_angles(wanted, key[0])
        first, second = self._angles[key].copy()
        return first, second

    def _solid_angles(self, frequencies: np.ndarray, feed: int) -> np.ndarray:
        """Return Ω_p and Ω_pp, (2, Nfreqs), from a grid if it resolves the beam at all frequencies."""
        angles = []
        for frequency in frequencies:
            power = self._power(ZENITH_ANGLES, np.array([frequency]), feed)[0]
            found, coarse = (integrate_power(power[::n], ZENITH_ANGLES[::n]) for n in (1, 2))
            # Also false for a beam so narrow that both are zero.
            if not (np.abs(found - coarse) < RESOLVED * found).all():
                return self._adaptive_solid_angles(frequencies, feed)
            angles.append(found)
        return np.array(angles).T

    def _adaptive_solid_angles(self, frequencies: np.ndarray, feed: int) -> np.ndarray:
        """Return Ω_p and Ω_pp, (2, Nfreqs), by adaptive quadrature in zenith angle."""
        # Solid angles of an aperture scale so: the tolerance is for the largest of all values.
        scale = frequencies**-2 / frequencies[0] ** -2

        def ring(zenith_angle: float) -> np.ndarray:
            power = self._power(np.array([zenith_angle]), frequencies, feed)[:, 0]
            means = np.array([power.mean(axis=1), (power**2).mean(axis=1)])
            return 2 * np.pi * np.sin(zenith_angle) * means / scale

        found, *_ = quad_vec(ring, 0, np.pi / 2, epsabs=0, epsrel=RESOLVED / 10, norm="max", points=HALVED)
        return scale * found

    def _power(self, zenith_angles: np.ndarray, frequencies: np.ndarray, feed: int) -> np.ndarray:
        """Return |J|² of a feed on the rings of some zenith angles, (Nfreqs, Nza, Naz)."""
        azimuth, zenith_angle = (grid.ravel() for grid in np.meshgrid(AZIMUTHS, zenith_angles))
        jones = self._analytic.efield_eval(az_array=azimuth, za_array=zenith_angle, freq_array=frequencies)
        power = (np.abs(jones[:, feed]) ** 2).sum(axis=0)
        return power.reshape(len(frequencies), len(zenith_angles), len(AZIMUTHS))


class GriddedBeam:
    """A beam tabulated on a grid of directions and frequencies (`Beam`)."""

    def __init__(self, table: TabulatedBeam, name: str, stand_in: str | None) -> None:
        self.table, self.name, self.stand_in = table, name, stand_in

    def at(self, frequencies: np.ndarray) -> UVBeam:
        """Return the E-field beam tabulated at `frequencies` (Hz); raises InputError for any outside its band."""
        return self.table.at(frequencies)

    def solid_angles(self, frequencies: np.ndarray, polarization: str) -> tuple[np.ndarray, np.ndarray]:
        """Return Ω_p and Ω_pp in sr, (Nfreqs,) each; see `Beam`."""
        first, second = _solid_angles(self.table, tuple(np.asarray(frequencies, dtype=float)), FEEDS[polarization])
        return first.copy(), second.copy()


# The spectra of one run are made one after the other, and have the same beam.
@lru_cache(maxsize=4)
def _solid_angles(table: TabulatedBeam, frequencies: tuple[float, ...], feed: int) -> tuple[np.ndarray, np.ndarray]:
    angles = []
    for start in range(0, len(frequencies), CHANNELS_AT_A_TIME):
        jones = table.jones(np.array(frequencies[start : start + CHANNELS_AT_A_TIME]))[:, feed]
        angles.append(integrate_power((np.abs(jones) ** 2).sum(axis=0), table.zenith_angles))
    first, second = np.concatenate(angles, axis=1)
    return first, second


def integrate_power(power: np.ndarray, zenith_angles: np.ndarray) -> np.ndarray:
    """Return ∫A dΩ and ∫A² dΩ above the horizon, in sr, (2, ...).

    A, (..., Nza, Naz), is at zenith angles, (Nza,), rad, increasing from 0, and equally spaced azimuths.
    """
    horizon = min(np.pi / 2, zenith_angles[-1])
    rings = [2 * np.pi * np.sin(zenith_angles) * values.mean(axis=-1) for values in (power, power**2)]
    return np.array(CubicSpline(zenith_angles, rings, axis=-1).integrate(0, horizon))


def make_beam(settings: Plugin, channels: Channels | None = None) -> Beam:
    """Return the beam of the `instrument.beam` section, by default for the channels of the paper.

    Raises InputError if a beam file is missing, cannot be read, or does not cover the channels, or if a plug-in makes
    something else.
    """
    channels = Channels() if channels is None else channels
    with guarded(settings):
        beam = model_of(settings).make(channels)
    missing = [name for name in ("name", "stand_in", "at", "solid_angles") if not hasattr(beam, name)]
    if missing:
        hint = "; wrap it in calstudy.instrument.beams.ExactBeam" if isinstance(beam, AnalyticBeam) else ""
        raise InputError(
            f"instrument.beam = {settings.label!r}: make returned {type(beam).__name__}, which is no beam: it has no "
            f"{missing[0]!r}{hint}"
        )
    if not isinstance(beam, ExactBeam):
        return beam
    # All spectra of a run have the same beam, whose solid angles take longer than a small spectrum.
    return _EXACT_BEAMS.setdefault(digest_json([identity(settings), identity(channels)]), beam)


_EXACT_BEAMS: dict[str, ExactBeam] = {}
