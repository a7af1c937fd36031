"""matvis: matrix products over antennas (Kittiwisit et al. 2025), for any geometry.

The other functions of this module are for fftvis, too, which has the same arguments and conventions.
"""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from calstudy.base.visibilities import antenna_indices, require_rectangular
from calstudy.simulate.interface import BeamSource, Engine
from calstudy.simulate.nodes import integration_times

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import BeamInterface, UVBeam, UVData
    from pyuvdata.analytic_beam import AnalyticBeam

    from calstudy.instrument.antenna_beams import AntennaBeams

# matvis splits its sources so that a block takes about this much memory (bytes).
BLOCK_MEMORY = 500_000_000
# Row and column of each polarization number in a matrix of feeds x and y.
FEED_PAIRS = {-5: (0, 0), -6: (1, 1), -7: (0, 1), -8: (1, 0)}


class MatvisEngine(Engine):
    """matvis on the CPU, both feeds, with beams interpolated in the same way as in pyuvsim."""

    precision: Literal["single", "double"] = Field(
        "double",
        description="Of all arithmetic, fringe phases included: single agrees with pyuvsim to 1e-4 of the rms.",
    )

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        return refusal("matvis", sky, beam, template)

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from matvis.wrapper import simulate_vis

        from calstudy.simulate.brightness import stokes_i

        arguments, beams, pairs = call(sky, beam, template)
        simulate_positive = partial(
            simulate_vis,
            **arguments,
            beams=[_as_splines(item) for item in beams],
            precision={"single": 1, "double": 2}[self.precision],
            antpairs=pairs,
            max_memory=BLOCK_MEMORY,
        )
        flux = np.ascontiguousarray(stokes_i(sky, template.freq_array).T)
        # Shape (Nfreqs, Ntimes, Nbls, feed, feed).
        visibilities = simulate_positive(fluxes=np.maximum(flux, 0))
        if flux.min() < 0:
            # matvis takes the square root of fluxes, and those of a 21 cm sky have both signs.
            visibilities -= simulate_positive(fluxes=np.maximum(-flux, 0))
        return select_polarizations(visibilities.transpose(1, 2, 0, 4, 3), template)


def missing_package(engine: str) -> str | None:
    """Return a message if the package of matvis or fftvis is not installed, or None."""
    if find_spec(engine) is None:
        return f"needs the package {engine}, which is not installed: pip install 'calstudy[engines]'"
    return None


def refusal(engine: str, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
    """Return the reason why matvis or fftvis does not support a simulation, or None if it does."""
    from calstudy.instrument.antenna_beams import split_beams
    from calstudy.simulate.brightness import is_polarized

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


def call(
    sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData
) -> tuple[dict[str, Any], list[UVBeam | BeamInterface], np.ndarray]:
    """Return keyword arguments of `simulate_vis`, the distinct beams, and the antennas of each baseline, (Nbls, 2).

    Antennas without baselines are left out, and the others are numbered from 0 in the telescope's order.

    Both libraries sum conj(J_ai) J_bj and call it the visibility of feeds j, i. That is correct only if antennas a and
    b have the same beam. With conjugated beams the sum is the visibility of feeds i, j for any beams, so the two feed
    axes of the result must be exchanged.
    """
    from astropy.coordinates import ICRS
    from astropy.time import Time

    from calstudy.instrument.antenna_beams import split_beams
    from calstudy.instrument.telescope import use_bundled_earth_orientation
    from calstudy.simulate.directions import sky_coordinates

    require_rectangular(template)
    use_bundled_earth_orientation()
    coordinates = sky_coordinates(sky).transform_to(ICRS())
    location = template.telescope.location
    used, pairs = np.unique(antenna_indices(template), return_inverse=True)
    beams, index = split_beams(beam, template)
    arguments = {
        "ants": dict(enumerate(template.telescope.get_enu_antpos()[used])),
        "ra": coordinates.ra.rad,
        "dec": coordinates.dec.rad,
        "freqs": template.freq_array,
        "times": Time(integration_times(template), format="jd", scale="utc", location=location),
        "telescope_loc": location,
        "polarized": True,
        "beam_idx": index[used],
    }
    return arguments, [_conjugated(item.at(template.freq_array)) for item in beams], pairs.reshape(-1, 2)


def select_polarizations(matrices: np.ndarray, template: UVData) -> np.ndarray:
    """Return the template's polarizations, (..., Npols) complex128, from feed matrices, (..., 2, 2)."""
    rows, columns = np.array([FEED_PAIRS[int(number)] for number in template.polarization_array]).T
    return matrices[..., rows, columns].astype(np.complex128)


def _as_splines(beam: UVBeam | BeamInterface) -> UVBeam | BeamInterface:
    """Return the beam; a tabulated one is always interpolated by splines, whichever method a caller requests.

    matvis requests `scipy.ndimage.map_coordinates`, which differs from pyuvsim's splines by 1e-5 of the rms.
    """
    from pyuvdata import UVBeam

    class SplineBeam(UVBeam):
        def interp(self, **options: Any) -> tuple | UVBeam:
            return super().interp(**{**options, "interpolation_function": "az_za_simple", "spline_opts": None})

    if not isinstance(beam, UVBeam):
        return beam
    splines = SplineBeam()
    for parameter in beam:
        setattr(splines, parameter, getattr(beam, parameter))
    return splines


def _conjugated(beam: UVBeam | AnalyticBeam) -> UVBeam | BeamInterface:
    from pyuvdata import BeamInterface, UVBeam

    if not isinstance(beam, UVBeam):
        # Beams in closed form are real.
        return BeamInterface(beam, beam_type="efield")
    conjugated = beam.copy()
    conjugated.data_array = beam.data_array.conj()
    return conjugated
