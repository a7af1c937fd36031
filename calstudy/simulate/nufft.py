"""fftvis: non-uniform fast Fourier transforms (Cox et al. 2025); fast for flat and regular arrays."""

from __future__ import annotations

import numpy as np
from fftvis.wrapper import simulate_vis
from pyradiosky import SkyModel
from pyuvdata import UVData

from calstudy.errors import InputError
from calstudy.instrument.antenna_beams import AntennaBeams
from calstudy.simulate.arguments import baseline_pairs, beam_arguments, common_arguments
from calstudy.simulate.brightness import stokes_i
from calstudy.simulate.feeds import refusal, select_polarizations
from calstudy.visibilities import require_rectangular

# fftvis treats an array flatter than this (m) as flat: at 200 MHz, a phase of 4e-12.
FLATNESS = 1e-12
# Numbers of xy and yx are below that of yy.
CROSS_HANDS = -6


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
        """Return the reason why this engine does not support a simulation, or None if it does."""
        if isinstance(beam, AntennaBeams) and (template.polarization_array < CROSS_HANDS).any():
            return "fftvis confuses the feeds of cross-hand polarizations if antennas have different beams"
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
        beams, index = beam_arguments(beam, template)
        # One process and thread, for the caller shares out the work.
        visibilities = simulate_vis(
            **common_arguments(sky, template),
            fluxes=np.ascontiguousarray(stokes_i(sky, template.freq_array).T),
            beam=beams,
            beam_idx=index,
            baselines=[tuple(pair) for pair in baseline_pairs(template).tolist()],
            precision=2,
            eps=self._accuracy,
            flat_array_tol=FLATNESS,
            interpolation_function="az_za_simple",
            nprocesses=1,
            nthreads=1,
            coord_method="CoordinateRotationAstropy",
        )
        # (Nfreqs, Ntimes, feed, feed, Nbls)
        return select_polarizations(visibilities.transpose(1, 4, 0, 3, 2), template).astype(np.complex128)
