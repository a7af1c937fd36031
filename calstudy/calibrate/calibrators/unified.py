"""Fit gains with a prior on errors of the sky model, partly common to redundant baselines (Byrne et al. 2021)."""

from __future__ import annotations

from typing import ClassVar

from calstudy.calibrate.calibrators._least_squares import LeastSquares
from calstudy.calibrate.settings import ForegroundFit, ForegroundPrior, GaussNewtonSettings, ScalePrior, Solver


class Unified(LeastSquares, ForegroundFit):
    """Gains are fitted with a sky model whose errors are common to redundant baselines, but for a smaller part."""

    # Fits with a finite prior converge since 2; before, they stopped at or ahead of the largest number of steps.
    # Weights are inverse variances since 3 where some samples have no weight and are not flagged.
    version: ClassVar[int] = 3
    calibrator: str = "unified"
    foreground_prior: ForegroundPrior = ForegroundPrior(mean="sky-model", deviation=0.05, shared_deviation=0.1)
    prior: ScalePrior = "sky-model"
    # At the default tolerance the foreground residual exceeds the EoR near the wedge.
    solver: Solver = GaussNewtonSettings(tolerance=1e-5)
