"""fftvis: non-uniform fast Fourier transforms (Cox et al. 2025); polarized skies, fast for flat and regular arrays."""

from __future__ import annotations

import numpy as np
from astropy.coordinates import ICRS
from astropy.time import Time
from fftvis.wrapper import simulate_vis
from pyradiosky import SkyModel
from pyuvdata import BeamInterface, UVBeam, UVData

from calstudy.errors import InputError
from calstudy.instrument.telescope import use_bundled_earth_orientation
from calstudy.simulate.brightness import stokes_i
from calstudy.simulate.directions import sky_coordinates
from calstudy.simulate.feeds import refusal, select_polarizations
from calstudy.simulate.nodes import integration_times
from calstudy.visibilities import antenna_pairs, require_rectangular

# fftvis treats an array flatter than this (m) as flat: at 200 MHz, a phase of 4e-12.
FLATNESS = 1e-12


class FftvisEngine:
    """fftvis with both feeds, and beams interpolated as pyuvsim does.

    Parameters
    ----------
    precision
        Accuracy of the transforms: `double` 1e-12, `single` 1e-6. The arithmetic is double in both, for fftvis' single
        precision rounds frequencies to 16 Hz, 4e-5 rad for a 176 m baseline.
    """

    name = "fftvis"

    def __init__(self, precision: str = "double"):
        self._accuracy = {"double": 1e-12, "single": 1e-6}[precision]

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
        positions = dict(zip(telescope.antenna_numbers.tolist(), telescope.get_enu_antpos(), strict=True))
        pairs = antenna_pairs(template).tolist()
        used = sorted({number for pair in pairs for number in pair})
        tabulated = beam.at(template.freq_array)
        use_bundled_earth_orientation()
        # One process and thread, for the caller shares out the work.
        visibilities = simulate_vis(
            ants={number: positions[number] for number in used},
            fluxes=np.ascontiguousarray(stokes_i(sky, template.freq_array).T),
            ra=coordinates.ra.rad,
            dec=coordinates.dec.rad,
            freqs=template.freq_array,
            times=Time(integration_times(template), format="jd", scale="utc", location=telescope.location),
            beam=tabulated if isinstance(tabulated, UVBeam) else BeamInterface(tabulated, beam_type="efield"),
            telescope_loc=telescope.location,
            baselines=[tuple(pair) for pair in pairs],
            precision=2,
            polarized=True,
            eps=self._accuracy,
            flat_array_tol=FLATNESS,
            interpolation_function="az_za_simple",
            nprocesses=1,
            nthreads=1,
            coord_method="CoordinateRotationAstropy",
        )
        # (Nfreqs, Ntimes, feed, feed, Nbls)
        return select_polarizations(visibilities.transpose(1, 4, 0, 2, 3), template).astype(np.complex128)
