"""The metadata of an observation: a UVData with antennas, baselines, times, channels and polarizations, no data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astropy import units
from astropy.coordinates import EarthLocation
from pyuvdata import Telescope, UVData
from pyuvdata import utils as uvutils

from calstudy.base.constants import SECONDS_PER_DAY, SIDEREAL_DAY
from calstudy.base.visibilities import keep_compiled_pyuvdata, new_observation, use_bundled_earth_orientation
from calstudy.instrument.as_built import position_offsets
from calstudy.instrument.layouts import Layout, make_array
from calstudy.instrument.settings import InstrumentSettings

# Noon UTC of 2016 November 15; the observation starts within the sidereal day after it, wherever the array is. At the
# MWA the field of the paper (LST 1.8 h) is then up at night, and the Earth's orientation is known, not predicted.
REFERENCE_JD = 2457708.0
POLARIZATION_NUMBERS = {"xx": -5, "yy": -6}


def make_template(settings: InstrumentSettings, autos: bool = False, as_built: bool = False) -> UVData:
    """Return the metadata of the simulated observation, without data, flag and nsample arrays.

    Baselines are (a, b) with a before b in the layout, ordered by a and then b, all of them at every time, time by
    time. The telescope drifts (unprojected phase centre); feed x is the east-west dipole, feed y the north-south one.
    Fluxes are in Jy with the convention V_xx = ½∫A I, i.e. I = XX + YY. With `as_built` the antennas have the positions
    of `instrument.as_built`, otherwise the nominal ones. Raises InputError if the layout's file cannot be used.
    """
    keep_compiled_pyuvdata()
    layout = make_array(settings)
    if as_built:
        offsets = position_offsets(settings.as_built.positions, len(layout.numbers))
        layout = replace(layout, enu=layout.enu + offsets)
    first, second = np.triu_indices(len(layout.numbers), 0 if autos else 1)
    times, channels = settings.times, settings.channels
    start = time_of_lst(times.start_lst, layout.location)
    return new_observation(
        _telescope(layout),
        np.column_stack([layout.numbers[first], layout.numbers[second]]),
        times=start + np.arange(times.count) * times.integration / SECONDS_PER_DAY,
        frequencies=channels.frequencies,
        resolution=(times.integration, channels.width),
        polarizations=np.array([POLARIZATION_NUMBERS[polarization] for polarization in settings.polarizations]),
    )


def time_of_lst(lst_hours: float, location: EarthLocation) -> float:
    """Return the first Julian date after `REFERENCE_JD` at which the apparent sidereal time is `lst_hours`."""
    use_bundled_earth_orientation()
    target = lst_hours * np.pi / 12
    jd = REFERENCE_JD
    ahead = (target - _lst(jd, location)) % (2 * np.pi)
    # Nutation makes sidereal time run slightly unevenly: two more rounds bring the error below the JD's own 40 us.
    for _ in range(3):
        jd += ahead / (2 * np.pi) * SIDEREAL_DAY
        ahead = (target - _lst(jd, location) + np.pi) % (2 * np.pi) - np.pi
    return jd


def _lst(jd: float, location: EarthLocation) -> float:
    return float(uvutils.get_lst_for_time(np.array([jd]), telescope_loc=location)[0])


def _telescope(layout: Layout) -> Telescope:
    centre = np.array([axis.to_value(units.m) for axis in layout.location.geocentric])
    return Telescope.new(
        # Not "MWA": pyuvdata adds the metadata of that name, and looks up some of it online.
        name=f"calstudy {layout.name}",
        instrument="calstudy",
        location=layout.location,
        antenna_positions=uvutils.ECEF_from_ENU(layout.enu, center_loc=layout.location) - centre,
        antenna_names=list(layout.names),
        antenna_numbers=layout.numbers,
        feed_array=["x", "y"],
        feed_angle=[np.pi / 2, 0.0],
        mount_type="fixed",
        update_from_known=False,
    )
