"""The `calibration` section of an experiment file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calstudy.schema import Section, choice
from calstudy.units import Delay, Length


class BasisSettings(Section):
    """The DPSS foreground basis of each baseline (paper Eq. FGMODEL)."""

    horizon: float = Field(
        1.0, ge=0, description="Half-width of the modelled delays, in units of the horizon delay |b|/c."
    )
    buffer: Delay = Field(50e-9, ge=0, description="Added to the half-width.")
    min_delay: Delay = Field(100e-9, ge=0, description="The half-width before the buffer is at least this.")
    eigenvalue_cutoff: float = Field(
        1e-12, gt=0, lt=1, description="Keep sequences with a larger spectral concentration."
    )
    delay_step: Delay = Field(
        10e-9, gt=0, description="Half-widths are rounded up to a multiple of this, so that baselines share bases."
    )


class GaussNewtonSettings(Section):
    """Variable projection with a Levenberg-damped Gauss-Newton iteration: the default."""

    name: Literal["gauss-newton"] = "gauss-newton"
    tolerance: float = Field(
        1e-3, gt=0, lt=1, description="Stop when the predicted relative decrease of the loss is smaller."
    )
    max_steps: int = Field(30, ge=1)
    warm_start: bool = Field(True, description="Start each integration from the solution of the one before.")


class FirstOrderSettings(Section):
    """Joint gradient descent on gains and foregrounds; Adamax at 0.01 is the paper's solver."""

    name: Literal["adamax", "adam", "sgd"]
    learning_rate: float = Field(0.01, gt=0)
    tolerance: float = Field(1e-14, ge=0, description="Stop when the loss changes by less than this between checks.")
    max_steps: int = Field(10_000, ge=1)
    precision: Literal["single", "double"] = "single"
    warm_start: bool = False


Solver = Annotated[
    GaussNewtonSettings | FirstOrderSettings, Field(discriminator="name"), choice("name", "gauss-newton")
]


class CalibrationSettings(Section):
    """The calibrator, its foreground basis and its solver."""

    calibrator: Literal["calamity", "calamity-redundant"] = Field(
        "calamity",
        description="One foreground model per baseline (LOGLIKELIHOOD) or group (LOGLIKELIHOODREDUNDANT).",
    )
    redundancy_tolerance: Length = Field(0.5, gt=0, description="Baselines closer than this are one group.")
    basis: BasisSettings = BasisSettings()
    solver: Solver = GaussNewtonSettings()
    prior: Literal["sum", "post-hoc", "none"] = Field(
        "sum",
        description="How the overall scale is fixed: by the paper's prior on the summed model, afterwards, or not.",
    )
    autos: bool = Field(False, description="Include autocorrelations in the fit.")
    chunks: int = Field(
        4, ge=1, description="Pieces of consecutive integrations; the unit of resuming and of work sharing."
    )
