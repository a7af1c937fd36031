"""Arguments that matvis and fftvis share, and the order of polarizations in the feed matrices that they return."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from astropy.coordinates import ICRS
from astropy.time import Time
from pyradiosky import SkyModel
from pyuvdata import BeamInterface, UVBeam, UVData
from pyuvdata.analytic_beam import AnalyticBeam

from calstudy.base.visibilities import antenna_indices
from calstudy.instrument.antenna_beams import AntennaBeams, split_beams
from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.simulate.brightness import is_polarized
from calstudy.simulate.directions import sky_coordinates
from calstudy.simulate.interface import BeamSource
from calstudy.simulate.nodes import integration_times

# Row and column of each polarization number in a matrix of feeds x and y.
FEED_PAIRS = {-5: (0, 0), -6: (1, 1), -7: (0, 1), -8: (1, 0)}
OPTIONAL = ("matvis", "fftvis")
"""Engines whose packages are not dependencies of calstudy; the extra `engines` installs them."""


def missing_package(engine: str) -> str | None:
    """Return a message if the package of this engine is not installed, or None."""
    if engine in OPTIONAL and find_spec(engine) is None:
        return f"needs the package {engine}, which is not installed: pip install 'calstudy[engines]'"
    return None


def refusal(engine: str, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
    """Return the reason why matvis or fftvis does not support a simulation, or None if it does."""
    if (missing := missing_package(engine)) is not None:
        return missing
    if is_polarized(sky):
        return f"the {engine} engine supports unpolarized skies only"
    unknown = [int(number) for number in template.polarization_array if int(number) not in FEED_PAIRS]
    if unknown:
        return f"polarization number {unknown[0]} is not linear"
    beams, _ = split_beams(beam, template)
    if any(list(item.at(template.freq_array[:1]).feed_array) != ["x", "y"] for item in beams):
        return f"{engine} needs beams with feeds x and y"
    return None


def common_arguments(sky: SkyModel, template: UVData) -> dict[str, Any]:
    """Return the keyword arguments of `simulate_vis` for source positions, times, frequencies and antennas.

    Antennas without baselines are left out, and the others are numbered from 0 in the telescope's order; see
    `baseline_pairs`.
    """
    use_bundled_earth_orientation()
    coordinates = sky_coordinates(sky).transform_to(ICRS())
    telescope = template.telescope
    positions = telescope.get_enu_antpos()[_used(template)[0]]
    return {
        "ants": dict(enumerate(positions)),
        "ra": coordinates.ra.rad,
        "dec": coordinates.dec.rad,
        "freqs": template.freq_array,
        "times": Time(integration_times(template), format="jd", scale="utc", location=telescope.location),
        "telescope_loc": telescope.location,
        "polarized": True,
    }


def baseline_pairs(template: UVData) -> np.ndarray:
    """Return the antennas of each baseline, (Nbls, 2), in the numbering of `common_arguments`."""
    return _used(template)[1]


def beam_arguments(
    beam: BeamSource | AntennaBeams, template: UVData
) -> tuple[list[UVBeam | BeamInterface], np.ndarray]:
    """Return the distinct beams at the template's frequencies, and the index of the beam of each antenna, (Nants,) int.

    Both libraries sum conj(J_ai) J_bj and call it the visibility of feeds j, i. That is correct only if antennas a and
    b have the same beam. With conjugated beams the sum is the visibility of feeds i, j for any beams, so the two feed
    axes of the result must be exchanged.
    """
    beams, index = split_beams(beam, template)
    return [_conjugated(item.at(template.freq_array)) for item in beams], index[_used(template)[0]]


def as_splines(beam: UVBeam | BeamInterface) -> UVBeam | BeamInterface:
    """Return the beam; a tabulated one is always interpolated by splines, whichever method a caller requests.

    matvis requests `scipy.ndimage.map_coordinates`, which differs from pyuvsim's splines by 1e-5 of the rms.
    """
    if not isinstance(beam, UVBeam):
        return beam
    splines = _SplineBeam()
    for parameter in beam:
        setattr(splines, parameter, getattr(beam, parameter))
    return splines


class _SplineBeam(UVBeam):
    def interp(self, **options: Any) -> tuple | UVBeam:
        return super().interp(**{**options, "interpolation_function": "az_za_simple", "spline_opts": None})


def select_polarizations(matrices: np.ndarray, template: UVData) -> np.ndarray:
    """Return the template's polarizations, (..., Npols), from feed matrices, (..., 2, 2)."""
    rows, columns = np.array([FEED_PAIRS[int(number)] for number in template.polarization_array]).T
    return matrices[..., rows, columns]


def _conjugated(beam: UVBeam | AnalyticBeam) -> UVBeam | BeamInterface:
    if not isinstance(beam, UVBeam):
        # Beams in closed form are real.
        return BeamInterface(beam, beam_type="efield")
    conjugated = beam.copy()
    conjugated.data_array = beam.data_array.conj()
    return conjugated


def _used(template: UVData) -> tuple[np.ndarray, np.ndarray]:
    used, pairs = np.unique(antenna_indices(template), return_inverse=True)
    return used, pairs.reshape(-1, 2)
