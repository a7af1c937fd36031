"""pyuvsim: the simulator of the paper, and the reference for the other engines."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from calstudy.base.resources import Cost
from calstudy.base.visibilities import require_rectangular
from calstudy.simulate.interface import BeamSource, Engine, SimulationSize

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVBeam, UVData
    from pyuvdata.analytic_beam import AnalyticBeam
    from pyuvsim.simsetup import SkyModelData

    from calstudy.instrument.antenna_beams import AntennaBeams


class PyuvsimEngine(Engine):
    """All skies, beams and geometries that pyuvsim supports, one visibility at a time."""

    precision: Literal["double"] = Field("double", description="pyuvsim has no other.")

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.instrument.antenna_beams import split_beams

        beams, _ = split_beams(beam, template)
        for item in beams:
            available = _products(item.at(template.freq_array[:1]))
            missing = [int(number) for number in template.polarization_array if number not in available]
            if missing:
                return f"the beam's feeds do not give polarization number {missing[0]}"
        return None

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
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

    `pyuvsim.run_uvdata_uvsim` prints and installs an excepthook; this is its loop, and gives the same bits.
    """
    from pyuvdata import BeamInterface
    from pyuvsim import BeamList
    from pyuvsim.uvsim import UVEngine, uvdata_to_task_iter

    from calstudy.instrument.telescope import use_bundled_earth_orientation

    use_bundled_earth_orientation()
    listed = BeamList([BeamInterface(beam, beam_type="efield") for beam in beams])
    by_antenna = dict(zip(template.telescope.antenna_names, index.tolist(), strict=True))
    tasks = range(template.Nblts * template.Nfreqs)
    cube = np.empty((template.Nblts, template.Nfreqs, len(_products(beams[0]))), dtype=np.complex128)
    engine = UVEngine()
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

    # These are pyuvsim's steps at the start of a parallel run. They are in place, so a copy is made.
    sky = sky.copy()
    without_frequency = sky.spectral_type == "flat" and sky.reference_frequency is None and sky.freq_array is None
    if sky.spectral_type not in ("flat", "full") or (sky.component_type == "healpix" and without_frequency):
        sky.at_frequencies(frequencies * units.Hz)
    if sky.component_type == "healpix":
        sky.healpix_to_point()
    return SkyModelData(sky)
