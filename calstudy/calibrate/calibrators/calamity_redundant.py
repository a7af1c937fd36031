"""CALAMITY with a foreground model for every redundant group (paper Eq. LOGLIKELIHOODREDUNDANT)."""

from __future__ import annotations

from typing import ClassVar

from calstudy.calibrate.calibrators._least_squares import LeastSquares
from calstudy.calibrate.settings import ForegroundFit


class CalamityRedundant(LeastSquares, ForegroundFit):
    """Gains are fitted with a smooth foreground model of each redundant group (paper Eq. LOGLIKELIHOODREDUNDANT)."""

    grouped: ClassVar[bool] = True

    calibrator: str = "calamity-redundant"
