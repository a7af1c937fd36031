"""The `corruption` section of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, SerializeAsAny, model_validator

from calstudy.base.schema import Section, choice, fault
from calstudy.base.units import Area, Decibel
from calstudy.corrupt.effects.per_channel_gains import PerChannelGains
from calstudy.corrupt.interface import Effect, GainEffect
from calstudy.corrupt.temperature import SystemTemperature


def _different(seeds: tuple[int, int]) -> tuple[int, int]:
    if seeds[0] == seeds[1]:
        raise fault("", f"of even and odd are both {seeds[0]}: their noise would be the same")
    return seeds


Seed = Annotated[int, Field(ge=0)]
Seeds = Annotated[
    tuple[Seed, Seed],
    Field(strict=False, description="Seeds of the even and odd realization."),
    AfterValidator(_different),
]


OF_TWINS = Field(
    None,
    description="Seeds of data without the EoR; null: the noise of the data with it, so that their difference is the "
    "EoR alone. Blind challenges need noise of its own.",
)


class NoiseRelativeToEor(Section):
    """Thermal noise with a standard deviation of `factor` times the rms of the EoR visibilities (paper: 10)."""

    kind: Literal["times-eor"] = "times-eor"
    factor: float = Field(10.0, gt=0)
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class NoiseRelativeToForegrounds(Section):
    """Thermal noise of `factor` times the rms of the foreground visibilities (paper §Low SNR: 0.1)."""

    kind: Literal["times-foregrounds"]
    factor: float = Field(0.1, gt=0)
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class RadiometerNoise(SystemTemperature):
    """Thermal noise in absolute units, by the radiometer equation: k_B T / (A_e sqrt(width x integration x nights)).

    T is receiver + sky (nu / sky_frequency)^sky_index. This is the standard deviation of the complex noise in xx or yy,
    per baseline, channel, integration and realization; width and integration are those of the instrument. Foregrounds
    are in absolute units; for the EoR to be so too, set `corruption.eor_level` to null.
    """

    kind: Literal["radiometer"]
    effective_area: Area | None = Field(
        None, gt=0, description="Of an antenna; null: wavelength^2 over the solid angle of `instrument.beam`."
    )
    nights: int = Field(1, ge=1, description="Nights at the same sidereal time that are averaged coherently.")
    seeds: Seeds = (3, 4)
    seeds_without_eor: Seeds | None = OF_TWINS


class NoNoise(Section):
    """No thermal noise: the even and odd data are the same."""

    kind: Literal["none"]


Noise = Annotated[
    NoiseRelativeToEor | NoiseRelativeToForegrounds | RadiometerNoise | NoNoise,
    choice("kind", "times-eor"),
]


EFFECTS = Effect.registry


class CorruptionSettings(Section):
    """Scaling, sum and corruption of the simulated components.

    Noise is added to the sum of foregrounds and EoR before the effects, so that it is multiplied by gains like them, as
    in the paper.
    """

    eor_level: Decibel | None = Field(
        -40.0,
        description="rms of EoR over foregrounds, 10 log10 of brightness: -40 dB is 1e-4; null: absolute units.",
    )
    noise: Noise = NoiseRelativeToEor()
    effects: Annotated[
        tuple[Annotated[SerializeAsAny[Effect], EFFECTS.field()], ...],
        Field(
            strict=False,
            description="What happens to the sum of foregrounds, EoR and noise, in this order; an empty list: nothing.",
        ),
    ] = (PerChannelGains(),)

    @property
    def gains(self) -> GainEffect | None:
        """The first effect on the gains, or None."""
        return next((effect for effect in self.effects if isinstance(effect, GainEffect)), None)

    @model_validator(mode="before")
    @classmethod
    def _gains_are_effects(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "gains" in data:
            raise fault("gains", f"is now corruption.effects, a list: effects: {_as_effects(data['gains'])}")
        return data

    @model_validator(mode="after")
    def _effects_are_independent(self) -> CorruptionSettings:
        seen: dict[Any, int] = {}
        for place, effect in enumerate(self.effects):
            own, drift = getattr(effect, "seed", None), getattr(effect, "drift", None)
            seeds = [("seed", own, own)]
            if drift is not None:
                seeds.append(("drift.seed", drift.seed, (drift.seed, own)))
            for name, seed, identity in seeds:
                if identity is not None and identity in seen:
                    raise fault(
                        f"effects.{place}.{name}",
                        f"is {seed}, as that of item {seen[identity]}: what they draw would not be independent",
                    )
                seen[identity] = place
        return self


def _as_effects(gains: Any) -> str:
    """Return a block of the former field `corruption.gains` written as a list of effects."""
    block = {"kind": gains} if isinstance(gains, str) else dict(gains) if isinstance(gains, Mapping) else {}
    kind = block.pop("kind", "per-channel")
    if kind == "unity":
        return "[]"
    settings = "".join(f", {name}: {value}" for name, value in block.items())
    return f"[{{kind: {kind}-gains{settings}}}]"
