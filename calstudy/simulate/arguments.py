"""Common arguments of matvis and fftvis."""

from __future__ import annotations

from typing import Any

import numpy as np
from astropy.coordinates import ICRS
from astropy.time import Time
from pyradiosky import SkyModel
from pyuvdata import BeamInterface, UVBeam, UVData
from pyuvdata.analytic_beam import AnalyticBeam

from calstudy.instrument.antenna_beams import split_beams
from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.simulate.directions import sky_coordinates
from calstudy.simulate.nodes import integration_times
from calstudy.visibilities import antenna_indices


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
    """Return the antennas of each baseline, (Nbls, 2), as `common_arguments` numbers them."""
    return _used(template)[1]


def beam_arguments(beam, template: UVData) -> tuple[list[UVBeam | BeamInterface], np.ndarray]:
    """Return the distinct beams at the template's frequencies, and which each numbered antenna has, (Nants,) int.

    Both libraries sum conj(J_ai) J_bj and name it the visibility of feeds j, i: the right one if antennas a and b have
    the same beam. The conjugates of the beams make it the visibility of feeds i, j for any beams, so the two axes of
    feeds must be exchanged in what the libraries return.
    """
    beams, index = split_beams(beam, template)
    return [_conjugated(item.at(template.freq_array)) for item in beams], index[_used(template)[0]]


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
