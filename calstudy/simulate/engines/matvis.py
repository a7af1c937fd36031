"""matvis: matrix products over antennas (Kittiwisit et al. 2025), for any geometry."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from calstudy.base.visibilities import require_rectangular
from calstudy.simulate.interface import BeamSource, Engine

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.antenna_beams import AntennaBeams

# matvis splits its sources so that a block takes about this much memory (bytes).
BLOCK_MEMORY = 500_000_000


class MatvisEngine(Engine):
    """matvis on the CPU, both feeds, with beams interpolated in the same way as in pyuvsim."""

    precision: Literal["single", "double"] = Field(
        "double",
        description="Of all arithmetic, fringe phases included: single agrees with pyuvsim to 1e-4 of the rms.",
    )

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.simulate.arguments import refusal

        return refusal("matvis", sky, beam, template)

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from matvis.wrapper import simulate_vis

        from calstudy.simulate import arguments
        from calstudy.simulate.brightness import stokes_i

        require_rectangular(template)
        beams, index = arguments.beam_arguments(beam, template)
        simulate_positive = partial(
            simulate_vis,
            **arguments.common_arguments(sky, template),
            beams=[arguments.as_splines(item) for item in beams],
            beam_idx=index,
            precision={"single": 1, "double": 2}[self.precision],
            antpairs=arguments.baseline_pairs(template),
            max_memory=BLOCK_MEMORY,
        )
        flux = np.ascontiguousarray(stokes_i(sky, template.freq_array).T)
        # Shape (Nfreqs, Ntimes, Nbls, feed, feed).
        visibilities = simulate_positive(fluxes=np.maximum(flux, 0))
        if flux.min() < 0:
            # matvis takes the square root of fluxes, and those of a 21 cm sky have both signs.
            visibilities -= simulate_positive(fluxes=np.maximum(-flux, 0))
        return arguments.select_polarizations(visibilities.transpose(1, 2, 0, 4, 3), template).astype(np.complex128)
