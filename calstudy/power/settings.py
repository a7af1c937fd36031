"""The `power` section of an experiment file."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.plugins import Plugin, Registry
from calstudy.base.schema import Section, fault
from calstudy.base.units import Delay, Length, Time, Wavenumber

ESTIMATORS: Registry[Any] = Registry("estimator", "calstudy.power.estimators", "calstudy.power.interface:Estimator")

MOST_BINS = 10_000
HERA_PSPEC_ANTENNAS = 899
"""Largest number of an antenna in hera_pspec, which writes those of four, plus 100, into the twelve digits of one
integer."""


class KBins(Section):
    """Equal spherical bins in |k|."""

    min: Wavenumber = Field(0.0, ge=0)
    max: Wavenumber = Field(3.4, gt=0, le=1000)
    width: Wavenumber = Field(0.04, gt=0, description="At most 10000 bins may result.")

    @model_validator(mode="after")
    def _ascend(self) -> Self:
        if self.max <= self.min:
            raise fault("max", f"{self.max:g} h/Mpc must be larger than min, {self.min:g} h/Mpc")
        span = self.max - self.min
        if span / self.width > MOST_BINS:
            raise fault(
                "width",
                f"{self.width:g} h/Mpc makes {span / self.width:.3g} bins, and at most {MOST_BINS} are allowed; use "
                f"{span / MOST_BINS:.2g} h/Mpc or more",
            )
        return self


class PowerSettings(Section):
    """Cylindrical and spherical power spectra of calibrated visibilities."""

    estimator: Annotated[SerializeAsAny[Plugin], ESTIMATORS.field("hera-pspec")] = Field(
        default_factory=lambda: ESTIMATORS.make("hera-pspec"),
        description="How delay spectra are made of two averaged data sets.",
    )
    taper: Literal["blackman-harris", "hann", "tukey", "none"] = "blackman-harris"
    pairs: Literal["same-baseline", "redundant-group", "auto"] = Field(
        "auto",
        description="Cross spectra of each baseline with itself, or with the others of its redundant group; auto: "
        "groups if at least half of the baselines have a redundant partner.",
    )
    redundancy_tolerance: Length = Field(
        1.0,
        gt=0,
        description="Baselines whose vectors agree within a quarter of this are in one group; those that differ "
        "by more than half of it are not (a grid of pyuvdata).",
    )
    coherent_time: Time | None = Field(
        None,
        ge=1e-3,
        description="Integrations are fringe-stopped and averaged in blocks of at most this duration, and the powers "
        "of the blocks are averaged; null: one block.",
    )
    wedge_buffer: Delay = Field(100e-9, ge=0, description="Modes with |delay| <= |b|/c + buffer are in the wedge.")
    length_bin: Length = Field(4.0, ge=0.01, description="Width of the cylindrical (wedge) bins in baseline length.")
    bins: KBins = KBins()
    cosmology: Literal["Planck15", "Planck18", "WMAP9"] = Field(
        "Planck15",
        description="Cosmology of the complete study, also used to convert the P(k) of the EoR to brightness.",
    )

    def n_blocks(self, duration: float, integration: float) -> int:
        """Return the number of blocks in which a run is averaged, from the durations of the run and an integration, s.

        No block is longer than `coherent_time`, or than one integration if that is longer.
        """
        if self.coherent_time is None:
            return 1
        # Durations that are differences of Julian dates are rounded to some tens of microseconds.
        longest = max(1, math.floor(self.coherent_time / integration + 1e-3))
        return math.ceil(round(duration / integration) / longest)
