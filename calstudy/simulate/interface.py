"""The interface of visibility simulators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, Registry, guarded, refusal_of
from calstudy.base.resources import Cost
from calstudy.base.visibilities import require_rectangular, subset_template
from calstudy.simulate.nodes import EXACT, Accuracy, integration_times, time_axis

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.interface import AntennaBeam, AntennaBeams


@dataclass(frozen=True)
class SimulationSize:
    """Size of a simulation, from which an engine estimates its cost.

    Attributes
    ----------
    sources : number of components of the sky, above and below the horizon
    slots : number of combinations of time and frequency nodes
    patch_slots : the same for each patch of neighbouring sources (`calstudy.simulate.patches`)
    beams : number of distinct beams
    tolerance : tolerance of the interpolation, 0 for none
    regular : whether the antennas are on a flat lattice
    """

    sources: float
    slots: float
    patch_slots: float
    antennas: int
    beams: int
    tolerance: float
    regular: bool = False


class Engine(Plugin, ABC):
    """A simulator: computes visibilities from a sky and beams. Fields of a subclass are its settings.

    Its module is imported when an experiment file is read: import slow libraries inside the methods.
    """

    registry: ClassVar[Registry[Engine]] = Registry(
        "engine", "calstudy.simulate.engines", "calstudy.simulate.interface:Engine", families=True
    )
    inherited_with: ClassVar = {"interpolate": "simulate"}

    kind: str = Field("", description="Name of an engine, or a file.py.")

    def refusal(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does.

        The arguments are those of `simulate`. By default every simulation is supported.
        """
        del sky, beam, template
        return None

    @abstractmethod
    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Simulate every time, baseline, frequency and polarization of the template; change none of the arguments.

        It is called only with arguments that `refusal` accepts: a sky of points or HEALPix, in Jy or K, of any spectral
        type; a beam for all antennas, or `AntennaBeams`; and a rectangular observation without data
        (`calstudy.base.visibilities`). The uncalibrated drift-scan visibilities are in Jy, V_xx = 1/2 int A I, in the
        template's order, (Ntimes, Nbls, Nfreqs, Npols) complex128.
        """

    def interpolate(
        self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy
    ) -> np.ndarray:
        """Simulate as `simulate` does, but only to the given accuracy.

        By default sources that stay above the horizon are simulated at time nodes and interpolated. Sources that rise
        or set are discontinuous in time, and are simulated at every integration.
        """
        from calstudy.simulate.sources import SourceTracks, split_by_horizon

        axis, integrations = time_axis(template, accuracy), integration_times(template)
        if axis.at_samples:
            return self.simulate(sky, beam, template)
        tracks = SourceTracks.of(sky, template.telescope.location, integrations)
        cube = np.zeros((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), dtype=np.complex128)
        always_up, crossing = split_by_horizon(tracks, integrations)
        if len(always_up):
            steady = sky.select(component_inds=always_up, inplace=False, run_check=False)
            at_nodes = subset_template(template, axis.nodes, template.freq_array)
            cube += axis.interpolate(self.simulate(steady, beam, at_nodes))
        if len(crossing):
            changing = sky.select(component_inds=crossing, inplace=False, run_check=False)
            cube += self.simulate(changing, beam, template)
        return cube

    def cost(self, size: SimulationSize) -> Cost:
        """Estimate the cost beyond that of holding sky and visibilities; the default is that of matrix products."""
        return Cost((3e-6 + 3.2e-9 * size.antennas**2) * size.sources * size.slots)


def polarization_feeds(template: UVData) -> list[str]:
    """Return the feed of each polarization; raises InputError for cross-hand or circular ones."""
    feeds = {-5: "x", -6: "y"}
    unknown = [int(number) for number in template.polarization_array if int(number) not in feeds]
    if unknown:
        raise InputError(f"polarization number {unknown[0]} is not xx (-5) or yy (-6)")
    return [feeds[int(number)] for number in template.polarization_array]


def refusal_of_polarization(sky: SkyModel, template: UVData) -> str | None:
    """Return the reason why an engine of Stokes I in xx and yy does not support a simulation, or None if it does."""
    if np.any(sky.stokes[1:].value):
        return "does not handle a polarized sky"
    try:
        polarization_feeds(template)
    except InputError as error:
        return str(error)
    return None


def simulate_with(
    engine: Engine, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy = EXACT
) -> np.ndarray:
    """Simulate visibilities with an engine and check them, (Ntimes, Nbls, Nfreqs, Npols) complex128, Jy.

    Raises InputError if the engine refuses or fails, or returns visibilities of another shape or that are not finite.
    """
    require_rectangular(template)
    if (reason := refusal_of(engine, sky, beam, template)) is not None:
        raise InputError(f"simulation.engine = {engine.label!r}: {reason}")
    with guarded(engine):
        found = engine.interpolate(sky, beam, template, accuracy)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    if np.shape(found) != shape:
        raise InputError(f"engine {engine.label!r}: returned visibilities of shape {np.shape(found)}, expected {shape}")
    if not np.isfinite(found).all():
        raise InputError(f"engine {engine.label!r}: returned visibilities that are not finite")
    return np.asarray(found, dtype=np.complex128)
