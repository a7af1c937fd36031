"""The `simulation` section of an experiment file."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from calstudy.schema import Section
from calstudy.units import Length


class Nodes(Section):
    """Simulate at Chebyshev nodes and interpolate, or at every integration and channel."""

    enabled: bool = Field(True, description="false: every integration and channel is simulated.")
    tolerance: float = Field(
        1e-9,
        gt=0,
        lt=1e-2,
        description="Largest interpolation error of any source's fringe, relative to its amplitude.",
    )
    beam_extent: Length = Field(
        20.0,
        ge=0,
        description="The beam's own structure counts like this much more baseline, in fringe rate and in delay.",
    )


class SimulationSettings(Section):
    """How the visibilities are computed."""

    engine: Literal["auto", "dense", "matvis", "fftvis", "pyuvsim"] = Field(
        "auto", description="auto: the fastest that can do what is asked."
    )
    precision: Literal["single", "double"] = Field("double", description="Precision of the engine's inner products.")
    nodes: Nodes = Nodes()
    chunks: int = Field(
        16, ge=1, description="Independent pieces per simulation; the unit of resuming and of work sharing."
    )
