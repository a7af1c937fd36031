"""fftvis: non-uniform fast Fourier transforms (Cox et al. 2025); fast for flat and regular arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from calstudy.base.resources import Cost
from calstudy.simulate.engines.matvis import call, refusal, select_polarizations
from calstudy.simulate.interface import BeamSource, Engine, SimulationSize

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.antenna_beams import AntennaBeams

# fftvis treats an array flatter than this (m) as flat: at 200 MHz, a phase of 4e-12.
FLATNESS = 1e-12
# The polarization numbers of xy and yx are below that of yy.
CROSS_HANDS = -6


class FftvisEngine(Engine):
    """fftvis with both feeds, and beams interpolated in the same way as in pyuvsim."""

    precision: Literal["single", "double"] = Field(
        "double",
        # fftvis' own single precision rounds frequencies to 16 Hz, 4e-5 rad for a 176 m baseline.
        description="Accuracy of the transforms, 1e-12 or 1e-6; the arithmetic is double in both.",
    )

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.instrument.antenna_beams import AntennaBeams

        if isinstance(beam, AntennaBeams) and (template.polarization_array < CROSS_HANDS).any():
            return "fftvis confuses the feeds of cross-hand polarizations if antennas have different beams"
        return refusal("fftvis", sky, beam, template)

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from fftvis.wrapper import simulate_vis

        from calstudy.simulate.brightness import stokes_i

        arguments, beams, pairs = call(sky, beam, template)
        # One process and thread, because the caller distributes the work.
        visibilities = simulate_vis(
            **arguments,
            fluxes=np.ascontiguousarray(stokes_i(sky, template.freq_array).T),
            beam=beams,
            baselines=[tuple(pair) for pair in pairs.tolist()],
            precision=2,
            eps={"double": 1e-12, "single": 1e-6}[self.precision],
            flat_array_tol=FLATNESS,
            interpolation_function="az_za_simple",
            nprocesses=1,
            nthreads=1,
            coord_method="CoordinateRotationAstropy",
        )
        # Shape (Nfreqs, Ntimes, feed, feed, Nbls).
        return select_polarizations(visibilities.transpose(1, 4, 0, 3, 2), template)

    def cost(self, size: SimulationSize) -> Cost:
        """Estimate the cost of a simulation; see `Engine.cost`."""
        return Cost(1.8e-5 * size.sources * size.slots)
