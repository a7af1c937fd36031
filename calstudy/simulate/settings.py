"""The `simulation` section of an experiment file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, SerializeAsAny

from calstudy.base.schema import UNKEYED, Section
from calstudy.base.units import Length
from calstudy.simulate.interface import Engine
from calstudy.simulate.nodes import EXACT, Accuracy

ENGINES = Engine.registry


class Nodes(Section):
    """Simulate at Chebyshev nodes and interpolate, or simulate every integration and channel."""

    enabled: bool = Field(True, description="false: simulate every integration and channel.")
    tolerance: float = Field(
        1e-9,
        gt=0,
        lt=1e-2,
        description="Interpolation error of the visibilities of the foregrounds, relative to their rms: a bound for "
        "phasors as fast as the fastest fringe. Sources that contribute little have larger relative errors.",
    )
    eor_tolerance: float = Field(
        1e-4,
        gt=0,
        lt=1e-2,
        description="The same for the EoR, which is far below the foregrounds. Errors of the visibilities are about a "
        "hundredth of it.",
    )
    beam_extent: Length = Field(
        20.0,
        ge=10,
        description="Length added to baselines for the structure of the beam in fringe rate and delay, where the beam "
        "has no larger one, as HERA's has (60 m).",
    )

    def accuracy(self, eor: bool, smooth_beam: bool = True, smooth_sky: bool = True, extent: float = 0.0) -> Accuracy:
        """Return the accuracy for the EoR, whose channels are independent, or for foregrounds of smooth spectra.

        `extent`, m, is that of the beam.
        """
        if not self.enabled:
            return EXACT
        tolerance = self.eor_tolerance if eor else self.tolerance
        return Accuracy(tolerance, max(self.beam_extent, extent), smooth_beam, smooth_sky and not eor)


class SimulationSettings(Section):
    """Settings of the simulation of the visibilities."""

    engine: Annotated[SerializeAsAny[Engine], ENGINES.field("auto")] = Field(
        default_factory=lambda: ENGINES.make("auto"),
        description="What computes the visibilities; auto: the fastest engine that supports the experiment.",
    )
    nodes: Nodes = Nodes()
    chunks: int = Field(
        16,
        ge=1,
        description="Independent parts of the simulation of the EoR, for resuming and for parallel workers; the "
        "foregrounds have a quarter as many. Changes results by less than the tolerances of the nodes.",
        json_schema_extra=UNKEYED,
    )

    def pieces(self, eor: bool) -> int:
        """Return the maximum number of chunks of the EoR, or of the foregrounds, which take a quarter of its time."""
        return self.chunks if eor else max(1, self.chunks // 4)
