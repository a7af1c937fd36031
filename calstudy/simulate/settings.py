"""The `simulation` section of an experiment file."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from calstudy.schema import Section
from calstudy.units import Length


class Nodes(Section):
    """Simulate at Chebyshev nodes and interpolate, or at every integration and channel."""

    enabled: bool = Field(True, description="false: simulate every integration and channel.")
    tolerance: float = Field(
        1e-9,
        gt=0,
        lt=1e-2,
        description="Largest interpolation error of the fringe of any source, relative to its amplitude.",
    )
    beam_extent: Length = Field(
        20.0,
        ge=0,
        description="Length added to the longest baseline, for the structure of the beam in fringe rate and delay.",
    )


class SimulationSettings(Section):
    """How the visibilities are computed."""

    engine: Literal["auto", "dense", "matvis", "fftvis", "pyuvsim"] = Field(
        "auto", description="auto: the fastest engine that supports the experiment."
    )
    precision: Literal["single", "double"] = Field("double", description="Precision of the sums over sources.")
    nodes: Nodes = Nodes()
    chunks: int = Field(
        16, ge=1, description="Independent parts of a simulation, for resuming and for parallel workers."
    )
