"""CALAMITY with a foreground model for every redundant group (paper Eq. LOGLIKELIHOODREDUNDANT)."""

from __future__ import annotations

from calstudy.calibrate.calibrators._least_squares import LeastSquares
from calstudy.calibrate.settings import ForegroundFit, ForegroundPrior


class CalamityRedundant(LeastSquares, ForegroundFit):
    """Gains are fitted with a smooth foreground model of each redundant group (paper Eq. LOGLIKELIHOODREDUNDANT)."""

    calibrator: str = "calamity-redundant"
    foreground_prior: ForegroundPrior = ForegroundPrior(deviation=0.0, shared_deviation="infinite")
