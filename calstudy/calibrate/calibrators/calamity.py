"""CALAMITY: gains, and a foreground model for every baseline (paper Eq. LOGLIKELIHOOD)."""

from __future__ import annotations

from calstudy.calibrate.calibrators._least_squares import LeastSquares
from calstudy.calibrate.settings import ForegroundFit


class Calamity(LeastSquares, ForegroundFit):
    """Gains are fitted together with a smooth foreground model of each baseline (paper Eq. LOGLIKELIHOOD)."""

    calibrator: str = "calamity"
