"""The `simulation` section of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.schema import UNKEYED, Section, fault
from calstudy.base.units import Length
from calstudy.simulate.interface import Engine

ENGINES = Engine.registry


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

    engine: Annotated[SerializeAsAny[Engine], ENGINES.field("auto")] = Field(
        default_factory=lambda: ENGINES.make("auto"),
        description="What computes the visibilities; auto: the fastest engine that supports the experiment.",
    )
    nodes: Nodes = Nodes()
    chunks: int = Field(
        16,
        ge=1,
        description="Independent parts of a simulation, for resuming and for parallel workers; changes results by "
        "rounding only.",
        json_schema_extra=UNKEYED,
    )

    @model_validator(mode="before")
    @classmethod
    def _precision_is_the_engines(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "precision" in data:
            named = data.get("engine", "auto")
            kind = named if isinstance(named, str) else "auto"
            sentence = f"is now a setting of the engine: engine: {{kind: {kind}, precision: {data['precision']}}}"
            raise fault("precision", sentence)
        return data
