"""The `corruption` section of an experiment file."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.schema import Section, fault
from calstudy.base.units import Decibel
from calstudy.corrupt.interface import Effect, GainEffect
from calstudy.corrupt.noise import Noise, NoiseRelativeToEor

EFFECTS = Effect.registry


class CorruptionSettings(Section):
    """Scaling, sum and corruption of the simulated components.

    Noise is added to the sum of foregrounds and EoR before the effects, so that it is multiplied by gains like them, as
    in the paper.
    """

    eor_level: Decibel | None = Field(
        -40.0,
        le=0.0,
        description="rms of EoR over foregrounds, 10 log10 of brightness: -40 dB is 1e-4; null: absolute units.",
    )
    noise: Noise = NoiseRelativeToEor()
    effects: Annotated[
        tuple[Annotated[SerializeAsAny[Effect], EFFECTS.field()], ...],
        Field(
            description="What happens to the sum of foregrounds, EoR and noise, in this order; an empty list: nothing.",
        ),
    ] = (EFFECTS.make("per-channel-gains"),)

    @property
    def gains(self) -> GainEffect | None:
        """The first effect on the gains, or None."""
        return next((effect for effect in self.effects if isinstance(effect, GainEffect)), None)

    @model_validator(mode="after")
    def _effects_are_independent(self) -> CorruptionSettings:
        seen: dict[Any, int] = {}
        for place, effect in enumerate(self.effects):
            for name, seed in effect.drawn_seeds.items():
                if seed in seen:
                    first = seed[0] if isinstance(seed, tuple) else seed
                    raise fault(
                        f"effects.{place}.{name}",
                        f"is {first}, as that of item {seen[seed]}: what they draw would not be independent",
                    )
                seen[seed] = place
        return self
