"""matvis: matrix products over antennas (Kittiwisit et al. 2025), for any geometry."""

from __future__ import annotations

from functools import partial

import numpy as np
from astropy.coordinates import ICRS
from astropy.time import Time
from matvis.wrapper import simulate_vis
from pyradiosky import SkyModel
from pyuvdata import BeamInterface, UVBeam, UVData

from calstudy.errors import InputError
from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.simulate.brightness import stokes_i
from calstudy.simulate.directions import sky_coordinates
from calstudy.simulate.feeds import refusal, select_polarizations
from calstudy.simulate.nodes import integration_times
from calstudy.visibilities import antenna_indices, require_rectangular

# matvis splits its sources so that a block takes about this much memory (bytes).
BLOCK_MEMORY = 500_000_000


class MatvisEngine:
    """matvis on the processor, both feeds, with beams interpolated as pyuvsim does.

    Parameters
    ----------
    precision
        Of all its arithmetic, fringe phases included: `single` agrees with pyuvsim to 1e-4 of the rms.
    """

    name = "matvis"

    def __init__(self, precision: str = "double"):
        self._precision = {"single": 1, "double": 2}[precision]

    def refusal(self, sky: SkyModel, beam, template: UVData) -> str | None:
        """Return why this engine cannot do what is asked, or None if it can."""
        return refusal(self.name, sky, beam, template)

    def simulate(self, sky: SkyModel, beam, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`.

        Raises
        ------
        InputError
            If the sky is polarized, a polarization is not linear, or the beam has not feeds x and y.
        """
        require_rectangular(template)
        reason = self.refusal(sky, beam, template)
        if reason:
            raise InputError(reason)
        coordinates = sky_coordinates(sky).transform_to(ICRS())
        telescope = template.telescope
        used, pairs = np.unique(antenna_indices(template), return_inverse=True)
        positions = telescope.get_enu_antpos()[used]
        use_bundled_earth_orientation()
        simulate_positive = partial(
            simulate_vis,
            ants=dict(enumerate(positions)),
            ra=coordinates.ra.rad,
            dec=coordinates.dec.rad,
            freqs=template.freq_array,
            times=Time(integration_times(template), format="jd", scale="utc", location=telescope.location),
            beams=[_as_splines(beam.at(template.freq_array))],
            telescope_loc=telescope.location,
            polarized=True,
            precision=self._precision,
            antpairs=pairs.reshape(-1, 2),
            max_memory=BLOCK_MEMORY,
        )
        flux = np.ascontiguousarray(stokes_i(sky, template.freq_array).T)
        # (Nfreqs, Ntimes, Nbls, feed, feed)
        visibilities = simulate_positive(fluxes=np.maximum(flux, 0))
        if flux.min() < 0:
            # matvis takes the square root of fluxes, and those of a 21 cm sky have both signs.
            visibilities -= simulate_positive(fluxes=np.maximum(-flux, 0))
        return select_polarizations(visibilities.transpose(1, 2, 0, 3, 4), template).astype(np.complex128)


class _SplineBeam(UVBeam):
    """A tabulated beam that is always interpolated by splines, whatever a caller asks for.

    matvis asks for `scipy.ndimage.map_coordinates`, which differs from pyuvsim's splines by 1e-5 of the rms.
    """

    def interp(self, **options) -> tuple | UVBeam:
        return super().interp(**{**options, "interpolation_function": "az_za_simple", "spline_opts": None})


def _as_splines(beam) -> UVBeam | BeamInterface:
    if not isinstance(beam, UVBeam):
        return BeamInterface(beam, beam_type="efield")
    splines = _SplineBeam()
    for parameter in beam:
        setattr(splines, parameter, getattr(beam, parameter))
    return splines
