"""Fit gains with a finite prior on the errors of the sky model on every baseline (Byrne 2023)."""

from __future__ import annotations

from typing import ClassVar

from calstudy.calibrate.calibrators._least_squares import LeastSquares
from calstudy.calibrate.settings import ForegroundFit, ForegroundPrior, GaussNewtonSettings, ScalePrior, Solver


class DelayWeighted(LeastSquares, ForegroundFit):
    """Gains are fitted with a sky model whose errors, of known size, fill the modelled delays of each baseline."""

    # Fits with a finite prior converge since 2; before, they stopped at or ahead of the largest number of steps.
    # Weights are inverse variances since 3 where some samples have no weight and are not flagged.
    version: ClassVar[int] = 3
    calibrator: str = "delay-weighted"
    foreground_prior: ForegroundPrior = ForegroundPrior(mean="sky-model", deviation=0.1)
    prior: ScalePrior = "sky-model"
    # At the default tolerance the foreground residual exceeds the EoR near the wedge.
    solver: Solver = GaussNewtonSettings(tolerance=1e-5)
