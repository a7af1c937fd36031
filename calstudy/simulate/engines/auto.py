"""The fastest of the built-in engines that supports a simulation."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.fftvis import FftvisEngine
from calstudy.simulate.engines.matvis import MatvisEngine
from calstudy.simulate.engines.pyuvsim import PyuvsimEngine
from calstudy.simulate.interface import BeamSource, Engine, SimulationSize
from calstudy.simulate.nodes import Accuracy

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.antenna_beams import AntennaBeams

logger = logging.getLogger(__name__)


class FastestEngine(Engine):
    """The first of dense, matvis, fftvis and pyuvsim that supports a simulation: the fastest."""

    precision: Literal["auto", "single", "double"] = Field(
        "auto", description="Of the engine that is chosen; pyuvsim's is always double. auto: its default."
    )

    def engines(self) -> list[Engine]:
        """Return the engines in the order in which they are tried, fastest first."""
        precise = {} if self.precision == "auto" else {"precision": self.precision}
        return [DenseEngine(**precise), MatvisEngine(**precise), FftvisEngine(**precise), PyuvsimEngine()]

    def choose(self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData) -> Engine:
        """Return the fastest engine that supports a simulation, or raise InputError with the reasons of all engines."""
        reasons = []
        for engine in self.engines():
            reason = engine.refusal(sky, beam, template)
            if reason is None:
                logger.info("simulating with %s", engine.label)
                return engine
            logger.info("not simulating with %s: %s", engine.label, reason)
            reasons.append(f"{engine.label}: {reason}")
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

    def interpolate(
        self, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData, accuracy: Accuracy
    ) -> np.ndarray:
        """Return the visibilities of the fastest engine to a tolerance; see `Engine.interpolate`."""
        return self.choose(sky, beam, template).interpolate(sky, beam, template, accuracy)

    def cost(self, size: SimulationSize) -> Cost:
        """Return the cost of the first engine, which supports all skies and beams of experiment files."""
        return self.engines()[0].cost(size)
