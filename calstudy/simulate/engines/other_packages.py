"""Engines of other packages.

- matvis: matrix products over antennas (Kittiwisit et al. 2025), for any geometry;
- fftvis: non-uniform fast Fourier transforms (Cox et al. 2025), fast for flat and regular arrays;
- pyuvsim: the simulator of the paper, and the reference for the other engines.
"""

from __future__ import annotations

import warnings
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from calstudy.base.resources import Cost
from calstudy.base.visibilities import antenna_indices, require_rectangular, taken, use_bundled_earth_orientation
from calstudy.instrument.interface import AntennaBeam, AntennaBeams
from calstudy.simulate.interface import Engine, SimulationSize, polarization_feeds, refusal_of_polarization
from calstudy.simulate.nodes import integration_times

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import BeamInterface, UVBeam, UVData
    from pyuvdata.analytic_beam import AnalyticBeam
    from pyuvsim.simsetup import SkyModelData


# matvis splits its sources so that a block takes about this much memory (bytes).
BLOCK_MEMORY = 500_000_000


class _FeedMatrices(Engine):
    package: ClassVar[str]

    def refusal(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.instrument.antenna_beams import split_beams

        if (reason := missing_package(self.package) or refusal_of_polarization(sky, template)) is not None:
            return reason
        beams, _ = split_beams(beam, template)
        if any(list(item.at(template.freq_array[:1]).feed_array) != ["x", "y"] for item in beams):
            return f"{self.package} needs beams with feeds x and y"
        return None


class MatvisEngine(_FeedMatrices):
    """matvis on the CPU, both feeds, with beams interpolated in the same way as in pyuvsim."""

    package: ClassVar[str] = "matvis"
    kind: str = "matvis"
    precision: Literal["single", "double"] = Field(
        "double",
        description="Of all arithmetic, fringe phases included: single agrees with pyuvsim to 1e-4 of the rms.",
    )

    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from matvis.wrapper import simulate_vis

        from calstudy.simulate.sources import stokes_i

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
        return select_polarizations(visibilities.transpose(1, 2, 0, 3, 4), template)


def missing_package(engine: str) -> str | None:
    """Return a message if the package of matvis or fftvis is not installed, or None."""
    if find_spec(engine) is None:
        return f"needs the package {engine}, which is not installed: pip install 'calstudy[engines]'"
    return None


def call(
    sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData
) -> tuple[dict[str, Any], list[UVBeam | BeamInterface], np.ndarray]:
    """Return keyword arguments of `simulate_vis`, the distinct beams, and the antennas of each baseline, (Nbls, 2).

    Antennas without baselines are left out, and the others are numbered from 0 in the telescope's order.

    Both libraries sum conj(J_ai) J_bi, which is correct only if antennas a and b have the same beam; with conjugated
    beams the sum is the visibility for any beams.
    """
    from astropy.coordinates import ICRS
    from astropy.time import Time

    from calstudy.instrument.antenna_beams import split_beams
    from calstudy.simulate.sources import sky_coordinates

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
    """Return the template's polarizations, xx or yy, (..., Npols) complex128, from feed matrices, (..., 2, 2)."""
    feeds = ["xy".index(feed) for feed in polarization_feeds(template)]
    return matrices[..., feeds, feeds].astype(np.complex128)


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


# fftvis treats an array flatter than this (m) as flat: at 200 MHz, a phase of 4e-12.
FLATNESS = 1e-12


class FftvisEngine(_FeedMatrices):
    """fftvis with both feeds, and beams interpolated in the same way as in pyuvsim."""

    package: ClassVar[str] = "fftvis"
    kind: str = "fftvis"
    precision: Literal["single", "double"] = Field(
        "double",
        # fftvis' own single precision rounds frequencies to 16 Hz, 4e-5 rad for a 176 m baseline.
        description="Accuracy of the transforms, 1e-12 or 1e-6; the arithmetic is double in both.",
    )

    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from fftvis.wrapper import simulate_vis

        from calstudy.simulate.sources import stokes_i

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
        return select_polarizations(visibilities.transpose(1, 4, 0, 2, 3), template)

    def cost(self, size: SimulationSize) -> Cost:
        """Estimate the cost of a simulation; see `Engine.cost`."""
        return Cost(1.8e-5 * size.sources * size.slots)


class PyuvsimEngine(Engine):
    """All skies, beams and geometries that pyuvsim supports, one visibility at a time."""

    kind: str = "pyuvsim"
    precision: Literal["double"] = Field("double", description="pyuvsim has no other.")

    def refusal(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.instrument.antenna_beams import split_beams

        beams, _ = split_beams(beam, template)
        for item in beams:
            available = _products(item.at(template.freq_array[:1]))
            missing = [int(number) for number in template.polarization_array if number not in available]
            if missing:
                return f"the beam's feeds do not give polarization number {missing[0]}"
        return None

    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        from calstudy.instrument.antenna_beams import split_beams

        require_rectangular(template)
        beams, index = split_beams(beam, template)
        tabulated = [item.at(template.freq_array) for item in beams]
        products = _products(tabulated[0])
        columns = [products.index(number) for number in template.polarization_array]
        cube = _visibilities(sky, tabulated, index, template)
        return cube.reshape(template.Ntimes, template.Nbls, template.Nfreqs, -1)[..., columns]

    def cost(self, size: SimulationSize) -> Cost:
        """Estimate the cost of a simulation; see `Engine.cost`."""
        return Cost(2.8e-8 * size.sources * size.slots * size.antennas**2 / 2)


def _visibilities(sky: SkyModel, beams: list, index: np.ndarray, template: UVData) -> np.ndarray:
    """Return the visibilities, (Nblts, Nfreqs, Nproducts) complex128; antenna i has the beam ``beams[index[i]]``.

    `pyuvsim.run_uvdata_uvsim` prints and installs an excepthook; this is its loop, and gives the same bits if the sky
    is not polarized.
    """
    from pyuvdata import BeamInterface
    from pyuvsim import BeamList
    from pyuvsim.uvsim import UVEngine, uvdata_to_task_iter

    class MirroredEngine(UVEngine):
        update_local_coherency: bool

        def apply_beam(self, beam_interp_check: bool = True) -> None:
            # pyuvsim 1.4 has coherencies along azimuths from north through east, and multiplies them by beams along
            # azimuths from east through north, which mirrors Q and U. V keeps the sign that pyuvsim gives it.
            if self.update_local_coherency:
                self.local_coherency = self.task.sources.coherency_calc().conj()
                self.local_coherency[[0, 1], [1, 0]] *= -1
                self.update_local_coherency = False
            super().apply_beam(beam_interp_check)

    use_bundled_earth_orientation()
    by_antenna = dict(zip(template.telescope.antenna_names, index.tolist(), strict=True))
    # In the order of their numbers, as pyuvsim looks antennas up.
    template = template.copy()
    template.telescope = taken(template.telescope, "Nants", np.argsort(template.telescope.antenna_numbers))
    listed = BeamList([BeamInterface(beam, beam_type="efield") for beam in beams])
    tasks = range(template.Nblts * template.Nfreqs)
    cube = np.empty((template.Nblts, template.Nfreqs, len(_products(beams[0]))), dtype=np.complex128)
    engine = MirroredEngine()
    with warnings.catch_warnings():
        # A 21 cm sky is a brightness difference.
        warnings.filterwarnings("ignore", "Some Stokes I values are negative", UserWarning)
        for task in uvdata_to_task_iter(tasks, template, _catalog(sky, template.freq_array), listed, by_antenna):
            engine.set_task(task)
            cube[tuple(task.uvdata_index[:2])] = engine.make_visibility()
    return cube


def _products(beam: UVBeam | AnalyticBeam) -> list[int]:
    """Return the polarization number of each element of pyuvsim's visibility vector."""
    from pyuvdata.utils.pol import convert_feeds_to_pols

    return convert_feeds_to_pols(feed_array=beam.feed_array, include_cross_pols=True).tolist()


def _catalog(sky: SkyModel, frequencies: np.ndarray) -> SkyModelData:
    from astropy import units
    from pyuvsim.simsetup import SkyModelData

    from calstudy.sky.spectra import interpolation_of

    # These are pyuvsim's steps at the start of a parallel run. They are in place, so a copy is made.
    sky = sky.copy()
    if sky.spectral_type == "full":
        # pyuvsim takes the rows of such a sky for the channels of the template, which may be a few of them.
        tabulated = sky.freq_array.to_value("Hz")
        nearest = [int(np.abs(tabulated - frequency).argmin()) for frequency in frequencies]
        sky.at_frequencies(sky.freq_array[nearest])
    without_frequency = sky.spectral_type == "flat" and sky.reference_frequency is None and sky.freq_array is None
    if sky.spectral_type not in ("flat", "full") or (sky.component_type == "healpix" and without_frequency):
        sky.at_frequencies(frequencies * units.Hz, freq_interp_kind=interpolation_of(sky))
    if sky.component_type == "healpix":
        sky.healpix_to_point()
    return SkyModelData(sky)
