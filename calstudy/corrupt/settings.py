"""The `corruption` section of an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from calstudy.schema import Section, choice, fault
from calstudy.units import Decibel, Delay


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


class NoiseRelativeToEor(Section):
    """Thermal noise with a standard deviation of `factor` times the rms of the EoR visibilities (paper: 10)."""

    kind: Literal["times-eor"] = "times-eor"
    factor: float = Field(10.0, gt=0)
    seeds: Seeds = (3, 4)


class NoiseRelativeToForegrounds(Section):
    """Thermal noise of `factor` times the rms of the foreground visibilities (paper §Low SNR: 0.1)."""

    kind: Literal["times-foregrounds"]
    factor: float = Field(0.1, gt=0)
    seeds: Seeds = (3, 4)


class NoNoise(Section):
    """No thermal noise: the even and odd data are the same."""

    kind: Literal["none"]


Noise = Annotated[
    NoiseRelativeToEor | NoiseRelativeToForegrounds | NoNoise, Field(discriminator="kind"), choice("kind", "times-eor")
]


class ChannelGains(Section):
    """g = 1 + sigma (n + i n'), independent per antenna and channel, constant in time (paper §Simulations)."""

    kind: Literal["per-channel"] = "per-channel"
    sigma: float = Field(0.1, ge=0, le=10)
    seed: int = Field(5, ge=0)


class ReflectionGains(Section):
    """One cable reflection per antenna (paper Eq. REFGAIN)."""

    kind: Literal["reflection"]
    amplitude: float = Field(0.01, ge=0, lt=1, description="Mean of the exponential distribution of r.")
    delay: Delay = Field(1200e-9, description="Mean of the normal distribution of the delay.")
    delay_scatter: Delay = Field(100e-9, ge=0)
    seed: int = Field(5, ge=0)


class UnityGains(Section):
    """Perfect gains."""

    kind: Literal["unity"]


class FileGains(Section):
    """Gains read from a CalH5 or calfits file with the same antennas and channels."""

    kind: Literal["file"]
    path: Path = Field(strict=False)


Gains = Annotated[
    ChannelGains | ReflectionGains | UnityGains | FileGains, Field(discriminator="kind"), choice("kind", "per-channel")
]


class CorruptionSettings(Section):
    """How the simulated components are scaled and combined into measurements."""

    eor_level: Decibel | None = Field(
        -40.0,
        description="rms of EoR over foregrounds, 10 log10 of brightness: -40 dB is 1e-4; null: absolute units.",
    )
    noise: Noise = NoiseRelativeToEor()
    gains: Gains = ChannelGains()
