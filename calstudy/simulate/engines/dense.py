"""The dense engine, sums over patches of sources (`calstudy.simulate.patches`), and the choice of an engine."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.simulate.engines.other_packages import FftvisEngine, MatvisEngine, PyuvsimEngine
from calstudy.simulate.interface import Engine, SimulationSize, polarization_feeds, refusal_of_polarization
from calstudy.simulate.nodes import EXACT, SINGLE_PRECISION, Accuracy

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.interface import AntennaBeam, AntennaBeams


class DenseEngine(Engine):
    """Matrix products over patches of sources; unpolarized sky, xx and yy, any three-dimensional array.

    With several beams the products take three times as long as with one, and each beam is evaluated. For many antennas
    without heights, single precision is computed by Fourier transforms.
    """

    kind: str = "dense"
    precision: Literal["auto", "single", "double"] = Field(
        "auto",
        description="Of the products. double agrees with pyuvsim to rounding, single to 3e-6 of the rms; auto: single "
        "where the tolerance of the interpolation is 1e-5 or more.",
    )

    def refusal(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> str | None:
        """Return the reason why this engine does not support a simulation, or None if it does."""
        from calstudy.instrument.antenna_beams import split_beams
        from calstudy.simulate import patterns

        if (reason := refusal_of_polarization(sky, template)) is not None:
            return reason
        beams, feeds = split_beams(beam, template)[0], polarization_feeds(template)
        reasons = (patterns.refusal(item.at(template.freq_array[:1]), feeds) for item in beams)
        return next((reason for reason in reasons if reason), None)

    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.simulate`."""
        # That of a subclass may call this.
        return DenseEngine.interpolate(self, sky, beam, template, EXACT)

    def interpolate(
        self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy
    ) -> np.ndarray:
        """Return the visibilities in Jy, (Ntimes, Nbls, Nfreqs, Npols) complex128; see `Engine.interpolate`."""
        from calstudy.simulate.patches import visibilities

        dtype = {"auto": None, "double": np.float64, "single": np.float32}[self.precision]
        return visibilities(sky, beam, template, accuracy, dtype)

    def cost(self, size: SimulationSize) -> Cost:
        """Estimate the cost of a simulation; see `Engine.cost`."""
        single = self.precision == "single" or (self.precision == "auto" and size.tolerance >= SINGLE_PRECISION)
        # The mean of two processors that compute these products at 46 and 32 GFLOP/s.
        products = (0.6 if single else 1.0) * (1.2e-9 * size.antennas + 1.05e-10 * size.antennas**2)
        # With several beams, products are over both components, and one more factor is computed.
        each = 2e-8 + products if size.beams == 1 else 3.5e-8 * size.beams + 3 * products
        seconds = 1.1 * size.sources / 2 * size.patch_slots * each
        if single and size.regular and size.beams == 1:
            # Fourier transforms use larger patches.
            seconds = min(seconds, 1.5e-7 * size.sources * size.slots)
        return Cost(seconds + 1.5e-6 * size.sources)


logger = logging.getLogger(__name__)


class FastestEngine(Engine):
    """The first of dense, matvis, fftvis and pyuvsim that supports a simulation: the fastest."""

    kind: str = "auto"
    precision: Literal["auto", "single", "double"] = Field(
        "auto", description="Of the engine that is chosen; pyuvsim's is always double. auto: its default."
    )

    def engines(self) -> list[Engine]:
        """Return the engines in the order in which they are tried, fastest first."""
        precise = {} if self.precision == "auto" else {"precision": self.precision}
        return [DenseEngine(**precise), MatvisEngine(**precise), FftvisEngine(**precise), PyuvsimEngine()]

    def choose(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> Engine:
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

    def refusal(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> str | None:
        """Return the reasons why no engine supports a simulation, or None if one does."""
        try:
            self.choose(sky, beam, template)
        except InputError as error:
            return str(error)
        return None

    def simulate(self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData) -> np.ndarray:
        """Return the visibilities of the fastest engine that supports the simulation; see `Engine.simulate`."""
        return self.choose(sky, beam, template).simulate(sky, beam, template)

    def interpolate(
        self, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, accuracy: Accuracy
    ) -> np.ndarray:
        """Return the visibilities of the fastest engine to a tolerance; see `Engine.interpolate`."""
        return self.choose(sky, beam, template).interpolate(sky, beam, template, accuracy)

    def cost(self, size: SimulationSize) -> Cost:
        """Return the cost of the first engine, which supports all skies and beams of experiment files."""
        return self.engines()[0].cost(size)
