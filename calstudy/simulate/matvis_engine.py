"""matvis: matrix products over antennas (Kittiwisit et al. 2025), for any geometry."""

from __future__ import annotations

from functools import partial

import numpy as np
from matvis.wrapper import simulate_vis
from pyradiosky import SkyModel
from pyuvdata import BeamInterface, UVBeam, UVData

from calstudy.errors import InputError
from calstudy.simulate.arguments import baseline_pairs, beam_arguments, common_arguments
from calstudy.simulate.brightness import stokes_i
from calstudy.simulate.feeds import refusal, select_polarizations
from calstudy.visibilities import require_rectangular

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
        """Return the reason why this engine does not support a simulation, or None if it does."""
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
        simulate_positive = partial(
            simulate_vis,
            **common_arguments(sky, template),
            beams=[_as_splines(item) for item in beams],
            beam_idx=index,
            precision=self._precision,
            antpairs=baseline_pairs(template),
            max_memory=BLOCK_MEMORY,
        )
        flux = np.ascontiguousarray(stokes_i(sky, template.freq_array).T)
        # (Nfreqs, Ntimes, Nbls, feed, feed)
        visibilities = simulate_positive(fluxes=np.maximum(flux, 0))
        if flux.min() < 0:
            # matvis takes the square root of fluxes, and those of a 21 cm sky have both signs.
            visibilities -= simulate_positive(fluxes=np.maximum(-flux, 0))
        return select_polarizations(visibilities.transpose(1, 2, 0, 4, 3), template).astype(np.complex128)


class _SplineBeam(UVBeam):
    """A tabulated beam that is always interpolated by splines, whatever a caller asks for.

    matvis asks for `scipy.ndimage.map_coordinates`, which differs from pyuvsim's splines by 1e-5 of the rms.
    """

    def interp(self, **options) -> tuple | UVBeam:
        return super().interp(**{**options, "interpolation_function": "az_za_simple", "spline_opts": None})


def _as_splines(beam: UVBeam | BeamInterface) -> UVBeam | BeamInterface:
    if not isinstance(beam, UVBeam):
        return beam
    splines = _SplineBeam()
    for parameter in beam:
        setattr(splines, parameter, getattr(beam, parameter))
    return splines
