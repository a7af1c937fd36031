"""The toy array as UVData, and what is read of a calibration of it."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import EarthLocation
from pyuvdata import Telescope, UVData
from pyuvdata.utils import ECEF_from_ENU
from toy import FREQUENCIES

from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.settings import BasisSettings, FlagWeights

SETTINGS = Calamity(basis=BasisSettings(min_delay="50 ns", buffer="50 ns"))
# Weights that need no second pass.
ONE_SOLVE = SETTINGS.model_copy(update={"weights": FlagWeights()})
SITE = EarthLocation.from_geodetic(116.67, -26.7, 377.8)


def make_uvdata(toy, n_times=3, polarizations=(-5,), skip=2):
    """Wrap a toy as UVData with antenna numbers that are not their indices; times differ by a little noise."""
    numbers = 10 + 2 * np.arange(len(toy.positions))
    ecef = ECEF_from_ENU(toy.positions, center_loc=SITE) - np.array([axis.to_value("m") for axis in SITE.geocentric])
    telescope = Telescope.new(
        name="toy",
        location=SITE,
        antenna_positions=ecef,
        antenna_numbers=numbers,
        antenna_names=[f"ant{number}" for number in numbers],
        instrument="toy",
        feed_array=["x", "y"],
        feed_angle=[np.pi / 2, 0.0],
        mount_type="fixed",
        update_from_known=False,
    )
    uvd = UVData.new(
        freq_array=FREQUENCIES,
        polarization_array=np.array(polarizations),
        times=2459000.5 + np.arange(n_times) * 2 / 86400,
        antpairs=numbers[toy.antennas],
        do_blt_outer=True,
        time_axis_faster_than_bls=False,
        integration_time=2.0,
        channel_width=float(np.diff(FREQUENCIES)[0]),
        telescope=telescope,
        vis_units="Jy",
        pol_convention="sum",
        update_telescope_from_known=False,
    )
    rng = np.random.default_rng(12)
    cube = np.repeat(toy.visibilities[None, :, :, None], n_times, 0).repeat(len(polarizations), 3)
    cube = cube * (1 + 1e-4 * rng.standard_normal((n_times, 1, 1, len(polarizations))))
    uvd = from_cube(uvd, cube)
    uvd.flag_array[:] = False
    uvd.nsample_array[:] = 1
    return uvd


def sky_of(uvd, foregrounds):
    """A sky model with the samples of the data."""
    return from_cube(uvd, np.broadcast_to(foregrounds[None, :, :, None], to_cube(uvd).shape))


def errors(result, toy, integration=0, polarization=0):
    """Difference of the gains from the truth, phases aligned, NaN where they are flagged, (Nants, Nfreqs)."""
    rows = np.isin(result.gains.ant_array, 10 + 2 * np.arange(len(toy.positions)))
    gains = result.gains.gain_array[rows, :, integration, polarization]
    flags = result.gains.flag_array[rows, :, integration, polarization]
    aligned = fix_phase(np.where(flags, 0, gains), np.where(flags, 0, toy.gains))
    return np.where(flags, np.nan, aligned - toy.gains)


def statuses(result):
    return [record.status for record in result.solutions]
