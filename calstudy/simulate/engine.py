"""The interface of visibility simulators, and their selection by name."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Protocol

import numpy as np

from calstudy.errors import InputError

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVBeam, UVData
    from pyuvdata.analytic_beam import AnalyticBeam

    from calstudy.instrument.antenna_beams import AntennaBeams
    from calstudy.simulate.settings import SimulationSettings

logger = logging.getLogger(__name__)


class BeamSource(Protocol):
    """A beam at any frequencies, such as `calstudy.instrument.beams.make_beam` returns."""

    def at(self, frequencies: np.ndarray) -> UVBeam | AnalyticBeam:
        """Return the E-field beam, tabulated at these frequencies (Hz) or in closed form."""


class Engine(Protocol):
    """A simulator: computes visibilities from a sky and a beam."""

    name: str

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
        """Simulate every time, baseline, frequency and polarization of the template; change none of the arguments.

        Parameters
        ----------
        sky
            Points or HEALPix, in Jy or K, of any spectral type.
        beam
            One for all antennas, or `AntennaBeams`.
        template
            Rectangular observation without data (see `calstudy.visibilities`).

        Returns
        -------
        (Ntimes, Nbls, Nfreqs, Npols) complex128
            Uncalibrated drift-scan visibilities in Jy, in the template's order.
        """


class FastestEngine:
    """The first of several engines, fastest first, that supports a simulation."""

    name = "auto"

    def __init__(self, engines: list[Engine]):
        self._engines = engines

    def choose(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> Engine:
        """Return the engine that will be used; raises InputError with the reasons of all engines if there is none."""
        reasons = []
        for engine in self._engines:
            reason = engine.refusal(sky, beam, template)
            if reason is None:
                logger.info("simulating with %s", engine.name)
                return engine
            logger.info("not simulating with %s: %s", engine.name, reason)
            reasons.append(f"{engine.name}: {reason}")
        raise InputError("no engine handles this simulation; " + "; ".join(reasons))

    def refusal(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> str | None:
        """Return the reasons why no engine supports a simulation, or None if one does."""
        try:
            self.choose(sky, beam, template)
        except InputError as error:
            return str(error)
        return None

    def simulate(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities of the fastest engine that supports the simulation; see `Engine.simulate`."""
        return self.choose(sky, beam, template).simulate(sky, beam, template)


def make_engine(settings: SimulationSettings) -> Engine:
    """Return the engine named in the settings; `auto` selects the fastest that supports each simulation."""
    from calstudy.simulate.dense import DenseEngine
    from calstudy.simulate.matvis_engine import MatvisEngine
    from calstudy.simulate.nufft import FftvisEngine
    from calstudy.simulate.reference import PyuvsimEngine

    engines = {
        "dense": lambda: DenseEngine(settings.precision),
        "matvis": lambda: MatvisEngine(settings.precision),
        "fftvis": lambda: FftvisEngine(settings.precision),
        "pyuvsim": PyuvsimEngine,
    }
    if settings.engine == "auto":
        return FastestEngine([make() for make in engines.values()])
    return engines[settings.engine]()
